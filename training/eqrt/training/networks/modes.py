"""The last step of every network: its modes in the contract's order."""

from __future__ import annotations

import torch
from torch import Tensor


def most_probable_first(trajectories: Tensor, logits: Tensor | None) -> tuple[Tensor, Tensor]:
    """Trajectories (B, K, H, 2) and logits (B, K) -> both sorted, the logits as probabilities.

    A single mode has no logits (None): it is certain.
    """
    if logits is None:
        return trajectories, torch.ones_like(trajectories[:, :, 0, 0])
    probabilities, order = logits.softmax(-1).topk(trajectories.shape[1], dim=-1)
    order = order[..., None, None].expand(-1, -1, *trajectories.shape[2:])
    return trajectories.gather(1, order), probabilities
