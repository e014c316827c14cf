"""Where the target stands and which way it faces: the frame in which the map is read.

The paper takes the direction of the target's last displacement (`one_step`). It is the noisiest of
all, and undefined for a target that stands; there, the measured heading or else the nearest lane
decides (`eqrt.training.networks.canonical`). `robust` is the motion of the last second, mixed with
these.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from eqrt.training.networks.canonical import (
    canonical_from_tile,
    heading_vector,
    last_valid,
    masked,
    point_directions,
    unit,
)
from eqrt.training.networks.config import UNIT_M

FRAMES = ("translated", "rotated")
"""What is done to the map: `translated` to the target only, or also `rotated` to its heading."""
HEADINGS = ("one_step", "robust")
"""From which motion the heading is read."""
STILL_M = 0.02
"""A last displacement below this is no motion: 0.2 m/s at 10 Hz."""
WINDOW_S = 1.0
"""The motion of `robust` is fitted over this time."""


@dataclass(frozen=True, slots=True)
class MapPoints:
    """The centerlines as the target sees them."""

    points: Tensor
    """(B, Q, L, 2) network units, in the chosen frame; 0 where not valid."""
    valid: Tensor
    """(B, Q, L)"""
    tile_from_frame: Tensor
    """(B, 2, 2): turns vectors (B, 2, C) of the chosen frame back into the tile's axes."""


class TargetFrame:
    """Brings centerlines into the target's frame. Has no weights."""

    def __init__(self, frame: str, heading: str, dt_s: float) -> None:
        """Raise ValueError for a choice that is not in FRAMES, HEADINGS."""
        if frame not in FRAMES:
            raise ValueError(f"frame is {frame!r}, expected one of {', '.join(FRAMES)}")
        if heading not in HEADINGS:
            raise ValueError(f"heading is {heading!r}, expected one of {', '.join(HEADINGS)}")
        self.rotated = frame == "rotated"
        self.robust = heading == "robust"
        self.dt_s = dt_s

    def see(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> MapPoints:
        """The target's masked history (B, T, 2), and the contract's inputs for the map."""
        origin = last_valid(history, history_valid)  # (B, 2)
        points = masked(centerlines - origin[:, None, None, :], centerlines_valid) / UNIT_M
        if not self.rotated:
            upright = torch.eye(2, dtype=points.dtype, device=points.device)
            return MapPoints(points, centerlines_valid, upright.expand(points.shape[0], 2, 2))
        facing = self._facing(history, history_valid, heading, points, centerlines_valid)
        turn = canonical_from_tile(facing)
        turned = points.flatten(1, 2) @ turn
        return MapPoints(turned.view_as(points), centerlines_valid, turn)

    def _facing(
        self, history: Tensor, valid: Tensor, heading: Tensor, points: Tensor, points_valid: Tensor
    ) -> Tensor:
        """The unit heading (B, 2); (0, 0) where nothing defines one."""
        direction, has_direction = point_directions(points, points_valid)
        lanes = direction.flatten(1, 2)
        distance2 = points.flatten(1, 2).square().sum(-1) * UNIT_M**2
        lanes_valid = (points_valid & has_direction).flatten(1)
        if self.robust:
            moved = fitted_velocity(history, valid, self.dt_s)  # metres in one second
            return heading_vector(moved, heading, lanes, distance2, lanes_valid)
        step = last_step(history, valid)
        standing = heading_vector(torch.zeros_like(step), heading, lanes, distance2, lanes_valid)
        moves = step.square().sum(-1, keepdim=True) > STILL_M**2
        return torch.where(moves, unit(step), standing)


def last_step(history: Tensor, valid: Tensor) -> Tensor:
    """From the last seen position but one to the last, (B, 2); 0 if seen less than twice."""
    seen_later = valid.flip(-1).cumsum(-1).flip(-1)
    before = valid & (seen_later > 1)
    step = last_valid(history, valid) - last_valid(history, before)
    return masked(step, before.any(-1))


def fitted_velocity(history: Tensor, valid: Tensor, dt_s: float) -> Tensor:
    """Least-squares velocity (B, 2) in m/s of masked histories (B, T, 2) over the last second.

    0 if fewer than two steps of it were seen.
    """
    steps = history.shape[-2]
    time = torch.arange(1 - steps, 1, dtype=history.dtype, device=history.device) * dt_s
    weight = (valid & (time > -WINDOW_S - 0.5 * dt_s)).to(history.dtype)  # (B, T)
    count = weight.sum(-1, keepdim=True).clamp(min=1.0)
    centred = (time - (weight * time).sum(-1, keepdim=True) / count) * weight
    spread = (centred * time).sum(-1, keepdim=True)  # 0 with one seen step
    relative = masked(history - last_valid(history, valid).unsqueeze(-2), valid)
    return ((centred / spread.clamp(min=0.25 * dt_s**2)).unsqueeze(-1) * relative).sum(-2)
