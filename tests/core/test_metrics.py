from __future__ import annotations

import numpy as np

from eqrt.core.metrics import (
    average_displacement,
    best_mode,
    brier_min_fde,
    displacement,
    error_table,
    final_displacement,
    min_ade,
    min_fde,
    miss_rate,
    missed,
)


def test_errors_of_a_hand_made_case() -> None:
    """Off by 0.1 m more every step: at 1 s by 1 m, on average by 0.55 m."""
    truth = np.zeros((1, 30, 2))
    predicted = np.zeros((1, 30, 2))
    predicted[0, :, 1] = 0.1 * np.arange(1, 31)
    table = error_table(displacement(predicted, truth), dt_s=0.1)
    expected = {
        "ade_1s": 0.55,
        "fde_1s": 1.0,
        "ade_2s": 1.05,
        "fde_2s": 2.0,
        "ade_3s": 1.55,
        "fde_3s": 3.0,
    }
    assert table.keys() == expected.keys()
    np.testing.assert_allclose(list(table.values()), list(expected.values()))


def test_displacement_is_the_straight_distance() -> None:
    np.testing.assert_allclose(displacement(np.array([[3.0, 4.0]]), np.zeros((1, 2))), [5.0])


TWO_TARGETS = np.array(
    [
        [[4.0, 6.0, 2.0], [1.0, 1.0, 4.0], [9.0, 9.0, 3.0]],  # the first mode ends nearest
        [[5.0, 5.0, 5.0], [0.0, 0.0, 6.0], [3.0, 3.0, 3.0]],  # the last does
    ]
)
"""Distances (2, 3, 3) in metres: two targets, three modes, three steps."""


def test_the_best_mode_is_the_one_that_ends_nearest() -> None:
    np.testing.assert_array_equal(best_mode(TWO_TARGETS), [0, 2])
    np.testing.assert_allclose(min_fde(TWO_TARGETS), [2.0, 3.0])


def test_min_ade_is_that_of_the_best_mode_and_not_the_least_of_all() -> None:
    """Target 0: mode 1 has the least ADE, (1 + 1 + 4) / 3 = 2, but ends 4 m away."""
    np.testing.assert_allclose(min_ade(TWO_TARGETS), [(4.0 + 6.0 + 2.0) / 3, 3.0])


def test_of_two_modes_that_end_equally_near_the_more_probable_counts() -> None:
    distance = np.array([[[1.0, 2.0], [0.0, 2.0]]])
    np.testing.assert_allclose(min_ade(distance), [1.5])


def test_a_miss_is_more_than_two_metres() -> None:
    """Exactly 2 m is no miss."""
    np.testing.assert_array_equal(missed(TWO_TARGETS), [False, True])
    assert miss_rate(TWO_TARGETS) == 0.5


def test_one_mode_gives_the_plain_errors() -> None:
    distance = np.random.default_rng(3).uniform(0.0, 5.0, (50, 1, 30))
    np.testing.assert_allclose(min_ade(distance).mean(), average_displacement(distance[:, 0], 30))
    np.testing.assert_allclose(min_fde(distance).mean(), final_displacement(distance[:, 0], 30))
    np.testing.assert_allclose(brier_min_fde(distance, np.ones((50, 1))), min_fde(distance))
    assert miss_rate(distance) == np.mean(distance[:, 0, -1] > 2.0)


def test_more_modes_never_end_farther() -> None:
    distance = np.random.default_rng(4).uniform(0.0, 5.0, (50, 6, 30))
    assert (min_fde(distance) <= min_fde(distance[:, :1])).all()
    assert miss_rate(distance) <= miss_rate(distance[:, :3]) <= miss_rate(distance[:, :1])


def test_brier_min_fde_adds_the_squared_doubt_in_the_best_mode() -> None:
    """Target 0: p = 0.5 of 1; target 1: p = 0.2 of 0.8 in all, a quarter: (1 - 0.25)^2."""
    probabilities = np.array([[0.5, 0.3, 0.2], [0.4, 0.2, 0.2]])
    np.testing.assert_allclose(
        brier_min_fde(TWO_TARGETS, probabilities), [2.0 + 0.25, 3.0 + 0.5625]
    )
