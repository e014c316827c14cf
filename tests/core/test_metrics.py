from __future__ import annotations

import numpy as np

from eqrt.core.metrics import displacement, error_table


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
