from __future__ import annotations

import numpy as np
import pytest

from eqrt.runtime.prediction.guard import guard

DT_S = 0.1
STEPS = 30


def driving(speed_mps: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
    """History (1, 20, 2) along +x that ends at (0, 0), all valid."""
    time = (np.arange(20) - 19) * DT_S
    history = np.stack([speed_mps * time, np.zeros(20)], axis=-1)[None]
    return history, np.ones((1, 20), np.bool_)


def straight_on(speed_mps: float = 12.0, modes: int = 2) -> tuple[np.ndarray, np.ndarray]:
    time = np.arange(1, STEPS + 1) * DT_S
    path = np.stack([speed_mps * time, np.zeros(STEPS)], axis=-1)
    return np.tile(path, (1, modes, 1, 1)), np.full((1, modes), 1 / modes)


def test_a_possible_prediction_passes_untouched() -> None:
    trajectories, probabilities = straight_on()
    result = guard(trajectories, probabilities, *driving(), DT_S)
    assert result.accepted.all()
    assert result.trajectories is trajectories
    np.testing.assert_allclose(result.velocity, [[12.0, 0.0]])


def nan_in_a_late_mode(t: np.ndarray, _p: np.ndarray) -> None:
    t[0, 1, 20] = np.nan


def jump_at_the_start(t: np.ndarray, _p: np.ndarray) -> None:
    t[0, 0] += 5.0


def teleport(t: np.ndarray, _p: np.ndarray) -> None:
    t[0, 0, 15:] += 50.0


def impossible_braking(t: np.ndarray, _p: np.ndarray) -> None:
    t[0, 0, 2:] = t[0, 0, 2]


def probabilities_do_not_sum_to_one(_t: np.ndarray, p: np.ndarray) -> None:
    p *= 1.1


def infinite_probability(_t: np.ndarray, p: np.ndarray) -> None:
    p[0, 0] = np.inf


@pytest.mark.parametrize(
    "break_it",
    [
        nan_in_a_late_mode,
        jump_at_the_start,
        teleport,
        impossible_braking,
        probabilities_do_not_sum_to_one,
        infinite_probability,
    ],
)
def test_an_impossible_prediction_falls_back_to_constant_turn(break_it) -> None:  # type: ignore[no-untyped-def]
    trajectories, probabilities = straight_on(30.0 if break_it is impossible_braking else 12.0)
    break_it(trajectories, probabilities)
    history = driving(30.0 if break_it is impossible_braking else 12.0)
    result = guard(trajectories, probabilities, *history, DT_S)
    assert not result.accepted.any()
    expected, _ = straight_on(30.0 if break_it is impossible_braking else 12.0)
    np.testing.assert_allclose(result.trajectories, expected, atol=1e-9)
    np.testing.assert_array_equal(result.probabilities, [[1.0, 0.0]])


def test_one_broken_target_does_not_touch_the_others() -> None:
    trajectories, probabilities = straight_on()
    trajectories = np.concatenate([trajectories, trajectories])
    trajectories[0, 0, 3] = np.inf
    history, valid = driving()
    result = guard(
        trajectories,
        np.concatenate([probabilities, probabilities]),
        np.concatenate([history, history]),
        np.concatenate([valid, valid]),
        DT_S,
    )
    np.testing.assert_array_equal(result.accepted, [False, True])
    assert np.isfinite(result.trajectories).all()
    np.testing.assert_array_equal(result.trajectories[1], trajectories[1])


def test_a_target_seen_once_falls_back_to_standing() -> None:
    trajectories, probabilities = straight_on()
    history, valid = driving()
    valid[0, :-1] = False
    history[0, :-1] = np.nan
    trajectories[:] = np.nan
    result = guard(trajectories, probabilities, history, valid, DT_S)
    np.testing.assert_array_equal(result.trajectories, 0.0)
