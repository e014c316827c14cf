"""The target's own frame: where the map is turned to before the network reads it.

The paper turns the map by the angle of the target's last displacement. Ours is defined for every
target: the direction of its recent motion; where it hardly moved, the measured heading; where none
is given, the direction of the nearest lane. Each turns with the world, and so does the mixture.
No angle is ever formed: with the unit heading u, the rotation is [[u_x, u_y], [-u_y, u_x]].
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

CRAWL_M = 0.3
"""Motion below this (per second) is sensor noise: it says nothing about heading."""
DRIVE_M = 1.2
"""Motion above this defines the heading alone. Between the two, the sources are mixed."""
NEAR_M = 1.0
"""Scale of 'nearest' when lane directions are averaged around a standing target."""
_TINY = 1e-3
"""A millimetre, where lengths meet zero. Its square must stay well above 1e-8: the ONNX exporter's
optimiser takes an added constant below that for zero and drops it."""


def exact(like: Tensor) -> AbstractContextManager[object]:
    """Where positions are added and turned: no bfloat16, which knows 50 m in steps of 0.25 m.

    Without autocast (on the CPU, and when a graph is exported) it does nothing.
    """
    kind = like.device.type
    if torch.is_autocast_enabled(kind):
        return torch.autocast(kind, enabled=False)
    return nullcontext()


def masked(values: Tensor, valid: Tensor) -> Tensor:
    """Values (..., d), 0 where not valid (...). By `where`, so that NaN under False is gone."""
    return torch.where(valid.unsqueeze(-1), values, torch.zeros_like(values))


def last_valid(history: Tensor, valid: Tensor) -> Tensor:
    """Positions (..., 2) at the last valid step of histories (..., T, 2), already masked.

    An agent that was never seen is at 0.
    """
    seen_later = valid.flip(-1).cumsum(-1).flip(-1)  # valid steps from here to now
    is_last = valid & (seen_later == 1)
    return (history * is_last.unsqueeze(-1)).sum(-2)


def unit(vectors: Tensor) -> Tensor:
    """Vectors (..., 2) at length 1; one shorter than a millimetre fades to 0."""
    return vectors / (vectors.square().sum(-1, keepdim=True) + _TINY**2).sqrt()


@dataclass(frozen=True, slots=True)
class LaneDirections:
    """Which way the lanes around the targets lead; P points of all centerlines."""

    directions: Tensor
    """(B, P, 2) unit vectors."""
    distance2: Tensor
    """(B, P) squared distance of each point to the target, square metres."""
    valid: Tensor
    """(B, P) where there is a direction."""


def lane_directions(points: Tensor, valid: Tensor, unit_m: float) -> LaneDirections:
    """Of centerlines (B, Q, L, 2) relative to the targets, in units of `unit_m` metres.

    valid (B, Q, L): which points exist; the others are 0.
    """
    directions, defined = point_directions(points, valid)
    return LaneDirections(
        directions=directions.flatten(1, 2),
        distance2=points.square().sum(-1).flatten(1) * unit_m**2,
        valid=(valid & defined).flatten(1),
    )


def heading_vector(moved: Tensor, heading: Tensor, lanes: LaneDirections) -> Tensor:
    """The unit heading (B, 2) of the targets; (0, 0) where nothing defines one.

    moved (B, 2): displacement over the last second, metres. heading (B, 2): measured, or 0.
    """
    nearest = (-lanes.distance2 / (2 * NEAR_M**2)).masked_fill(~lanes.valid, -1e9).softmax(-1)
    lane = unit((lanes.directions * (nearest * lanes.valid).unsqueeze(-1)).sum(-2))
    measured = heading.square().sum(-1, keepdim=True).clamp(max=1.0)
    standing = measured * unit(heading) + (1.0 - measured) * lane
    length = (moved.square().sum(-1, keepdim=True) + _TINY**2).sqrt()
    motion = ((length - CRAWL_M) / (DRIVE_M - CRAWL_M)).clamp(0.0, 1.0)
    alone = 1.0 - standing.square().sum(-1, keepdim=True).clamp(max=1.0)
    weight = torch.maximum(motion, alone)  # with nothing else, the slightest motion must do
    return unit(weight * unit(moved) + (1.0 - weight) * standing)


def canonical_from_tile(heading: Tensor) -> Tensor:
    """The rotation (B, 2, 2) that turns the unit heading (B, 2) onto +x, for row vectors: p @ R."""
    x, y = heading[..., 0], heading[..., 1]
    return torch.stack([torch.stack([x, -y], -1), torch.stack([y, x], -1)], -2)


def point_directions(centerlines: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Unit direction (B, Q, L, 2) of the lane at each point, and where it is defined (B, Q, L).

    To the next point; at a line's last valid point, from the previous one.
    """
    step = centerlines[..., 1:, :] - centerlines[..., :-1, :]
    step_valid = valid[..., 1:] & valid[..., :-1]
    step = torch.where(step_valid.unsqueeze(-1), step, torch.zeros_like(step))
    step = unit(step)
    none = torch.zeros_like(step[..., :1, :])
    forward = torch.cat([step, none], -2)
    backward = torch.cat([none, step], -2)
    has_forward = torch.cat([step_valid, torch.zeros_like(step_valid[..., :1])], -1)
    has_backward = torch.cat([torch.zeros_like(step_valid[..., :1]), step_valid], -1)
    return torch.where(has_forward.unsqueeze(-1), forward, backward), has_forward | has_backward
