"""When a source is believed: never within a streak of wrong verdicts, again after right ones."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eqrt.runtime.protection.source_health import (
    MAX_WRONG,
    MIN_RIGHT,
    SourceHealth,
    SourceState,
)

STEP_S = 0.1
TIMES = st.floats(allow_nan=True, allow_infinity=True) | st.floats(0.0, 3.0)


def judged(verdicts: list[bool], health: SourceHealth | None = None) -> list[bool]:
    """Whether the source is valid with each verdict."""
    health = health or SourceHealth("radar", 0.5)
    return [health.judge(verdict, i * STEP_S) for i, verdict in enumerate(verdicts)]


def expected(verdicts: list[bool]) -> list[bool]:
    """The rule in other words: AUTOSAR's windows, over the verdicts so far."""
    valid, broken, said = False, False, []
    for end in range(1, len(verdicts) + 1):
        past = verdicts[:end]
        if len(past) >= MAX_WRONG and not any(past[-MAX_WRONG:]):
            valid, broken = False, True
        elif not valid:
            valid = all(past[-MIN_RIGHT:]) if broken else past[-1]
        said.append(valid)
    return said


@given(verdicts=st.lists(st.booleans(), max_size=60))
def test_it_is_valid_as_the_windows_of_the_state_machine_say(verdicts: list[bool]) -> None:
    assert judged(verdicts) == expected(verdicts)


@given(
    before=st.lists(st.booleans(), max_size=20),
    streak=st.integers(MAX_WRONG, 30),
    recovery=st.integers(MIN_RIGHT, 10),
)
def test_never_valid_in_a_streak_of_wrong_ones_and_it_recovers(
    before: list[bool], streak: int, recovery: int
) -> None:
    said = judged(before + [False] * streak + [True] * recovery)
    after = said[len(before) :]
    assert not any(after[MAX_WRONG - 1 : streak + MIN_RIGHT - 1])
    assert all(after[streak + MIN_RIGHT - 1 :])


def test_fewer_wrong_ones_than_five_in_a_row_do_not_matter() -> None:
    assert all(judged(([True] + [False] * (MAX_WRONG - 1)) * 5))


def test_at_the_start_the_first_right_one_will_do() -> None:
    assert judged([False, False, True, False]) == [False, False, True, True]


def test_it_says_why_and_since_when() -> None:
    health = SourceHealth("radar", 0.5)
    assert (health.report.state, health.report.since_s) == (SourceState.WAITING, None)
    assert not health.report.valid
    assert health.report.reason == "nothing right has come yet"
    assert not health.expire(99.0)  # what has never come is not silent
    judged([True] * 3, health)
    assert (health.report.state, health.report.since_s) == (SourceState.VALID, 0.0)
    assert (health.report.valid, health.report.reason) == (True, "")
    for i in range(MAX_WRONG):
        health.judge(False, 0.3 + i * STEP_S)
    health.refuse()
    health.refuse()
    report = health.report
    assert report.reason == "wrong checksums or counters"
    assert report.since_s == pytest.approx(0.7)
    assert (report.name, report.right, report.wrong, report.refused) == ("radar", 3, 5, 2)


def test_silence_ends_with_the_first_right_one() -> None:
    health = SourceHealth("radar", 0.5)
    health.judge(True, 0.0)
    assert not health.expire(0.5)
    assert health.expire(0.6)
    assert health.expire(0.7)
    assert (health.report.state, health.report.since_s) == (SourceState.SILENT, 0.6)
    assert health.report.silences == 1
    assert health.judge(True, 0.8)
    assert (health.report.state, health.report.since_s) == (SourceState.VALID, 0.8)


def test_silence_is_noticed_when_it_ends_too() -> None:
    health = SourceHealth("radar", 0.5)
    health.judge(True, 0.0)
    assert health.judge(True, 5.0)
    assert health.judge(True, 10.0)
    assert health.report.silences == 2


@pytest.mark.parametrize("since_s", [0.5, -0.5])
def test_just_as_long_as_the_limit_is_no_silence(since_s: float) -> None:
    health = SourceHealth("radar", 0.5)
    health.judge(True, 1.0)
    assert not health.expire(1.0 + since_s)
    assert health.expire(1.0 + 1.001 * since_s)


def test_silence_does_not_excuse_what_was_wrong_before() -> None:
    health = SourceHealth("radar", 0.5)
    judged([True] + [False] * MAX_WRONG, health)
    assert [health.judge(True, 9.0 + i * STEP_S) for i in range(3)] == [False, False, True]


def test_a_source_that_is_wrong_from_the_start_says_so() -> None:
    health = SourceHealth("radar", 0.5)
    judged([False] * (MAX_WRONG - 1), health)
    states = [health.report.state]
    health.judge(False, 0.4)
    states.append(health.report.state)
    assert states == [SourceState.WAITING, SourceState.WRONG]


@given(streak=st.integers(MAX_WRONG, 9))
def test_one_part_that_is_wrong_makes_the_source_invalid(streak: int) -> None:
    """Between right ones of the part that tells."""
    health = SourceHealth("ego", 0.5, num_parts=2)
    assert not health.judge(True, 0.0, part=0)  # nothing has been told yet
    assert health.judge(True, 0.0, part=1)
    for i in range(streak):
        health.judge(False, i * 0.01, part=0)
        assert health.judge(True, i * 0.01, part=1) == (i + 1 < MAX_WRONG)
    for i in range(MIN_RIGHT):
        assert health.judge(True, 0.2, part=0) == (i + 1 == MIN_RIGHT)


def test_a_part_that_never_came_does_no_harm_until_it_is_wrong() -> None:
    health = SourceHealth("ego", 0.5, num_parts=2)
    assert all(health.judge(True, 0.1 * i, part=1) for i in range(10))
    assert health.judge(True, 1.0, part=0)
    assert all(health.judge(False, 1.0, part=0) for _ in range(MAX_WRONG - 1))
    assert not health.judge(False, 1.0, part=0)


def test_only_the_part_that_tells_breaks_the_silence() -> None:
    health = SourceHealth("ego", 0.5, num_parts=2)
    health.judge(True, 0.0, part=0)
    health.judge(True, 0.0, part=1)
    assert not health.judge(True, 1.0, part=0)
    assert health.report.state is SourceState.SILENT
    assert health.judge(True, 1.0, part=1)


@given(
    steps=st.lists(st.tuples(st.booleans(), TIMES, st.integers(0, 1), st.booleans()), max_size=40)
)
def test_whatever_the_clock_does_it_is_valid_or_says_why_not(
    steps: list[tuple[bool, float, int, bool]],
) -> None:
    health = SourceHealth("ego", 0.5, num_parts=2)
    for right, at_s, part, polls in steps:
        if polls:
            health.expire(at_s)
        valid = health.judge(right, at_s, part)
        report = health.report
        assert valid == report.valid == (report.state is SourceState.VALID)
        assert (report.since_s is None) == (report.state is SourceState.WAITING)
    report = health.report
    assert report.right + report.wrong == len(steps)
    if steps and math.isnan(steps[-1][1]) and steps[-1][2] == 1:
        assert health.expire(0.0)
