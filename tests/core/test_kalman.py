from __future__ import annotations

import numpy as np
import pytest

from eqrt.core import kalman as constants
from eqrt.core.kalman import kalman, kalman_velocity

DT_S = 0.1
EVERY = np.ones((1, 20), np.bool_)


def straight(steps: int = 20, velocity: tuple[float, float] = (10.0, -2.0)) -> np.ndarray:
    """(1, T, 2) positions that end at the origin."""
    time = (np.arange(steps) - steps + 1) * DT_S
    return np.asarray((time[:, None] * np.array(velocity))[None])


def test_two_measurements_weigh_the_step_between_them_against_what_was_known_before() -> None:
    """With 0.2 m, 15 m/s and 4 m2/s3: a step of 1 m is worth 22.52 / 2.33133 m/s."""
    _, velocity = kalman_velocity(np.array([[[0.0, 0.0], [1.0, 0.0]]]), EVERY[:, :2], DT_S)
    both = 0.1 * 225.0 + 4.0 * 0.01 / 2  # of position with velocity before the second one
    spread = 0.04 + 0.01 * 225.0 + 4.0 * 0.001 / 3 + 0.04  # of the second one
    assert both / spread == pytest.approx(22.52 / 2.33133, rel=1e-5)
    np.testing.assert_allclose(velocity, [[both / spread, 0.0]])


def test_a_steady_target_goes_straight_on() -> None:
    ahead = kalman(straight(), EVERY, 3, DT_S)
    np.testing.assert_allclose(ahead[0], [[1.0, -0.2], [2.0, -0.4], [3.0, -0.6]], atol=0.01)


def test_a_target_that_stands_or_was_seen_once_stays() -> None:
    history = np.full((2, 20, 2), 5.0)
    valid = np.array([[True] * 20, [False] * 10 + [True] + [False] * 9])
    np.testing.assert_allclose(kalman(history, valid, 2, DT_S), 5.0)


def test_what_was_not_seen_is_not_read() -> None:
    history, valid = straight(), EVERY.copy()
    valid[0, [0, 3, 7, 18, 19]] = False
    first = kalman(history, valid, 5, DT_S)
    history[~valid] = np.nan
    np.testing.assert_array_equal(kalman(history, valid, 5, DT_S), first)


def test_a_target_never_seen_stands_at_the_origin() -> None:
    history = np.full((1, 20, 2), np.nan)
    np.testing.assert_array_equal(kalman(history, ~EVERY, 2, DT_S), np.zeros((1, 2, 2)))


def test_noise_is_smoothed_more_than_by_the_last_half_second_alone() -> None:
    noise = np.random.default_rng(1).normal(0.0, constants.POSITION_STD_M, (500, 20, 2))
    _, velocity = kalman_velocity(straight() + noise, np.tile(EVERY, (500, 1)), DT_S)
    error = np.sqrt(np.square(velocity - [10.0, -2.0]).mean())
    assert error < np.sqrt(2) * constants.POSITION_STD_M / 0.5


def test_turning_the_world_turns_the_prediction() -> None:
    turn = np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
    history = np.random.default_rng(2).normal(size=(1, 20, 2)).cumsum(axis=1)
    before = kalman(history, EVERY, 10, DT_S)
    np.testing.assert_allclose(kalman(history @ turn.T, EVERY, 10, DT_S), before @ turn.T)


def test_it_is_the_textbooks_filter() -> None:
    """Matrices of one axis, target by target, with gaps."""
    rng = np.random.default_rng(3)
    history = rng.normal(size=(6, 20, 2)).cumsum(axis=1)
    valid = rng.random((6, 20)) < 0.7
    valid[:, 0] = False
    found = np.stack(kalman_velocity(history, valid, DT_S))  # (2, B, 2)
    for target in range(6):
        for axis in range(2):
            state = textbook(history[target, :, axis], valid[target])
            np.testing.assert_allclose(found[:, target, axis], state)


def textbook(seen: np.ndarray, valid: np.ndarray) -> np.ndarray:
    move = np.array([[1.0, DT_S], [0.0, 1.0]])
    push = constants.ACCELERATION_DENSITY_M2_S3 * np.array(
        [[DT_S**3 / 3, DT_S**2 / 2], [DT_S**2 / 2, DT_S]]
    )
    look = np.array([[1.0, 0.0]])
    first = int(np.argmax(valid))
    state = np.array([seen[first], 0.0])
    spread = np.diag([constants.POSITION_STD_M**2, constants.FIRST_SPEED_STD_MPS**2])
    for step in range(first + 1, len(seen)):
        state, spread = move @ state, move @ spread @ move.T + push
        if valid[step]:
            gain = spread @ look.T / (look @ spread @ look.T + constants.POSITION_STD_M**2)
            state = state + gain[:, 0] * (seen[step] - state[0])
            spread = (np.eye(2) - gain @ look) @ spread
    return state
