"""Losses. Lengths in metres; masks True = seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from eqrt.core.metrics import COVARIANCE_OF_SHAPE

_TINY = 1e-6


def mode_displacement(trajectories: Tensor, future: Tensor, valid: Tensor) -> Tensor:
    """Mean distance (B, K) of trajectories (B, K, H, 2) to futures (B, H, 2) over seen steps."""
    offset = torch.where(valid[:, None, :, None], trajectories - future[:, None], 0.0)
    distance = (offset.square().sum(-1) + _TINY).sqrt() * valid[:, None]
    return distance.sum(-1) / valid.sum(-1).clamp(min=1)[:, None]


def best_mode_loss(
    trajectories: Tensor, probabilities: Tensor, future: Tensor, valid: Tensor
) -> Tensor:
    """ADE of the best mode, plus cross entropy on which mode that was.

    With one mode this is the paper's loss, the ADE.
    """
    distance = mode_displacement(trajectories, future, valid)  # (B, K)
    best, index = distance.min(-1)
    chosen = probabilities.gather(1, index[:, None]).clamp(min=_TINY)
    return best.mean() - 0.5 * chosen.log().mean()


def soft_mode_loss(
    trajectories: Tensor, probabilities: Tensor, future: Tensor, valid: Tensor
) -> Tensor:
    """The best mode is pulled to the truth, its end most; every mode learns how likely it is.

    Best is the mode with the least ADE plus half its final error. The likelihood to learn is soft:
    a mode that comes nearly as close as the best is nearly as right.
    """
    ade = mode_displacement(trajectories, future, valid)  # (B, K)
    fde = _final_displacement(trajectories, future, valid)
    pull = _of_least(ade + 0.5 * fde, ade + FINAL_SHARE * fde)
    return pull.mean() + LIKELIHOOD_SHARE * _surprise(ade + fde, probabilities)


def nearest_end_loss(
    trajectories: Tensor, probabilities: Tensor, future: Tensor, valid: Tensor
) -> Tensor:
    """As `soft_mode_loss`, but best is the mode that ends nearest, and its end counts less.

    Argoverse takes the ADE of that mode for minADE.
    """
    ade = mode_displacement(trajectories, future, valid)  # (B, K)
    fde = _final_displacement(trajectories, future, valid)
    pull = _of_least(fde, ade + NEAREST_END_SHARE * fde)
    return pull.mean() + LIKELIHOOD_SHARE * _surprise(ade + fde, probabilities)


SOFTNESS_M = 1.0
"""Modes whose errors differ by less are about as likely."""
FINAL_SHARE = 0.3
NEAREST_END_SHARE = 0.1
LIKELIHOOD_SHARE = 0.7


def _of_least(error: Tensor, value: Tensor) -> Tensor:
    """The value (B, 1) of the mode whose error is least; both (B, K)."""
    return value.gather(1, error.argmin(-1, keepdim=True))


def _surprise(error: Tensor, probabilities: Tensor) -> Tensor:
    """Cross entropy of the probabilities (B, K) with how likely modes of such errors are."""
    soft = (-error.detach() / SOFTNESS_M).softmax(-1)
    return -(soft * probabilities.clamp(min=_TINY).log()).sum(-1).mean()


def _final_displacement(trajectories: Tensor, future: Tensor, valid: Tensor) -> Tensor:
    """Distance (B, K) at the last seen step of the future."""
    steps = torch.arange(1, valid.shape[-1] + 1, device=valid.device)
    last = (valid * steps).argmax(-1)[:, None, None, None]  # (B, 1, 1, 1)
    end = trajectories.gather(2, last.expand(-1, trajectories.shape[1], 1, 2)).squeeze(2)
    offset = end - future.gather(1, last[:, 0].expand(-1, 1, 2))
    return (offset.square().sum(-1) + _TINY).sqrt()


def ade_loss(trajectories: Tensor, probabilities: Tensor, future: Tensor, valid: Tensor) -> Tensor:  # noqa: ARG001 (every loss is called alike)
    """ADE of the most probable mode: the paper's loss. Other modes learn nothing from it."""
    return mode_displacement(trajectories[:, :1], future, valid).mean()


Loss = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Of trajectories (B, K, H, 2), probabilities (B, K), future (B, H, 2), valid (B, H): the mean."""

LOSSES: Mapping[str, Loss] = {
    "ade": ade_loss,
    "best_mode": best_mode_loss,
    "soft_mode": soft_mode_loss,
    "nearest_end": nearest_end_loss,
}
"""What a configuration may name."""


SPREAD_SHARE = 0.1
"""Of `spread_loss` in the whole, for networks that predict covariances."""


def whole_loss(loss: Loss, outputs: Sequence[Tensor], future: Tensor, valid: Tensor) -> Tensor:
    """The loss of a network's outputs, all there are: `loss`, and that of covariances.

    Computed in float32: bf16 knows 50 m only in steps of 0.25 m, and the loss is about centimetres.
    """
    trajectories, probabilities, *covariances = (output.float() for output in outputs)
    total = loss(trajectories, probabilities, future, valid)
    for predicted in covariances:
        total = total + SPREAD_SHARE * spread_loss(trajectories, predicted, future, valid)
    return total


def spread_loss(trajectories: Tensor, covariances: Tensor, future: Tensor, valid: Tensor) -> Tensor:
    """How little the truth was expected where it was, in nats: the mean over seen steps.

    Of the mode that ends nearest to the truth: trajectories (B, K, H, 2), covariances
    (B, K, H, 2, 2), the distribution of `eqrt.core.metrics`. The trajectories learn nothing from
    it: being sure must not be worth more than being right.
    """
    trajectories = trajectories.detach()
    best = _final_displacement(trajectories, future, valid).argmin(-1)  # (B,)
    rows = torch.arange(len(best), device=best.device)
    shape = covariances[rows, best] / COVARIANCE_OF_SHAPE  # (B, H, 2, 2)
    offset = torch.where(valid[..., None], future - trajectories[rows, best], 0.0)
    xx, xy, yy = shape[..., 0, 0], shape[..., 0, 1], shape[..., 1, 1]
    x, y = offset[..., 0], offset[..., 1]
    determinant = (xx * yy - xy.square()).clamp(min=_TINY)
    square = (yy * x.square() - 2 * xy * x * y + xx * y.square()) / determinant
    length = (square.clamp(min=0.0) + _TINY).sqrt()
    surprise = (length + 0.5 * determinant.log() + math.log(2 * math.pi)) * valid
    return (surprise.sum(-1) / valid.sum(-1).clamp(min=1)).mean()
