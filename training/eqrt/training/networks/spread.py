"""How far a trajectory may be off: around every position an ellipse, which turns with the world.

The density at an offset is exp(-m) / (2 pi |S|^1/2), where m is the offset's Mahalanobis length
with the shape S: an exponential fall in every direction, since errors of predictions have far
longer tails than a Gaussian. Its covariance is 3 S (`eqrt.core.metrics`).

S is drawn as L L^T with a lower triangular factor L = [[a, 0], [c, b]] in the target's own frame: a
along its heading, b across. Each is a smooth function of time, and grows with time to start with.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from eqrt.core.metrics import COVARIANCE_OF_SHAPE
from eqrt.training.networks.canonical import exact
from eqrt.training.networks.layers import mlp
from eqrt.training.networks.time_basis import BASIS, time_basis

FLOOR_M = 0.03
"""Nothing is known better than this; a and b are above it."""
START_M, START_MPS = 0.1, 0.5
"""Training starts from a = b = START_M + START_MPS t."""
RANGE = 20.0
"""A factor is at most so many times larger or smaller than what training starts from.

It bounds how thin an ellipse can be: float32 still knows the area of one of 1 : 400.
"""


class SpreadDecoder(nn.Module):
    """Draws a factor per mode and step."""

    start: Tensor
    """(H,) metres, what training starts from."""
    basis: Tensor
    """(BASIS, H)"""

    def __init__(self, width: int, steps: int, dt_s: float) -> None:
        super().__init__()
        self.draw = mlp([width, 2 * width, 3 * BASIS])
        with torch.no_grad():
            list(self.draw.parameters())[-2].mul_(0.1)
        count = torch.arange(1, steps + 1)
        self.register_buffer("start", START_M + START_MPS * dt_s * count, persistent=False)
        # Those of trajectories are 0 now; the spread of a measured position is not.
        self.register_buffer("basis", time_basis(steps) / (count / steps), persistent=False)

    def forward(self, queries: Tensor) -> Tensor:
        """Modes (B, K, W) -> factors (B, K, H, 2, 2) in metres, in the target's frame."""
        drawn = self.draw(queries).to(self.start.dtype).unflatten(-1, (3, BASIS))
        with exact(queries):
            along, across, both = (drawn @ self.basis).unbind(-2)  # (B, K, H) each
            limit = math.log(RANGE)
            a = FLOOR_M + self.start * along.clamp(-limit, limit).exp()
            b = FLOOR_M + self.start * across.clamp(-limit, limit).exp()
            c = self.start * both.clamp(-RANGE, RANGE)
            rows = [torch.stack([a, torch.zeros_like(a)], -1), torch.stack([c, b], -1)]
            return torch.stack(rows, -2)


def tile_covariances(factor: Tensor, turn: Tensor) -> Tensor:
    """Covariances (B, K, H, 2, 2), square metres, in the tile's axes.

    Of factors (B, K, H, 2, 2) in the target's frame, which `turn` (B, 2, 2) turns columns into. A
    target without any direction has the zero matrix there: its spread is a circle, the
    only shape that is the same whichever way the world is turned.
    """
    turned = turn.transpose(-1, -2)[:, None, None] @ factor
    shape = turned @ turned.transpose(-1, -2)
    direction2 = turn[:, 0].square().sum(-1)  # (B,) 1, or 0 without any
    missing = (1.0 - direction2).clamp(min=0.0)[:, None, None]
    mean = 0.5 * missing * factor.square().sum((-1, -2))  # (B, K, H)
    circle = mean[..., None, None] * torch.eye(2, dtype=factor.dtype, device=factor.device)
    return COVARIANCE_OF_SHAPE * (shape + circle)
