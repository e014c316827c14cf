"""Turns, on a clock that only goes forward when somebody works or sleeps."""

from __future__ import annotations

from eqrt.runtime.bench.schedule import Turn, back_to_back, periodic

MS = 1_000_000


class Hand:
    """A clock moved by hand; waking up comes late by `late_ns`, or halfway."""

    def __init__(self, late_ns: int = 0, *, wakes_early: bool = False) -> None:
        self.now_ns = 5_000 * MS
        self.late_ns = late_ns
        self.wakes_early = wakes_early
        self.slept: list[float] = []

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        asked_ns = round(1e9 * seconds)
        self.now_ns += (asked_ns + 1) // 2 if self.wakes_early else asked_ns + self.late_ns

    def turns(self, rate_hz: float, seconds: float, *work_ms: int) -> list[Turn]:
        """The turns when the runs take so long; the last time goes on."""
        made: list[Turn] = []
        for turn in periodic(rate_hz, seconds, self.clock, self.sleep):
            self.now_ns += MS * work_ms[min(len(made), len(work_ms) - 1)]
            made.append(turn)
        return made


def test_ticks_do_not_drift_however_long_work_and_waking_up_take() -> None:
    hand = Hand(late_ns=300_000)
    turns = hand.turns(10.0, 1.0, 37, 81, 5)
    assert [turn.due_ns for turn in turns] == [(5_100 + 100 * i) * MS for i in range(10)]
    assert {turn.started_ns - turn.due_ns for turn in turns} == {300_000}
    assert all(turn.waited for turn in turns)


def test_waking_early_is_followed_by_another_sleep() -> None:
    hand = Hand(wakes_early=True)
    turns = hand.turns(10.0, 0.5, 1)
    assert all(turn.started_ns == turn.due_ns for turn in turns)
    assert len(hand.slept) > len(turns)


def test_a_run_that_is_late_by_less_than_a_period_does_not_lose_the_next_tick() -> None:
    turns = Hand().turns(10.0, 0.5, 150, 10)
    assert [turn.number for turn in turns] == [0, 1, 2, 3, 4]
    assert [turn.waited for turn in turns] == [True, False, True, True, True]
    assert turns[1].started_ns - turns[1].due_ns == 50 * MS


def test_ticks_that_have_passed_altogether_are_left_out() -> None:
    turns = Hand().turns(10.0, 1.0, 10, 350, 10)
    assert [turn.number for turn in turns] == [0, 1, 4, 5, 6, 7, 8, 9]
    assert not turns[2].waited
    assert turns[2].started_ns - turns[2].due_ns == 50 * MS


def test_a_run_that_ends_exactly_at_its_deadline_loses_nothing() -> None:
    turns = Hand().turns(10.0, 0.5, 100)
    assert [turn.number for turn in turns] == [0, 1, 2, 3, 4]
    assert all(turn.started_ns == turn.due_ns for turn in turns)


def test_back_to_back_runs_until_the_time_is_over() -> None:
    hand = Hand()
    made: list[Turn] = []
    for turn in back_to_back(0.1, hand.clock):
        hand.now_ns += 30 * MS
        made.append(turn)
    assert [turn.number for turn in made] == [0, 1, 2, 3]
    assert all(turn.due_ns == turn.started_ns and not turn.waited for turn in made)
