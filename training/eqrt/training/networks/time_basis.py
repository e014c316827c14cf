"""Smooth functions of time that a trajectory is made of.

What the network cannot draw, it need not learn to avoid.
"""

from __future__ import annotations

import torch
from torch import Tensor

BASIS = 6
"""How many."""


def time_basis(steps: int) -> Tensor:
    """(BASIS, H): s T_k(2 s - 1) with the Chebyshev polynomials T_k, s from 1 / H to 1."""
    share = torch.arange(1, steps + 1, dtype=torch.float64) / steps
    angle = torch.arccos((2 * share - 1).clamp(-1.0, 1.0))
    rows = [share * torch.cos(k * angle) for k in range(BASIS)]
    return torch.stack(rows).to(torch.get_default_dtype())
