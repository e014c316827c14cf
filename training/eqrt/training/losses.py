"""Losses. Lengths in metres; masks True = seen."""

from __future__ import annotations

import torch
from torch import Tensor

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
