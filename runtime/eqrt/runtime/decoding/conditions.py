"""The conditions of a profile: signals compared with numbers, joined by `and`, `or`, `not`.

    a.VALID == 1 and (a.LONG_DIST < 255 or not raw(a.STATE) == 0x7)

A name is a signal's physical value, as the DBC scales it, or `raw(NAME)` what its bits say before
that. A comparison with a signal that is not in the message is false, whatever the operator. Nothing
is executed: the text is parsed by the grammar below, once, at start.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Evaluate = Callable[[Sequence[Any]], Any]
"""Values of the operands, all floats or all arrays of one shape -> truth, of the same kind."""


@dataclass(frozen=True, slots=True)
class Operand:
    """A signal that a condition looks at."""

    name: str
    is_raw: bool


@dataclass(frozen=True, slots=True)
class Comparison:
    """A signal compared with a number."""

    operand: Operand
    sign: str
    number: float
    half_digit: float
    """Half of what the number's last digit counts: 0.005 for 1.25."""

    def of_raw(self, scale: float, offset: float) -> Comparison:
        """The same of raw values, where physical ones are raw * scale + offset, and scale not 0.

        The number becomes the raw value that it stands for, to be compared exactly: as floats,
        65534 * 0.1 and 6553.4 differ. A number that stands for none stays between two of them.
        """
        exact = (self.number - offset) / scale
        nearest = float(np.rint(exact))
        float_error = _FLOAT_ERROR * (abs(self.number) + abs(offset))
        tolerance = min((self.half_digit + float_error) / abs(scale), _MAX_ROUNDING)
        number = nearest if abs(exact - nearest) <= tolerance else exact
        sign = self.sign if scale > 0.0 else _MIRRORED.get(self.sign, self.sign)
        return Comparison(Operand(self.operand.name, True), sign, number, 0.0)


Translate = Callable[[Comparison], Comparison]


@dataclass(frozen=True, slots=True)
class Condition:
    """A parsed condition."""

    operands: tuple[Operand, ...]
    evaluate: Evaluate


class ConditionError(ValueError):
    """The text is not a condition; the message says what was found and what was expected."""


def parse_condition(text: str, translate: Translate = lambda comparison: comparison) -> Condition:
    """`translate` gives what shall be compared in place of a comparison. Raises ConditionError."""
    parser = _Parser(text, translate)
    evaluate = parser.any_of()
    if parser.token:
        raise parser.error("'and', 'or' or the end")
    return Condition(tuple(parser.operands), evaluate)


_NAME = r"[A-Za-z_][\w{}:.]*"
_NUMBER = r"[-+]?[\d.](?:[eE][-+]\d|[\w.])*"
_TOKEN = re.compile(rf"\s*({_NAME}|{_NUMBER}|[<>=!]=?|\S)")
_COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    # Unlike Python's, false for a signal that is not there (NaN).
    "!=": lambda value, number: (value < number) | (value > number),
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_MIRRORED = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}
_FLOAT_ERROR = 1e-15  # of a few roundings, relative; one is 1.1e-16
_MAX_ROUNDING = 0.1  # of a bit: how far a value may be from the decimals that are written for it
_WORDS = ("and", "or", "not", "raw")
_MAX_DEPTH = 20  # of parentheses and `not`s


class _Parser:
    """Recursive descent; `token` is the next one, empty at the end."""

    def __init__(self, text: str, translate: Translate) -> None:
        self.operands: list[Operand] = []
        self._translate = translate
        self._tokens = [match.group(1) for match in _TOKEN.finditer(text)]
        self._position = 0
        self._depth = 0

    @property
    def token(self) -> str:
        return self._tokens[self._position] if self._position < len(self._tokens) else ""

    def error(self, expected: str) -> ConditionError:
        found = repr(self.token) if self.token else "the end"
        return ConditionError(f"expected {expected}, found {found}")

    def any_of(self) -> Evaluate:
        """all_of ('or' all_of)*"""
        terms = [self.all_of()]
        while self._accept("or"):
            terms.append(self.all_of())
        return _joined(operator.or_, terms)

    def all_of(self) -> Evaluate:
        """truth ('and' truth)*"""
        terms = [self.truth()]
        while self._accept("and"):
            terms.append(self.truth())
        return _joined(operator.and_, terms)

    def truth(self) -> Evaluate:
        """'not' truth | '(' any_of ')' | comparison"""
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise ConditionError(f"more than {_MAX_DEPTH} parentheses deep")
        if self._accept("not"):
            inner = self.truth()
            evaluate: Evaluate = lambda values: inner(values) ^ True  # noqa: E731  # one expression
        elif self._accept("("):
            evaluate = self.any_of()
            self._expect(")")
        else:
            evaluate = self.comparison()
        self._depth -= 1
        return evaluate

    def comparison(self) -> Evaluate:
        """operand ('==' | '!=' | '<' | '<=' | '>' | '>=') number"""
        operand = self._operand()
        sign = self._take()
        if sign not in _COMPARISONS:
            self._position -= bool(sign)
            raise self.error("a comparison (== != < <= > >=)")
        comparison = self._translate(Comparison(operand, sign, *self._number()))
        if comparison.operand not in self.operands:
            self.operands.append(comparison.operand)
        index = self.operands.index(comparison.operand)
        compare, number = _COMPARISONS[comparison.sign], comparison.number
        return lambda values: compare(values[index], number)

    def _operand(self) -> Operand:
        is_raw = self._accept("raw")
        if is_raw:
            self._expect("(")
        if not (self.token[:1].isalpha() or self.token[:1] == "_") or self.token in _WORDS:
            raise self.error("a signal")
        operand = Operand(self._take(), is_raw)
        if is_raw:
            self._expect(")")
        return operand

    def _number(self) -> tuple[float, float]:
        """The number, and half of what its last digit counts."""
        text = self.token.lower()
        try:
            is_hex = "x" in text
            number = float(int(text, 0)) if is_hex else float(text)
            half_digit = 0.5 if is_hex else 0.5 * _last_digit(text)
        except (ValueError, OverflowError):
            number = half_digit = math.nan
        if not math.isfinite(number):
            raise self.error("a number")
        self._position += 1
        return number, half_digit

    def _take(self) -> str:
        token = self.token
        self._position += bool(token)
        return token

    def _accept(self, word: str) -> bool:
        accepted = self.token == word
        self._position += accepted
        return accepted

    def _expect(self, word: str) -> None:
        if not self._accept(word):
            raise self.error(repr(word))


def _last_digit(number: str) -> float:
    """What the last digit of a decimal number counts: 0.01 for "1.25", 100 for "12e2"."""
    mantissa, _, exponent = number.partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(f"1e{int(exponent or 0) - decimals}")


def _joined(join: Callable[[Any, Any], Any], terms: list[Evaluate]) -> Evaluate:
    if len(terms) == 1:
        return terms[0]

    def evaluate(values: Sequence[Any]) -> Any:
        result = terms[0](values)
        for term in terms[1:]:
            result = join(result, term(values))
        return result

    return evaluate
