"""The conditions of profiles: a small language, and nothing but that."""

from __future__ import annotations

import operator
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding.bindings import Binder
from eqrt.runtime.decoding.conditions import ConditionError, Operand, parse_condition
from eqrt.runtime.decoding.dbc_files import DbcMessage
from eqrt.runtime.decoding.dbc_tables import Signal, SignalTable

NAN = float("nan")
SIGNS = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


def signal_of(scale: float, offset: float = 0.0, *, byte: int = 0, **kind: Any) -> Signal:
    """An integer of 32 bits, signed, unless `kind` says else."""
    usual = {"length": 32, "is_signed": True, "is_float": False}
    return Signal(
        name="X",
        first_byte=byte,
        last_byte=byte + 3,
        shift=0,
        is_little_endian=True,
        scale=scale,
        offset=offset,
        unit="",
        **{**usual, **kind},
    )


def holds(text: str, signal: Signal, payloads: list[bytes]) -> list[bool]:
    """The condition of X in each of the messages: all at once as for objects, else one by one."""
    message = DbcMessage(
        name="M", arbitration_id=1, is_extended=False, length=4, signals={"X": signal}
    )
    binder = Binder("here", {"m": [message]})
    condition = binder.condition("valid", text)
    columns = binder.columns(0)
    together: list[bool] = condition.holds([SignalTable(columns).decode(payloads)]).tolist()
    single = [condition.holds([[x.read(payload) for x in columns]]) for payload in payloads]
    assert single == together
    return together


def packed(*raws: int) -> list[bytes]:
    return [raw.to_bytes(4, "little", signed=True) for raw in raws]


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


DIGITS = st.integers(-4, 6)
SCALES = st.builds(
    lambda count, digits: Decimal(count).scaleb(-digits),
    st.sampled_from([1, -1, 2, 5, 25, -4, 3, 7, 125]),
    DIGITS,
)
OFFSETS = st.builds(
    lambda count, digits: Decimal(count).scaleb(-digits), st.integers(-5000, 5000), DIGITS
)
RAWS = st.integers(-(1 << 31), (1 << 31) - 1)


@given(
    scale=SCALES,
    offset=OFFSETS,
    raw=RAWS,
    step=st.integers(-2, 2),
    sign=st.sampled_from(list(SIGNS)),
)
def test_a_number_means_the_raw_value_whose_decimals_it_has(
    scale: Decimal, offset: Decimal, raw: int, step: int, sign: str
) -> None:
    """As reckoned exactly, in decimals; and beside it no other is equal."""
    other = min(max(raw + step, -(1 << 31)), (1 << 31) - 1)
    number, value = raw * scale + offset, other * scale + offset
    signal = signal_of(float(scale), float(offset))
    expected = SIGNS[sign](value, number)
    for text in (f"X {sign} {number}", f"X {sign} {number:f}"):
        assert holds(text, signal, packed(other)) == [expected]


@given(
    scale=st.sampled_from([0.1, 0.05, 1.0, -0.2, 1 / 128, 0.0439453125, 0.3333]),
    offset=st.sampled_from([0.0, -40.0, 0.7]),
    number=st.floats(-100.0, 100.0) | st.integers(-1000, 1000).map(lambda n: n / 10),
    raw=st.integers(-1500, 1500),
)
def test_the_comparisons_agree_with_each_other(
    scale: float, offset: float, number: float, raw: int
) -> None:
    """Whatever the number: less, equal or greater, one of them and not two."""
    signal = signal_of(scale, offset)
    truth = {sign: holds(f"X {sign} {number!r}", signal, packed(raw))[0] for sign in SIGNS}
    assert truth["<"] + truth["=="] + truth[">"] == 1
    assert truth["!="] is not truth["=="]
    assert truth["<="] is (truth["<"] or truth["=="])
    assert truth[">="] is (truth[">"] or truth["=="])


@pytest.mark.parametrize(
    ("scale", "offset", "number", "raw"),
    [
        (0.1, 0.0, "6553.4", 65534),
        (0.1, 0.0, "6553.400000000001", 65534),
        (0.1, 0.0, "6553.4000000000000000", 65534),
        (0.1, -0.3, "0", 3),
        (0.1, 0.0, "0.3", 3),
        (0.1, 0.0, "3e-1", 3),
        (100.0, 0.0, "12e2", 12),
        (0.5, 0.0, "0x10", 32),
        (1 / 256, 0.0, "250.996", 64255),  # 250.99609375
        (1 / 8, 0.0, "8031.88", 64255),  # 8031.875
        (0.0333333, 0.0, "100", 3000),  # 99.9999, as the DBC rounds a thirtieth
        (1e-7, 0.0, "8.4012345", 84012345),
    ],
)
def test_a_number_is_equal_to_the_value_that_rounds_to_it(
    scale: float, offset: float, number: str, raw: int
) -> None:
    signal, payloads = signal_of(scale, offset), packed(raw - 1, raw, raw + 1)
    assert holds(f"X == {number}", signal, payloads) == [False, True, False]
    assert holds(f"X != {number}", signal, payloads) == [True, False, True]
    assert holds(f"X < {number}", signal, payloads) == [True, False, False]
    assert holds(f"X <= {number}", signal, payloads) == [True, True, False]
    assert holds(f"X > {number}", signal, payloads) == [False, False, True]
    assert holds(f"X >= {number}", signal, payloads) == [False, True, True]


@pytest.mark.parametrize(
    ("scale", "number", "below"),
    [
        (0.1, "6553.45", 65534),
        (0.1, "102.39", 1023),
        (0.1, "102.301", 1023),
        (0.3, "1", 3),  # 0.9 would round to it, but is a third of a bit away
        (0.125, "0.3", 2),
        (1.0, "0.01", 0),  # a car that stands is slower than that
        (1.0, "0.000000001", 0),
        (1.0, "2.5", 2),
        (1.0, "3.99999999", 3),
    ],
)
def test_a_number_between_two_values_is_equal_to_neither(
    scale: float, number: str, below: int
) -> None:
    signal, payloads = signal_of(scale), packed(below, below + 1)
    assert holds(f"X == {number}", signal, payloads) == [False, False]
    assert holds(f"X != {number}", signal, payloads) == [True, True]
    assert holds(f"X < {number}", signal, payloads) == [True, False]
    assert holds(f"X <= {number}", signal, payloads) == [True, False]
    assert holds(f"X > {number}", signal, payloads) == [False, True]
    assert holds(f"X >= {number}", signal, payloads) == [False, True]


@pytest.mark.parametrize(
    ("number", "scale", "offset", "raw", "is_equal"),
    [
        ("1e3", 1024.0, 0.0, 1, True),  # rounded to thousands
        ("0x3e8", 1024.0, 0.0, 1, False),  # to the last digit
        ("0x63", 100.0, 0.0, 1, False),
        ("0e1", 10.0, -1.0, 0, True),  # just a tenth of a bit away
        ("0.10000000000000000", 0.1, 0.3, -2, True),  # but for what floating point adds
    ],
)
def test_as_many_digits_count_as_are_written(
    number: str, scale: float, offset: float, raw: int, is_equal: bool
) -> None:
    condition = parse_condition(f"x == {number}", lambda found: found.of_raw(scale, offset))
    assert condition.operands == (Operand("x", True),)
    assert condition.evaluate([float(raw)]) is is_equal


@pytest.mark.parametrize("number", ["1e308", "-1e308", "1e-320", "0e99999", "1e-99999"])
@pytest.mark.parametrize("scale", [1e-300, -1e-300, 1e300])
def test_numbers_that_are_far_away_are_compared_as_well(scale: float, number: str) -> None:
    signal = signal_of(scale, 1e308)
    (less,), (equal,), (greater,) = (
        holds(f"X {sign} {number}", signal, packed(5)) for sign in ("<", "==", ">")
    )
    assert [less, equal, greater].count(True) == 1


@pytest.mark.parametrize("sign", list(SIGNS))
def test_floats_are_compared_as_they_are(sign: str) -> None:
    """Also after their scale: nothing says how exact they are."""
    values = np.array([0.1, 0.25, 0.3, np.inf], np.float32)
    signal = signal_of(0.5, 0.0, is_float=True, is_signed=False)
    payloads = [value.tobytes() for value in values]
    for number in ("0.125", "0.05"):
        expected = SIGNS[sign](values.astype(np.float64) * 0.5, float(number)).tolist()
        assert holds(f"X {sign} {number}", signal, payloads) == expected


def test_a_signal_that_is_always_the_same_is_compared_with_that() -> None:
    signal = signal_of(0.0, 0.3)
    assert holds("X == 0.3", signal, packed(0, 7)) == [True, True]
    assert holds("X > 0.3", signal, packed(0, 7)) == [False, False]


def test_raw_values_are_compared_whatever_they_stand_for() -> None:
    signal, payloads = signal_of(-0.1, 3.0), packed(-2, -1, 0)
    assert holds("raw(X) == -1", signal, payloads) == [False, True, False]
    assert holds("raw(X) < -1", signal, payloads) == [True, False, False]
    assert holds("raw(X) == 0 or X == 3.1", signal, payloads) == [False, True, True]


def test_nothing_is_true_of_a_message_that_is_too_short() -> None:
    for sign in SIGNS:
        assert holds(f"X {sign} 0.3", signal_of(-0.1), [b"\0\0\0"]) == [False]


def binder_of(*signals: Signal) -> Binder:
    """Objects X1, X2 ... in one message."""
    named = {f"X{i}": signal for i, signal in enumerate(signals, 1)}
    message = DbcMessage(name="M", arbitration_id=1, is_extended=False, length=8, signals=named)
    return Binder("here", {"m": [message]}, objects=range(1, len(signals) + 1))


def test_objects_are_compared_with_one_number() -> None:
    binder = binder_of(signal_of(0.1), signal_of(0.1, byte=4))
    condition = binder.condition("valid", "X{object} == 6553.4")
    (payload,) = [b"".join(packed(65534, 65535))]
    values = SignalTable(binder.columns(0)).decode([payload]).ravel()
    assert condition.holds([[values]]).tolist() == [True, False]


@pytest.mark.parametrize(
    "other",
    [
        signal_of(0.2, byte=4),
        signal_of(0.1, 1.0, byte=4),
        signal_of(0.0, byte=4),
        signal_of(0.1, byte=4, is_signed=False, is_float=True),
    ],
)
def test_objects_that_are_scaled_differently_have_only_raw_values_in_common(other: Signal) -> None:
    binder = binder_of(signal_of(0.1), other)
    with pytest.raises(ProfileError, match=r"'X\{object\}' differs from object to object in scale"):
        binder.condition("valid", "X{object} == 1")
    binder.condition("valid", "raw(X{object}) == 1")
