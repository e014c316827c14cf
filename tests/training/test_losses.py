"""What is minimized."""

from __future__ import annotations

import numpy as np
import torch

from eqrt.training.losses import (
    FINAL_SHARE,
    LIKELIHOOD_SHARE,
    NEAREST_END_SHARE,
    SPREAD_SHARE,
    ade_loss,
    best_mode_loss,
    mode_displacement,
    nearest_end_loss,
    soft_mode_loss,
    spread_loss,
    whole_loss,
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


def test_the_mode_that_ends_nearest_is_pulled_though_another_was_nearer_on_the_way() -> None:
    """One 2 m off all the way; the other 6 m off first, and 1 m in the end."""
    modes = torch.zeros(1, 2, 4, 2)
    modes[0, 0, :, 0], modes[0, 1, 0, 1], modes[0, 1, 1, 1] = 2.0, 6.0, 1.0
    first = torch.tensor([[1.0, 0.0]])
    ade, fde = torch.tensor([2.0, 3.5]), torch.tensor([2.0, 1.0])
    surprise = -float((-(ade + fde)).softmax(-1)[1] * np.log(1e-6))
    nearest = 3.5 + NEAREST_END_SHARE * 1.0 + LIKELIHOOD_SHARE * surprise
    torch.testing.assert_close(nearest_end_loss(modes, first, FUTURE, VALID), torch.tensor(nearest))
    best = 2.0 + FINAL_SHARE * 2.0 + LIKELIHOOD_SHARE * surprise
    torch.testing.assert_close(soft_mode_loss(modes, first, FUTURE, VALID), torch.tensor(best))


def two_spreads() -> torch.Tensor:
    """Covariances of two_modes(): S = diag(9, 1) m^2 for the first, a huge one for the second."""
    shape = torch.stack([torch.diag(torch.tensor([9.0, 1.0])), 1e4 * torch.eye(2)])
    return 3.0 * shape[None, :, None].expand(1, 2, 4, 2, 2)


def test_the_spread_is_judged_by_the_mode_that_ends_nearest_over_the_seen_steps() -> None:
    """3 m off along an axis of 3 m: m = 1, and |S|^1/2 = 3."""
    loss = spread_loss(two_modes(), two_spreads(), FUTURE, VALID)
    expected = 1.0 + np.log(2 * np.pi * 3.0)
    torch.testing.assert_close(loss, torch.tensor(float(expected)))


def test_the_spread_that_suits_the_errors_is_best() -> None:
    """For errors of 1 m in all directions, ln(s^2) + 1/s is least at s = 1/2."""
    angles = torch.arange(8) * (torch.pi / 4)
    truth = torch.stack([angles.cos(), angles.sin()], -1)[:, None]  # (8, 1, 2)
    modes, valid = torch.zeros(8, 1, 1, 2), torch.ones(8, 1, dtype=torch.bool)

    def loss(scale_m: float) -> float:
        covariances = (3.0 * scale_m**2 * torch.eye(2)).expand(8, 1, 1, 2, 2)
        return float(spread_loss(modes, covariances, truth, valid))

    assert loss(0.5) < min(loss(0.45), loss(0.55))


def test_trajectories_learn_nothing_from_the_spread() -> None:
    modes = two_modes().requires_grad_()
    spreads = two_spreads().clone().requires_grad_()
    with_spread = whole_loss(ade_loss, [modes, torch.ones(1, 2), spreads], FUTURE, VALID)
    with_spread.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    learned = modes.grad
    modes.grad = None
    alone = whole_loss(ade_loss, [modes, torch.ones(1, 2)], FUTURE, VALID)
    alone.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    assert learned is not None
    assert modes.grad is not None
    torch.testing.assert_close(learned, modes.grad)
    assert spreads.grad is not None
    assert spreads.grad[0, 0].abs().sum() > 0.0
    assert spreads.grad[0, 1].abs().sum() == 0.0  # not the best mode
    share = spread_loss(two_modes(), two_spreads(), FUTURE, VALID)
    torch.testing.assert_close(with_spread - alone, SPREAD_SHARE * share)


def test_a_future_that_was_never_seen_says_nothing_about_the_spread() -> None:
    unseen = torch.zeros_like(VALID)
    assert float(spread_loss(two_modes(), two_spreads(), FUTURE, unseen)) == 0.0
