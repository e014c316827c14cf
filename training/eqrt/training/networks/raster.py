"""Centerlines drawn into an image, inside the graph; and the CNN that reads it.

Boolean, as in the paper: a cell is 1 if a centerline passes through it. Drawn by scattering points,
close enough to each other that lines have no gaps, into an image of zeros. A point on the border of
two cells falls to either side by rounding, so what reads the image is equivariant except for that:
the grid is shifted by half a cell, so that the target's own axes are not such borders.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import torch
from torch import Tensor, nn

from eqrt.training.networks.layers import mlp

Pixels = Annotated[int, msgspec.Meta(ge=4, multiple_of=4)]
LONGEST_M = 100.0
"""Lines up to this length are drawn without gaps."""


class RasterEncoder(nn.Module):
    """Image -> two 3x3 convolutions, each with 2x2 max pooling -> perceptron -> feature."""

    def __init__(
        self, pixels: int, cell_m: float, points: int, channels: int, sizes: list[int]
    ) -> None:
        """`pixels`: of one side. `points`: L. `sizes`: widths of the perceptron's layers."""
        super().__init__()
        self.pixels, self.cell_m = pixels, cell_m
        self.per_step = samples_per_step(points, cell_m)
        self.first = nn.Conv2d(1, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        self.perceptron = mlp([channels * (pixels // 4) ** 2, *sizes])
        for layer in (self.first, self.second):  # twice as fast in this layout, pooling above all
            layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Masked points (B, Q, L, 2) in metres from the centre, valid (B, Q, L) -> (B, D)."""
        image = draw(points, valid, self.pixels, self.cell_m, self.per_step)
        image = _pooled(self.second(_pooled(self.first(image.unsqueeze(1)))))
        feature: Tensor = self.perceptron(image.flatten(1))
        return feature


def samples_per_step(points: int, cell_m: float) -> int:
    """How many samples from one point of a line to the next draw it without gaps."""
    return max(1, math.ceil(LONGEST_M / max(points - 1, 1) / cell_m))


def draw(points: Tensor, valid: Tensor, pixels: int, cell_m: float, per_step: int) -> Tensor:
    """Lines (B, Q, L, 2), metres -> image (B, pixels, pixels), 1 where a line passes, else 0.

    Row = y, column = x, both growing; the middle of cell [pixels // 2, pixels // 2] is (0, 0).
    """
    samples, samples_valid = densify(points, valid, per_step)
    cell = torch.floor(samples / cell_m + (pixels // 2 + 0.5))  # (B, S, 2)
    inside = samples_valid & (cell >= 0).all(-1) & (cell < pixels).all(-1)
    outside = pixels * pixels  # one cell more than the image has: what must not be seen
    index = torch.where(inside, cell[..., 1] * pixels + cell[..., 0], float(outside)).long()
    image = points.new_zeros(points.shape[0], outside + 1).scatter(1, index, 1.0)
    return image[:, :outside].view(-1, pixels, pixels)


def densify(points: Tensor, valid: Tensor, per_step: int) -> tuple[Tensor, Tensor]:
    """Samples (B, S, 2) along lines (B, Q, L, 2), and which exist (B, S).

    Every point, and `per_step - 1` more to each next point, where both are valid.
    """
    if per_step == 1:
        return points.flatten(1, 2), valid.flatten(1)
    share = torch.arange(1, per_step, dtype=points.dtype, device=points.device) / per_step
    step = points[..., 1:, :] - points[..., :-1, :]
    between = points[..., :-1, None, :] + share[:, None] * step.unsqueeze(-2)  # (B, Q, L-1, s, 2)
    both = (valid[..., 1:] & valid[..., :-1]).unsqueeze(-1).expand(between.shape[:-1])
    samples = torch.cat([points.flatten(1, 2), between.flatten(1, 3)], 1)
    return samples, torch.cat([valid.flatten(1), both.flatten(1)], 1)


def _pooled(image: Tensor) -> Tensor:
    # Pooled first: max and ReLU commute, and a quarter of the values is left to pass it.
    return nn.functional.relu(nn.functional.max_pool2d(image, 2))
