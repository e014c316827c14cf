from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from eqrt.core.kinematics import constant_turn
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.prediction.forecaster import Raw
from eqrt.runtime.prediction.guard import (
    LIMITS,
    MAX_GAIN_MPS,
    MIN_STEPS,
    START_M,
    Guarded,
    guard,
)
from raw_predictions import AHEAD_S, DT_S, STEPS, driving

Float64 = NDArray[np.float64]


def guarded(raw: Raw) -> Guarded:
    targets = raw.targets
    return guard(
        raw.trajectories,
        raw.probabilities,
        targets.history,
        targets.valid,
        DT_S,
        object_class=targets.object_class,
        measured=targets.velocity,
        covariances=raw.covariances,
    )


def uncertain(raw: Raw) -> Raw:
    return replace(raw, covariances=np.tile(np.eye(2), (*raw.trajectories.shape[:3], 1, 1)))


def test_a_possible_prediction_passes_untouched() -> None:
    raw = uncertain(driving())
    result = guarded(raw)
    assert result.accepted.all()
    assert result.trajectories is raw.trajectories
    assert result.probabilities is raw.probabilities
    assert result.covariances is raw.covariances
    np.testing.assert_allclose(result.velocity, [[12.0, 0.0]])


def test_a_mode_may_have_no_probability_at_all() -> None:
    """A softmax in float32 gives 0 to what it thinks impossible."""
    raw = driving(modes=3)
    raw.probabilities[:] = [1.0, 0.0, 0.0]
    assert guarded(raw).accepted.all()


def nan_in_a_late_mode(raw: Raw) -> None:
    raw.trajectories[0, 1, 20] = np.nan


def jump_at_the_start(raw: Raw) -> None:
    raw.trajectories[0, 0] += 5.0


def teleport(raw: Raw) -> None:
    raw.trajectories[0, 0, 15:] += 50.0


def braking_that_no_tyre_gives(raw: Raw) -> None:
    raw.trajectories[0, 0, 2:] = raw.trajectories[0, 0, 2]


def probabilities_that_do_not_sum_to_one(raw: Raw) -> None:
    raw.probabilities *= 1.1


def a_negative_probability(raw: Raw) -> None:
    """They still sum to one."""
    raw.probabilities[0] = [1.5, -0.5]


def an_infinite_probability(raw: Raw) -> None:
    raw.probabilities[0, 0] = np.inf


def a_covariance_that_is_none(raw: Raw) -> None:
    assert raw.covariances is not None
    raw.covariances[0, 1, 7, 0, 1] = np.nan


@pytest.mark.parametrize(
    "break_it",
    [
        nan_in_a_late_mode,
        jump_at_the_start,
        teleport,
        braking_that_no_tyre_gives,
        probabilities_that_do_not_sum_to_one,
        a_negative_probability,
        an_infinite_probability,
        a_covariance_that_is_none,
    ],
)
def test_an_impossible_prediction_falls_back_to_constant_turn(
    break_it: Callable[[Raw], None],
) -> None:
    """And not the neighbour's."""
    raw, expected = uncertain(driving(30.0, targets=2)), driving(30.0, targets=2)
    if break_it is probabilities_that_do_not_sum_to_one:
        raw.probabilities[1] /= 1.1
    break_it(raw)
    result = guarded(raw)
    np.testing.assert_array_equal(result.accepted, [False, True])
    np.testing.assert_allclose(result.trajectories, expected.trajectories, atol=1e-9)
    np.testing.assert_array_equal(result.probabilities[0], [1.0, 0.0])
    np.testing.assert_allclose(result.probabilities[1], [0.5, 0.5])
    assert result.covariances is not None
    assert np.isnan(result.covariances[0]).all()
    assert np.isfinite(result.covariances[1]).all()


def test_a_target_the_model_said_nothing_about_goes_on_turning() -> None:
    """Half a radian per second to the left."""
    turning = driving()
    past_s = DT_S * np.arange(-19, 1)
    radius_m, rate = 24.0, 0.5
    history = radius_m * np.stack([np.sin(rate * past_s), 1.0 - np.cos(rate * past_s)], axis=-1)
    targets = replace(turning.targets, history=history[None])
    silent = replace(turning, targets=targets, trajectories=np.full((1, 2, STEPS, 2), np.nan))
    found = guarded(silent)
    assert not found.accepted.any()
    circle = radius_m * np.stack([np.sin(rate * AHEAD_S), 1.0 - np.cos(rate * AHEAD_S)], axis=-1)
    straight = constant_turn(np.zeros((1, 2)), found.velocity, np.zeros(1), STEPS, DT_S)[0]
    off_m = np.linalg.norm(found.trajectories[0, 0, -1] - circle[-1])
    assert off_m < 0.5 * np.linalg.norm(straight[-1] - circle[-1])


def seen_once(*measured: tuple[float, float]) -> Raw:
    """Targets at (0, 0) of which the sensor says these velocities, and the model nothing."""
    raw = driving(targets=len(measured))
    raw.targets.valid[:, :-1] = False
    raw.targets.history[:, :-1] = np.nan
    raw.targets.velocity[:] = measured
    raw.trajectories[:] = np.nan
    return raw


def test_a_target_seen_once_falls_back_to_the_velocity_that_was_measured() -> None:
    found = guarded(seen_once((-25.0, 3.0), (0.0, 0.0)))
    np.testing.assert_array_equal(found.velocity, [[-25.0, 3.0], [0.0, 0.0]])
    np.testing.assert_allclose(found.trajectories[0, 0], np.outer(AHEAD_S, [-25.0, 3.0]))
    np.testing.assert_array_equal(found.trajectories[1], 0.0)


@pytest.mark.parametrize(
    "measured", [(np.nan, np.nan), (5.0, np.nan), (90.1, 0.0), (64.0, -64.0), (np.inf, 0.0)]
)
def test_a_target_seen_once_has_no_velocity_if_none_was_measured(
    measured: tuple[float, float],
) -> None:
    """Or half of one, or one that nothing has. It falls back to its place."""
    found = guarded(seen_once(measured))
    assert np.isnan(found.velocity).all()
    np.testing.assert_array_equal(found.trajectories, 0.0)


def test_a_velocity_may_be_measured_as_fast_as_anything_on_a_road() -> None:
    np.testing.assert_array_equal(guarded(seen_once((0.0, -90.0))).velocity, [[0.0, -90.0]])


def test_without_a_sensor_that_measures_velocities_a_target_seen_once_has_none() -> None:
    raw = seen_once((-25.0, 3.0))
    targets = raw.targets
    found = guard(raw.trajectories, raw.probabilities, targets.history, targets.valid, DT_S)
    assert np.isnan(found.velocity).all()


@pytest.mark.parametrize("steps", [1, 2, MIN_STEPS - 1])
def test_a_target_that_was_just_found_goes_by_what_was_measured(steps: int) -> None:
    """The model has its say where nothing was measured, once there are two steps."""
    raw = driving(targets=2)
    raw.targets.velocity[:] = [(-25.0, 3.0), (np.nan, np.nan)]
    raw.targets.valid[:, :-steps] = False
    raw.targets.history[:, :-steps] = np.nan
    found = guarded(raw)
    assert found.accepted.all()
    np.testing.assert_array_equal(found.velocity[0], [-25.0, 3.0])
    np.testing.assert_allclose(found.trajectories[0, 0], np.outer(AHEAD_S, [-25.0, 3.0]))
    np.testing.assert_array_equal(found.probabilities[0], [1.0, 0.0])
    if steps == 1:
        assert np.isnan(found.velocity[1]).all()
        np.testing.assert_array_equal(found.trajectories[1], 0.0)
    else:
        np.testing.assert_allclose(found.velocity[1], [12.0, 0.0])
        np.testing.assert_array_equal(found.trajectories[1], raw.trajectories[1])


def test_what_was_measured_does_not_replace_what_the_history_tells() -> None:
    raw = driving()
    raw.targets.velocity[:] = (-25.0, 3.0)
    raw.targets.valid[:, :-MIN_STEPS] = False
    found = guarded(raw)
    np.testing.assert_allclose(found.velocity, [[12.0, 0.0]])
    np.testing.assert_array_equal(found.trajectories, raw.trajectories)


def test_histories_of_less_than_a_second_are_counted_whole() -> None:
    """A model may read eight steps; all of them seen are enough."""
    raw = driving()
    targets = raw.targets
    measured = np.array([[-25.0, 3.0]])
    found = guard(
        raw.trajectories,
        raw.probabilities,
        targets.history[:, -8:],
        targets.valid[:, -8:],
        DT_S,
        measured=measured,
    )
    np.testing.assert_allclose(found.velocity, [[12.0, 0.0]])
    np.testing.assert_array_equal(found.trajectories, raw.trajectories)


def test_a_model_that_fails_is_said_to_have_failed_of_what_was_just_found_too() -> None:
    raw = seen_once((-25.0, 0.0))
    raw.trajectories[:] = np.nan
    assert not guarded(raw).accepted.any()


# --- what each class can do


def accepted(kind: int, speed_mps: float, path: Float64) -> bool:
    """Whether an object of this class, at this speed, may go on along `path` (H, 2)."""
    raw = driving(speed_mps, kind, modes=1)
    raw.trajectories[0, 0] = path
    return bool(guarded(raw).accepted[0])


def speeding_up(speed_mps: float, by_mps2: float, until_mps: float = np.inf) -> Float64:
    """Straight on, from the first step on faster and faster."""
    sign = np.sign(by_mps2)
    speeds = speed_mps + by_mps2 * (AHEAD_S - DT_S)
    speeds = np.maximum(sign * np.minimum(sign * speeds, sign * until_mps), 0.0)
    return np.stack([np.cumsum(speeds) * DT_S, np.zeros(STEPS)], axis=-1)


def circling(speed_mps: float, across_mps2: float) -> Float64:
    """At a constant speed on the circle that takes this acceleration."""
    rate = across_mps2 / speed_mps
    start, velocity = np.zeros((1, 2)), np.array([[speed_mps, 0.0]])
    return constant_turn(start, velocity, np.array([rate]), STEPS, DT_S).squeeze(0)


@pytest.mark.parametrize("kind", ObjectClass)
def test_every_class_has_its_top_speed(kind: ObjectClass) -> None:
    limits = LIMITS[kind]
    most = limits.speed_mps
    from_mps = most - MAX_GAIN_MPS - 1.0  # so that the class decides, and not what it drives now
    assert accepted(kind, from_mps, speeding_up(from_mps, 6.0, most - 0.1))
    assert not accepted(kind, from_mps, speeding_up(from_mps, 6.0, most + 0.1))


def test_an_object_measured_to_be_faster_than_its_class_may_go_on() -> None:
    """The sensor may have taken a car for a pedestrian; it does not speed up much more, though."""
    kind, speed_mps = ObjectClass.PEDESTRIAN, 20.0
    assert accepted(kind, speed_mps, speeding_up(speed_mps, 6.0, 29.9))
    assert not accepted(kind, speed_mps, speeding_up(speed_mps, 6.0, 30.1))


def test_nothing_is_faster_than_anything_on_a_road() -> None:
    """However fast the sensor says that it is."""
    assert accepted(ObjectClass.TRUCK, 88.0, speeding_up(88.0, 6.0, 89.9))
    assert not accepted(ObjectClass.TRUCK, 88.0, speeding_up(88.0, 6.0, 90.1))


@pytest.mark.parametrize("kind", ObjectClass)
def test_every_class_has_its_speeding_up_and_braking(kind: ObjectClass) -> None:
    limit = LIMITS[kind].along_mps2
    for sign, begin_mps, end_mps in ((1.0, 1.0, 10.9), (-1.0, 9.5, 0.1)):
        inside = speeding_up(begin_mps, sign * 0.98 * limit, end_mps)
        outside = speeding_up(begin_mps, sign * 1.02 * limit, end_mps)
        assert accepted(kind, begin_mps, inside)
        assert not accepted(kind, begin_mps, outside)


@pytest.mark.parametrize("kind", ObjectClass)
def test_every_class_has_its_turns(kind: ObjectClass) -> None:
    """At 11 m/s by grip, and at 5 m/s by how tightly it can turn."""
    limits = LIMITS[kind]
    for speed_mps in (11.0, 5.0):
        most = min(limits.across_mps2, limits.curvature_per_m * speed_mps**2)
        for sign in (1.0, -1.0):
            assert accepted(kind, speed_mps, circling(speed_mps, sign * 0.9 * most))
            assert not accepted(kind, speed_mps, circling(speed_mps, sign * 1.4 * most))


def test_a_class_that_does_not_exist_is_held_to_the_last_ones_limits() -> None:
    """Four bits on the bus can say 15."""
    assert accepted(15, 12.0, speeding_up(12.0, 2.0))
    assert not accepted(15, 12.0, speeding_up(12.0, 30.0))


@pytest.mark.parametrize(("off_m", "expected"), [(START_M - 0.01, True), (START_M + 0.01, False)])
def test_a_prediction_begins_where_the_target_is(off_m: float, expected: bool) -> None:
    path = driving().trajectories[0, 0] + [0.0, off_m]
    assert accepted(ObjectClass.CAR, 12.0, path) is expected
