"""What is minimized."""

from __future__ import annotations

import numpy as np
import torch

from eqrt.training.losses import (
    FINAL_SHARE,
    LIKELIHOOD_SHARE,
    ade_loss,
    best_mode_loss,
    mode_displacement,
    soft_mode_loss,
)

FUTURE = torch.zeros(1, 4, 2)
VALID = torch.tensor([[True, True, False, False]])


def two_modes() -> torch.Tensor:
    """One 3 m off at every step, one 5 m off; the second half, which was not seen, 1 km off."""
    modes = torch.zeros(1, 2, 4, 2)
    modes[0, 0, :, 0], modes[0, 1, :, 1] = 3.0, 5.0
    modes[0, :, 2:] = 1000.0
    return modes


def test_the_displacement_of_a_mode_is_over_the_seen_steps() -> None:
    distance = mode_displacement(two_modes(), FUTURE, VALID)
    torch.testing.assert_close(distance, torch.tensor([[3.0, 5.0]]))


def test_best_mode_asks_for_the_better_mode_and_for_knowing_which_it_is() -> None:
    sure = best_mode_loss(two_modes(), torch.tensor([[1.0, 0.0]]), FUTURE, VALID)
    torch.testing.assert_close(sure, torch.tensor(3.0))
    unsure = best_mode_loss(two_modes(), torch.tensor([[0.5, 0.5]]), FUTURE, VALID)
    torch.testing.assert_close(unsure, torch.tensor(3.0 + 0.5 * float(np.log(2.0))))


def test_ade_is_that_of_the_first_mode() -> None:
    swapped = two_modes().flip(1)
    torch.testing.assert_close(
        ade_loss(swapped, torch.ones(1, 2), FUTURE, VALID), torch.tensor(5.0)
    )


def test_soft_modes_pull_the_better_mode_and_its_end_as_far_as_it_was_seen() -> None:
    """Errors of 3 m and 5 m, at every step and so at the last seen: shares of e^-6 and e^-10."""
    sure = soft_mode_loss(two_modes(), torch.tensor([[0.5, 0.5]]), FUTURE, VALID)
    expected = 3.0 + FINAL_SHARE * 3.0 + LIKELIHOOD_SHARE * float(np.log(2.0))
    torch.testing.assert_close(sure, torch.tensor(expected))


def test_a_soft_mode_that_is_as_good_is_as_likely() -> None:
    """Two equal modes: the likelihood is best when they share the probability."""
    equal = two_modes()[:, :1].expand(-1, 2, -1, -1)
    even = soft_mode_loss(equal, torch.tensor([[0.5, 0.5]]), FUTURE, VALID)
    assert even < soft_mode_loss(equal, torch.tensor([[0.8, 0.2]]), FUTURE, VALID)
    assert even < soft_mode_loss(equal, torch.tensor([[0.2, 0.8]]), FUTURE, VALID)
