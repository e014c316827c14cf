"""The mode of a cycle, and how long it stays."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.prediction.modes import HOLD_S, ModeKeeper

RANK = [Mode.FALLBACK, Mode.NO_POSE, Mode.LATE, Mode.NO_MAP]
REASONS = st.sets(st.sampled_from(RANK))


def test_without_a_reason_there_is_full_service() -> None:
    assert ModeKeeper().cycle(set(), 0.0) is Mode.RUN


def test_of_several_reasons_the_gravest_counts() -> None:
    for number, mode in enumerate(RANK):
        assert ModeKeeper().cycle(set(RANK[number:]), 5.0) is mode


def test_a_mode_falls_at_once_and_rises_when_its_reason_has_stayed_away() -> None:
    keeper = ModeKeeper()
    times_s = np.arange(0.0, 2.0, 0.1).round(3)
    late = {0.3, 0.5}
    told = [keeper.cycle({Mode.LATE} if t in late else set(), t) for t in times_s.tolist()]
    expected = [Mode.LATE if 0.3 <= t < 0.5 + HOLD_S else Mode.RUN for t in times_s]
    assert told == expected


def test_a_graver_mode_that_ends_leaves_the_lesser_one() -> None:
    keeper = ModeKeeper()
    assert keeper.cycle({Mode.NO_POSE, Mode.NO_MAP}, 0.0) is Mode.NO_POSE
    assert keeper.cycle({Mode.NO_MAP}, 0.4) is Mode.NO_POSE
    assert keeper.cycle({Mode.NO_MAP}, 0.5) is Mode.NO_MAP


def test_a_clock_that_was_set_back_does_not_hold_a_mode_for_hours() -> None:
    keeper = ModeKeeper()
    keeper.cycle({Mode.LATE}, 5000.0)
    assert keeper.cycle(set(), 100.0) is Mode.RUN
    assert keeper.cycle(set(), 5000.1) is Mode.RUN


@given(st.lists(st.tuples(REASONS, st.floats(0.001, 1.0)), max_size=40))
def test_a_cycle_never_says_better_than_it_is(steps: list[tuple[set[Mode], float]]) -> None:
    """And never worse than at some time within the last half second."""
    keeper, now_s = ModeKeeper(), 0.0
    recent: list[tuple[float, Mode]] = []
    for reasons, step_s in steps:
        now_s += step_s
        recent += [(now_s, mode) for mode in reasons]
        told = keeper.cycle(set(reasons), now_s)
        held = {mode for time_s, mode in recent if now_s - time_s < HOLD_S}
        assert told is next((mode for mode in RANK if mode in held), Mode.RUN)
