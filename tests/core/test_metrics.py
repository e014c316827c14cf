from __future__ import annotations

import numpy as np
import pytest

from eqrt.core.metrics import (
    LENGTH_OF_SHARE,
    average_displacement,
    best_mode,
    brier_min_fde,
    calibration,
    displacement,
    error_table,
    final_displacement,
    inside,
    least_ade,
    log_density,
    mahalanobis,
    min_ade,
    min_fde,
    miss_rate,
    missed,
    surprise,
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


@pytest.mark.parametrize(
    ("steps", "names"),
    [
        (3, ["ade_0.3s", "fde_0.3s"]),
        (20, ["ade_1s", "fde_1s", "ade_2s", "fde_2s"]),
        (25, ["ade_1s", "fde_1s", "ade_2s", "fde_2s", "ade_2.5s", "fde_2.5s"]),
    ],
)
def test_errors_are_given_as_far_as_the_horizon_goes_and_at_its_end(
    steps: int, names: list[str]
) -> None:
    table = error_table(np.arange(1.0, steps + 1.0)[None], dt_s=0.1)
    assert list(table) == names
    assert table[names[-1]] == steps


def test_an_error_beyond_the_horizon_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no error at 3 s: 20 steps of 0\.1 s"):
        error_table(np.ones((1, 20)), 0.1, (1, 2, 3))


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
    np.testing.assert_allclose(least_ade(TWO_TARGETS), [2.0, 2.0])


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


# --- predicted covariances

LONG = 3.0 * np.diag([4.0, 1.0])
"""The covariance of a shape S with axes of 2 m along x and 1 m along y."""
TILTED = 3.0 * np.array([[2.0, 1.0], [1.0, 1.0]])
"""S has the determinant 1, and the inverse [[1, -1], [-1, 2]]."""


def test_lengths_and_densities_by_hand() -> None:
    offset = np.array([[2.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
    np.testing.assert_allclose(mahalanobis(offset, LONG), [1.0, 2.0, 0.0])
    np.testing.assert_allclose(mahalanobis(offset, TILTED), [2.0, np.sqrt(8.0), 0.0])
    np.testing.assert_allclose(
        np.exp(log_density(offset, LONG)), np.exp([-1.0, -2.0, 0.0]) / (4 * np.pi)
    )


def test_the_density_sums_to_one_and_has_the_covariance_that_was_predicted() -> None:
    """On a grid of 0.1 m, as far as it matters."""
    side = np.arange(-40.0, 40.0, 0.1)
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1)
    mass = np.exp(log_density(grid, TILTED)) * 0.1**2
    assert mass.sum() == pytest.approx(1.0, abs=1e-3)
    spread = np.einsum("xy,xyi,xyj->ij", mass, grid, grid)
    np.testing.assert_allclose(spread, TILTED, atol=0.02)
    for percent in LENGTH_OF_SHARE:
        held = mass[inside(grid, TILTED, percent)].sum()
        assert held == pytest.approx(percent / 100, abs=2e-3)


def test_an_ellipses_size_holds_its_share() -> None:
    for percent, length in LENGTH_OF_SHARE.items():
        assert 1.0 - (1.0 + length) * np.exp(-length) == pytest.approx(percent / 100, abs=1e-9)


def test_surprise_is_that_of_all_modes_together() -> None:
    """Twice the same mode says what one says; a mode that nobody believes in says nothing."""
    offset = np.array([[[2.0, 0.0], [2.0, 0.0]]])
    covariances = np.stack([LONG, LONG])[None]
    alone = 1.0 + np.log(4 * np.pi)
    for probabilities in ([[0.5, 0.5]], [[0.9, 0.1]]):
        found = surprise(offset, covariances, np.array(probabilities))
        np.testing.assert_allclose(found, [alone])
    far = np.array([[[2.0, 0.0], [900.0, 0.0]]])
    np.testing.assert_allclose(
        surprise(far, covariances, np.array([[0.5, 0.5]])), alone + np.log(2)
    )
    unlikely = surprise(far[:, ::-1], covariances, np.array([[1.0, 0.0]]))
    assert np.isfinite(unlikely).all()
    assert unlikely[0] > 20.0


def test_the_ellipse_is_the_best_modes_at_the_end() -> None:
    """The second mode ends 1.7 m (m = 1.7) from the truth: within 90 %, outside 50 % (1.678)."""
    truth = np.zeros((2, 3, 2))
    modes = np.full((2, 2, 3, 2), 50.0)
    modes[:, 1, -1] = [[0.0, 1.7], [0.0, 1.6]]
    covariances = np.broadcast_to(np.stack([1e6 * np.eye(2), LONG]), (2, 2, 2, 2))
    table = calibration(modes, np.array([[0.0, 1.0]] * 2), covariances, truth)
    np.testing.assert_array_equal(table["inside_50"], [0.0, 1.0])
    np.testing.assert_array_equal(table["inside_90"], [1.0, 1.0])
    np.testing.assert_allclose(table["nll"], np.array([1.7, 1.6]) + np.log(4 * np.pi), atol=1e-6)


def test_a_covariance_without_area_is_bad_but_a_number() -> None:
    flat = np.diag([1.0, 0.0])[None]
    assert np.isfinite(log_density(np.ones((1, 2)), flat)).all()
    assert not inside(np.ones((1, 2)), flat, 90)[0]
