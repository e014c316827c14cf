"""The conditions of profiles: a small language, and nothing but that."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eqrt.runtime.decoding.conditions import ConditionError, Operand, parse_condition

NAN = float("nan")


@pytest.mark.parametrize(
    ("text", "a", "b", "truth"),
    [
        ("a == 1", 1.0, 0.0, True),
        ("a != 1", 1.0, 0.0, False),
        ("a < 2 and b >= 0.5", 1.0, 0.5, True),
        ("a > 1 or b <= -1", 1.0, -1.0, True),
        ("not a == 1", 1.0, 0.0, False),
        ("not not a == 1", 1.0, 0.0, True),
        ("a == 0 or a == 1 and b == 0", 1.0, 1.0, False),
        ("(a == 0 or a == 1) and b == 1", 1.0, 1.0, True),
        ("a == 0x10", 16.0, 0.0, True),
        ("a == -0x10 and b == 1e-3", -16.0, 0.001, True),
        ("a < +1.5e2", 149.0, 0.0, True),
        ("a==1 and(b==0)", 1.0, 0.0, True),
    ],
)
def test_a_condition_means_what_it_says(text: str, a: float, b: float, truth: bool) -> None:
    condition = parse_condition(text)
    values = [{"a": a, "b": b}[operand.name] for operand in condition.operands]
    assert condition.evaluate(values) is truth
    assert condition.evaluate([np.array([value]) for value in values]).tolist() == [truth]


@pytest.mark.parametrize("comparison", ["==", "!=", "<", "<=", ">", ">="])
def test_nothing_is_true_of_a_signal_that_is_not_there(comparison: str) -> None:
    condition = parse_condition(f"a {comparison} 1")
    assert not condition.evaluate([NAN])
    assert condition.evaluate([np.array([NAN, NAN])]).tolist() == [False, False]


def test_raw_and_physical_values_are_different_operands() -> None:
    condition = parse_condition("raw(part.X) != -1 and part.X < 3 and raw(part.X) < 9")
    assert condition.operands == (Operand("part.X", True), Operand("part.X", False))
    assert condition.evaluate([5.0, 2.5])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "expected a signal, found the end"),
        ("a", "expected a comparison"),
        ("a = 1", "expected a comparison (== != < <= > >=), found '='"),
        ("a == b", "expected a number, found 'b'"),
        ("a == nan", "expected a number, found 'nan'"),
        ("a == 1 or", "expected a signal, found the end"),
        ("a == 1 b == 2", "expected 'and', 'or' or the end, found 'b'"),
        ("(a == 1", "expected ')', found the end"),
        ("raw a == 1", "expected '(', found 'a'"),
        ("1 < a", "expected a signal, found '1'"),
        ("__import__('os').system('true')", "expected a comparison"),
        ("(" * 50 + "a == 1" + ")" * 50, "more than 20 parentheses deep"),
    ],
)
def test_anything_else_is_refused_with_what_was_expected(text: str, complaint: str) -> None:
    with pytest.raises(ConditionError) as refusal:
        parse_condition(text)
    assert complaint in str(refusal.value)


@given(st.text(alphabet="ab10 ()=<>!.x-andotrw", max_size=40))
def test_any_text_is_either_a_condition_or_refused(text: str) -> None:
    try:
        condition = parse_condition(text)
    except ConditionError:
        return
    assert condition.evaluate([1.0] * len(condition.operands)) in (True, False)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a signal, found the end"),
        ("and == 1", "expected a signal, found 'and'"),
        ("not", "expected a signal, found the end"),
        ("raw == 1", "expected '(', found '=='"),
        ("raw(raw) == 1", "expected a signal, found 'raw'"),
        ("raw(a == 1", "expected ')', found '=='"),
        ("raw(a", "expected ')', found the end"),
        ("(a == 1 b", "expected ')', found 'b'"),
        ("a", "expected a comparison (== != < <= > >=), found the end"),
        ("a b", "expected a comparison (== != < <= > >=), found 'b'"),
        ("a ! 1", "expected a comparison (== != < <= > >=), found '!'"),
        ("a ==", "expected a number, found the end"),
        ("a == 1.2.3", "expected a number, found '1.2.3'"),
        ("a == inf", "expected a number, found 'inf'"),
        (f"a == 0x{'f' * 300}", f"expected a number, found '0x{'f' * 300}'"),
        ("a == 1e999", "expected a number, found '1e999'"),
        ("a == 1)", "expected 'and', 'or' or the end, found ')'"),
        ("not " * 20 + "(a == 1)", "more than 20 parentheses deep"),
    ],
)
def test_what_was_expected_and_what_was_found_is_said_in_these_words(
    text: str, message: str
) -> None:
    with pytest.raises(ConditionError) as refusal:
        parse_condition(text)
    assert str(refusal.value) == message


@pytest.mark.parametrize("text", ["not " * 18 + "a == 1", "(" * 19 + "a == 1" + ")" * 19])
def test_twenty_deep_is_not_too_deep(text: str) -> None:
    assert parse_condition(text).evaluate([1.0])


def test_depth_is_what_stands_inside_each_other_not_side_by_side() -> None:
    text = " and ".join(["(not (a == 0))"] * 30)
    assert parse_condition(text).evaluate([1.0])


@pytest.mark.parametrize(
    ("text", "values", "truth"),
    [
        ("a == 5 or b == 5 or c == 5", [0.0, 0.0, 5.0], True),
        ("a == 5 or b == 5 or c == 5", [0.0, 5.0, 0.0], True),
        ("a == 5 or b == 5 or c == 5", [5.0, 0.0, 0.0], True),
        ("a == 5 and b == 5 and c == 5", [5.0, 5.0, 0.0], False),
        ("a == 5 and b == 5 and c == 5", [5.0, 0.0, 5.0], False),
        ("a == 5 and b == 5 and c == 5", [0.0, 5.0, 5.0], False),
        ("_hidden == 0X1f", [31.0], True),
        ("v2.X9 == -0x1 or v2.X9 == +0x2", [2.0], True),
        ("s{slot:02X} >= 1E+2", [100.0], True),
        ("a < 1", [1.0], False),
        ("a <= 1", [1.0], True),
        ("a > 1", [1.0], False),
        ("a >= 1", [1.0], True),
        ("a != 1", [2.0], True),
        ("a == .5", [0.5], True),
    ],
)
def test_every_part_of_the_grammar_counts(text: str, values: list[float], truth: bool) -> None:
    condition = parse_condition(text)
    assert len(condition.operands) == len(values)
    assert bool(condition.evaluate(values)) is truth


def test_a_signal_that_comes_again_is_the_same_operand() -> None:
    condition = parse_condition("a > 1 and b < 9 and a < 3")
    assert condition.operands == (Operand("a", False), Operand("b", False))
    assert condition.evaluate([2.0, 5.0])
    assert not condition.evaluate([4.0, 5.0])


def test_what_stands_side_by_side_does_not_make_room_for_what_is_deeper() -> None:
    text = "(" * 10 + "a == 1 and " * 8 + "(" * 12 + "a == 1" + ")" * 22
    with pytest.raises(ConditionError, match="more than 20 parentheses deep"):
        parse_condition(text)
