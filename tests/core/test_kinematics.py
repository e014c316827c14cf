from __future__ import annotations

import numpy as np
import pytest

from eqrt.core.kinematics import constant_turn, constant_velocity, fit_motion

DT_S = 0.1


def straight(steps: int = 20, velocity: tuple[float, float] = (10.0, -2.0)) -> np.ndarray:
    """(1, T, 2) positions that end at the origin."""
    time = (np.arange(steps) - steps + 1) * DT_S
    return np.asarray((time[:, None] * np.array(velocity))[None])


def test_constant_velocity_goes_on_as_the_last_half_second_went() -> None:
    valid = np.ones((1, 20), np.bool_)
    ahead = constant_velocity(straight(), valid, 3)
    np.testing.assert_allclose(ahead[0], [[1.0, -0.2], [2.0, -0.4], [3.0, -0.6]])


def test_constant_velocity_does_not_read_what_was_not_seen() -> None:
    history, valid = straight(), np.ones((1, 20), np.bool_)
    valid[0, -4:-1] = False
    history[0, -4:-1] = np.nan
    np.testing.assert_allclose(constant_velocity(history, valid, 1)[0, 0], [1.0, -0.2])


def test_constant_velocity_uses_an_older_step_where_the_last_half_second_has_none() -> None:
    history, valid = straight(), np.zeros((1, 20), np.bool_)
    valid[0, [3, 19]] = True
    np.testing.assert_allclose(constant_velocity(history, valid, 1)[0, 0], [1.0, -0.2])


def test_a_target_seen_once_stands_still() -> None:
    valid = np.zeros((1, 20), np.bool_)
    valid[0, -1] = True
    np.testing.assert_array_equal(constant_velocity(straight(), valid, 2), np.zeros((1, 2, 2)))


def test_constant_turn_without_turning_is_a_straight_line() -> None:
    ahead = constant_turn(np.zeros((1, 2)), np.array([[3.0, 4.0]]), np.zeros(1), 10, DT_S)
    np.testing.assert_allclose(ahead[0, -1], [3.0, 4.0])


def test_constant_turn_drives_a_circle() -> None:
    """A quarter turn to the left in 1 s at 10 m/s has a radius of 10 / (pi / 2)."""
    rate = np.array([np.pi / 2])
    ahead = constant_turn(np.zeros((1, 2)), np.array([[10.0, 0.0]]), rate, 10, DT_S)
    radius = 10.0 / (np.pi / 2)
    np.testing.assert_allclose(ahead[0, -1], [radius, radius])


@pytest.mark.parametrize("rate", [-0.3, 0.0, 0.2])
def test_the_motion_of_a_circle_is_found(rate: float) -> None:
    time = (np.arange(20) - 19) * DT_S
    velocity = np.array([[np.cos(0.4) * 12, np.sin(0.4) * 12]])
    back = [constant_turn(np.zeros((1, 2)), velocity, np.array([rate]), 1, t)[0, 0] for t in time]
    found, turn_rate = fit_motion(np.array([back]), np.ones((1, 20), np.bool_), DT_S)
    np.testing.assert_allclose(turn_rate, [rate], atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(found), 12.0, rtol=0.01)


def test_what_stands_has_no_velocity_and_what_was_seen_once_has_none_that_is_known() -> None:
    """Neither turns."""
    valid = np.zeros((2, 20), np.bool_)
    valid[0, -1] = True
    valid[1] = True
    history = np.full((2, 20, 2), np.nan)
    history[valid] = 5.0
    velocity, turn_rate = fit_motion(history, valid, DT_S)
    assert np.isnan(velocity[0]).all()
    np.testing.assert_allclose(velocity[1], 0.0, atol=1e-12)
    np.testing.assert_array_equal(turn_rate, 0.0)


def test_two_steps_make_a_velocity() -> None:
    valid = np.zeros((1, 20), np.bool_)
    valid[0, -2:] = True
    velocity, turn_rate = fit_motion(straight(), valid, DT_S)
    np.testing.assert_allclose(velocity, [[10.0, -2.0]])
    np.testing.assert_array_equal(turn_rate, 0.0)


def test_what_moves_at_an_unknown_velocity_stays_where_it_is() -> None:
    unknown = np.full((1, 2), np.nan)
    ahead = constant_turn(np.array([[3.0, 4.0]]), unknown, np.zeros(1), 5, DT_S)
    np.testing.assert_array_equal(ahead, np.tile([3.0, 4.0], (1, 5, 1)))
