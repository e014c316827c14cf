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
    """Draws a shape per mode and step."""

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
        """Modes (B, K, W) -> (B, K, 3, H): S_xx, S_xy, S_yy, square metres, target's frame."""
        drawn = self.draw(queries).to(self.start.dtype).unflatten(-1, (3, BASIS))
        with exact(queries):
            scales, skew = torch.split(drawn @ self.basis, [2, 1], -2)  # (B, K, 2, H), (B, K, 1, H)
            limit = math.log(RANGE)
            scales = FLOOR_M + self.start * scales.clamp(-limit, limit).exp()
            a, b = torch.split(scales, 1, -2)
            c = self.start * skew.clamp(-RANGE, RANGE)
            return torch.cat([a * a, a * c, b * b + c * c], -2)


def tile_covariances(shape: Tensor, turn: Tensor) -> Tensor:
    """Covariances (B, K, H, 2, 2), square metres, in the tile's axes.

    Of shapes (B, K, 3, H) in the target's frame, which `turn` (B, 2, 2) turns columns into. A
    target without any direction has the zero matrix there: its spread is a circle, the
    only shape that is the same whichever way the world is turned. One whose sources contradict each
    other (`canonical.heading_vector`) has something in between.
    """
    heading = turn[:, 0]  # (B, 2)
    products = (heading.unsqueeze(2) * heading.unsqueeze(1)).flatten(1)  # (B, 4)
    turned = products @ turn.new_tensor(_TURNED) + turn.new_tensor(_CIRCLE)
    entries = shape.transpose(-1, -2) @ turned.view(-1, 1, 3, 4)  # (B, K, H, 4)
    return entries.view(-1, shape.shape[1], shape.shape[3], 2, 2)


def _turned() -> Tensor:
    """(4, 12) what products (xx, xy, yx, yy) of the heading make of S_xx, S_xy, S_yy (rows of 4).

    S lies along u = (x, y) and across v = (-y, x): S_xx u u' + S_xy (u v' + v u') + S_yy v v'. What
    the heading is short of length 1 goes to a circle of as large a trace.
    """
    xx, xy, _, yy = torch.eye(4)
    less = -0.5 * (xx + yy)
    along, across = [xx + less, xy, xy, yy + less], [yy + less, -xy, -xy, xx + less]
    return torch.stack([*along, -2 * xy, xx - yy, xx - yy, 2 * xy, *across], 1)


_TURNED = (COVARIANCE_OF_SHAPE * _turned()).tolist()
_CIRCLE = [0.5 * COVARIANCE_OF_SHAPE * one for one in (1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 1)]
