"""Where the target stands and which way it faces: the frame that things are read in.

The paper takes the direction of the target's last displacement (`one_step`). It is the noisiest of
all, and undefined for a target that stands; there, the measured heading or else the nearest lane
decides (`eqrt.training.networks.canonical`). `robust` is the motion of the last second, mixed with
these.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.canonical import (
    LaneDirection,
    canonical_from_tile,
    heading_vector,
    last_valid,
    length,
    masked,
    unit,
)
from eqrt.training.networks.config import UNIT_M
from eqrt.training.tables import check_choice

FRAMES = ("translated", "rotated")
"""What is done to positions: `translated` to the target only, or also `rotated` to its heading."""
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


class TargetFrame(nn.Module):
    """Brings centerlines into the target's frame. Has no weights."""

    def __init__(self, frame: str, heading: str, dt_s: float, centerline_points: int) -> None:
        """Raise ValueError for a choice that is not in FRAMES, HEADINGS."""
        super().__init__()
        check_choice("frame", frame, FRAMES)
        check_choice("heading", heading, HEADINGS)
        self.rotated = frame == "rotated"
        self.robust = heading == "robust"
        self.dt_s = dt_s
        self.lane_direction = LaneDirection(centerline_points)

    def forward(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> MapPoints:
        """The target's masked history (B, T, 2), and the contract's inputs for the map."""
        origin = last_valid(history, history_valid)  # (B, 2)
        points = masked(centerlines - origin[:, None, None, :], centerlines_valid)
        if not self.rotated:
            return MapPoints(points / UNIT_M, centerlines_valid, upright(origin))
        facing = self._facing(history, history_valid, heading, points, centerlines_valid)
        tile_from_frame = canonical_from_tile(facing).transpose(-1, -2)
        turned = points.flatten(1, 2) @ tile_from_frame  # rows: turned by its transpose
        return MapPoints(turned.view_as(points) / UNIT_M, centerlines_valid, tile_from_frame)

    def _facing(
        self, history: Tensor, valid: Tensor, heading: Tensor, points: Tensor, points_valid: Tensor
    ) -> Tensor:
        """The unit heading (B, 2); (0, 0) where nothing defines one. Points in metres."""
        valid_here = points_valid.unsqueeze(1).to(points.dtype)
        lane = self.lane_direction(points.permute(0, 3, 1, 2), valid_here)
        if self.robust:
            moved = fitted_velocity(history, valid, self.dt_s)  # metres in one second
            return heading_vector(moved, heading, lane)
        return one_step_heading(history, valid, heading, lane)


def upright(origin: Tensor) -> Tensor:
    """The frame (B, 2, 2) of targets at `origin` (B, 2) that is not turned at all."""
    identity = torch.eye(2, dtype=origin.dtype, device=origin.device)
    return identity.expand(origin.shape[0], 2, 2)


def one_step_heading(history: Tensor, valid: Tensor, heading: Tensor, lane: Tensor) -> Tensor:
    """The unit heading (B, 2) of the paper; (0, 0) where nothing defines one.

    The target's masked history (B, T, 2) in metres, valid (B, T), measured heading (B, 2) or 0,
    lane (B, 2): `canonical.LaneDirection`.
    """
    step = last_step(history, valid)
    standing = heading_vector(torch.zeros_like(step), heading, lane)
    return torch.where(length(step) > STILL_M, unit(step), standing)


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
