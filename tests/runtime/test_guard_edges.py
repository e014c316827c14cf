"""The guard's limits to the last one, in every direction, and for short horizons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from eqrt.core.kinematics import constant_turn
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.prediction.guard import LIMITS, START_M, Guarded, guard

DT_S = 0.125  # which a float holds exactly
STEPS = 30

Float64 = NDArray[np.float64]


def along(
    speeds_mps: Sequence[float] | NDArray[np.floating], toward: tuple[float, float]
) -> Float64:
    """(H, 2) the path of an object at (0, 0) that drives at these speeds, step by step."""
    travelled_m: Float64 = np.cumsum(np.array(speeds_mps, np.float64)) * DT_S
    path: Float64 = travelled_m[:, None] * np.array(toward)
    return path


def guarded(
    path: Float64, speed_mps: float, toward: tuple[float, float] = (1.0, 0.0), kind: int = 0
) -> Guarded:
    """An object of this class that has come at a steady speed and goes on along `path`."""
    history = along([speed_mps] * 20, toward) - 20 * speed_mps * DT_S * np.array(toward)
    return guard(
        path[None, None],
        np.ones((1, 1)),
        history[None],
        np.ones((1, 20), np.bool_),
        DT_S,
        object_class=np.array([kind], np.uint8),
    )


def test_without_classes_every_target_is_of_an_unknown_one() -> None:
    """Which may turn as tightly as it likes: no car takes this circle."""
    speed_mps, across_mps2 = 4.0, 13.0
    rate = np.array([across_mps2 / speed_mps])
    velocity = np.array([[speed_mps, 0.0]])
    path = constant_turn(np.zeros((1, 2)), velocity, rate, STEPS, DT_S)
    history = along([speed_mps] * 20, (1.0, 0.0)) - [20 * speed_mps * DT_S, 0.0]
    seen = (history[None], np.ones((1, 20), np.bool_), DT_S)
    assert guard(path[None], np.ones((1, 1)), *seen).accepted.tolist() == [True]
    car = np.array([ObjectClass.CAR], np.uint8)
    assert not guard(path[None], np.ones((1, 1)), *seen, object_class=car).accepted.any()


def test_a_neighbour_that_falls_back_leaves_a_prediction_that_is_not_physics_alone() -> None:
    slower = along(np.linspace(12.0, 8.0, STEPS), (1.0, 0.0))
    history = along([12.0] * 20, (1.0, 0.0)) - [20 * 12.0 * DT_S, 0.0]
    result = guard(
        np.stack([slower, np.full((STEPS, 2), np.nan)])[:, None],
        np.ones((2, 1)),
        np.stack([history, history]),
        np.ones((2, 20), np.bool_),
        DT_S,
    )
    assert result.accepted.tolist() == [True, False]
    np.testing.assert_array_equal(result.trajectories[0, 0], slower)


def test_infinities_are_refused_before_anything_is_computed_from_them() -> None:
    path = along([12.0] * STEPS, (1.0, 0.0))
    path[3:] = np.inf
    with np.errstate(all="raise"):
        assert not guarded(path, 12.0).accepted.any()


def test_the_top_speed_itself_is_allowed() -> None:
    """A bicycle that speeds up from 14 to 25 m/s, 8 m/s^2 at most; all of it exact."""
    top_mps = LIMITS[ObjectClass.BICYCLE].speed_mps
    speeds = np.minimum(14.0 + np.arange(STEPS), top_mps)
    assert guarded(along(speeds, (1.0, 0.0)), 14.0, kind=ObjectClass.BICYCLE).accepted.all()


def test_a_start_just_as_far_off_as_may_be_is_allowed() -> None:
    standing = np.full((STEPS, 2), [START_M, 0.0])
    assert guarded(standing, 0.0).accepted.all()
    assert not guarded(standing * 1.001, 0.0).accepted.any()


def test_single_steps_may_jitter() -> None:
    """To and fro by 2 m/s: 32 m/s^2 from step to step, 6.4 over half a second and more."""
    speeds = 12.0 + 2.0 * (np.arange(STEPS) % 2)
    assert guarded(along(speeds, (1.0, 0.0)), 12.0, kind=ObjectClass.CAR).accepted.all()


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        ([12.0, 12.0, 15.0, 12.0], True),  # two steps on it is as it was
        ([12.0, 12.0, 14.0, 16.5], False),  # 18 m/s^2 over two steps
        ([12.0, 12.0, 12.0], True),
        ([12.0, 12.0, 15.0], False),  # 24 m/s^2 over the only one
        ([12.0, 12.0], True),
        ([12.0], True),
    ],
)
def test_a_short_horizon_is_checked_over_all_that_there_is(
    speeds: list[float], expected: bool
) -> None:
    found = guarded(along(speeds, (1.0, 0.0)), 12.0, kind=ObjectClass.CAR).accepted
    assert found.tolist() == [expected]


def test_turning_round_counts_in_full_though_the_mean_speed_is_little() -> None:
    """From 5 m/s backward to 5.5 m/s forward in half a second and more: 16.8 m/s^2."""
    speeds = np.where(np.arange(STEPS) < 8, -5.0, 5.5)
    assert not guarded(along(speeds, (1.0, 0.0)), -5.0).accepted.any()
    gentle = np.where(np.arange(STEPS) < 8, -4.0, 5.0)  # 14.4 m/s^2
    assert guarded(along(gentle, (1.0, 0.0)), -4.0).accepted.all()


@pytest.mark.parametrize(("across_mps2", "expected"), [(7.0, True), (9.5, False)])
def test_slow_turns_are_limited_by_their_radius(across_mps2: float, expected: bool) -> None:
    """A car at 4 m/s may take 8 m/s^2, though its tyres would give 15."""
    rate, velocity = np.array([across_mps2 / 4.0]), np.array([[4.0, 0.0]])
    path = constant_turn(np.zeros((1, 2)), velocity, rate, STEPS, DT_S)[0]
    assert guarded(path, 4.0, kind=ObjectClass.CAR).accepted.tolist() == [expected]


@pytest.mark.parametrize("toward", [(0.6, 0.8), (-0.8, 0.6), (0.6, -0.8), (0.0, 1.0)])
def test_speeding_up_is_not_turning_whatever_the_direction(toward: tuple[float, float]) -> None:
    """A truck may brake and speed up by 13 m/s^2 but turn with 11 only."""
    speeds = np.minimum(8.0 + 12.0 * DT_S * np.arange(STEPS), 30.0)
    assert guarded(along(speeds, toward), 8.0, toward, ObjectClass.TRUCK).accepted.all()


def test_the_greatest_acceleration_itself_is_allowed_along_and_across() -> None:
    """15 m/s^2, as 1.875 m/s from step to step; all of it exact."""
    change = 1.875 * np.minimum(np.arange(-1, STEPS - 1), 5)
    assert guarded(along(10.0 + change, (1.0, 0.0)), 10.0).accepted.all()
    velocity = np.stack([np.full(STEPS, 16.0), change - change[-1] / 2], axis=-1)
    assert guarded(np.cumsum(velocity, axis=0) * DT_S, 16.0).accepted.all()
