"""The mode of a target, and that of a cycle: why it is so, and how long it stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eqrt.core.frames import Pose2
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.prediction.forecaster import Raw
from eqrt.runtime.prediction.guard import Guarded
from eqrt.runtime.prediction.modes import HOLD_S, ModeKeeper, agent_modes, cycle_reasons
from eqrt.runtime.tracking.ego import EgoState
from raw_predictions import driving

RANK = [Mode.FALLBACK, Mode.NO_POSE, Mode.LATE, Mode.NO_MAP]
REASONS = st.sets(st.sampled_from(RANK))


IN_THE_MAP = EgoState(
    map_from_ego=Pose2(), velocity=(0.0, 0.0), yaw_rate_rad_s=0.0, has_map_pose=True, epoch=0
)
ASTRAY = replace(IN_THE_MAP, has_map_pose=False)

# A target as `outcome` takes it.
WELL, REFUSED, LATE = "well", "refused", "late"


def outcome(*targets: str, has_lanes: bool = True) -> tuple[Raw, Guarded]:
    """What the model and the guard made of these targets."""
    raw = replace(driving(targets=len(targets)), has_lanes=has_lanes)
    raw.late[:] = [target == LATE for target in targets]
    accepted = np.array([target == WELL for target in targets], np.bool_)
    velocity = np.zeros((len(targets), 2))
    return raw, Guarded(raw.trajectories, raw.probabilities, None, accepted, velocity)


def test_a_target_says_how_it_was_predicted() -> None:
    """That it has been seen for a short time only matters for the model."""
    raw, guarded = outcome(WELL, WELL, REFUSED, REFUSED, LATE, LATE)
    raw.targets.valid[1::2, 3] = False
    told = agent_modes(raw, guarded)
    fell_back = [Mode.FALLBACK, Mode.FALLBACK, Mode.LATE, Mode.LATE]
    assert told.tolist() == [Mode.RUN, Mode.PARTIAL, *fell_back]
    assert told.dtype == np.uint8


@pytest.mark.parametrize(
    ("targets", "expected"),
    [
        ([], set()),
        ([WELL, WELL], set()),
        ([WELL, REFUSED], set()),  # the target says so
        ([REFUSED, REFUSED], {Mode.FALLBACK}),
        ([WELL, LATE], {Mode.LATE}),
        ([LATE, LATE], {Mode.LATE}),
        ([REFUSED, LATE], {Mode.FALLBACK, Mode.LATE}),
        ([WELL, REFUSED, LATE], {Mode.LATE}),
    ],
)
def test_a_cycle_is_as_bad_as_what_became_of_its_targets(
    targets: list[str], expected: set[Mode]
) -> None:
    told = cycle_reasons(*outcome(*targets), IN_THE_MAP, has_tile=True, overdue=False)
    assert told == expected


def test_a_cycle_that_took_longer_than_a_period_is_late_though_no_target_is() -> None:
    for targets in ([], [WELL]):
        told = cycle_reasons(*outcome(*targets), IN_THE_MAP, has_tile=True, overdue=True)
        assert told == {Mode.LATE}


@pytest.mark.parametrize(
    ("ego", "has_tile", "has_lanes", "expected"),
    [
        (IN_THE_MAP, True, True, set()),
        (IN_THE_MAP, True, False, {Mode.NO_MAP}),
        (IN_THE_MAP, False, False, {Mode.NO_MAP}),
        (ASTRAY, True, False, {Mode.NO_MAP, Mode.NO_POSE}),
        (ASTRAY, False, False, {Mode.NO_MAP}),  # nobody asks where in which map
        (None, True, True, {Mode.NO_POSE}),
        (None, False, False, {Mode.NO_MAP, Mode.NO_POSE}),
    ],
)
def test_a_cycle_says_what_it_knows_of_the_place(
    ego: EgoState | None, has_tile: bool, has_lanes: bool, expected: set[Mode]
) -> None:
    predicted = outcome(WELL, has_lanes=has_lanes)
    assert cycle_reasons(*predicted, ego, has_tile=has_tile, overdue=False) == expected


@pytest.mark.parametrize("targets", [[], [LATE], [REFUSED]])
def test_a_tile_that_nobody_was_predicted_with_is_not_missed(targets: list[str]) -> None:
    predicted = outcome(*targets, has_lanes=False)
    without_lanes = cycle_reasons(*predicted, IN_THE_MAP, has_tile=True, overdue=False)
    assert Mode.NO_MAP not in without_lanes
    assert Mode.NO_MAP in cycle_reasons(*predicted, IN_THE_MAP, has_tile=False, overdue=False)


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


def test_two_cycles_at_the_same_time_are_no_clock_that_was_set_back() -> None:
    """Both came in one burst of messages."""
    keeper = ModeKeeper()
    keeper.cycle({Mode.LATE}, 5.0)
    assert keeper.cycle(set(), 5.0) is Mode.LATE


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
