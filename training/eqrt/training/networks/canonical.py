"""The target's own frame: where the map is turned to before the network reads it.

The paper turns the map by the angle of the target's last displacement. Ours is defined for every
target: the direction of its recent motion; where it hardly moved, the measured heading; where none
is given, the direction of the nearest lane. Each turns with the world, and so does the mixture.
No angle is ever formed: with the unit heading u, the rotation is [[u_x, u_y], [-u_y, u_x]].
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn

CRAWL_M = 0.3
"""Motion below this (per second) is sensor noise: it says nothing about heading."""
DRIVE_M = 1.2
"""Motion above this defines the heading alone. Between the two, the sources are mixed."""
CRAWL_SHARE = 0.01
"""What the slightest motion counts beside them: with nothing else, it must do."""
AGREED_SHARE = 0.5
"""Sources that weigh the same define a heading if they are up to 120 degrees apart."""
_TINY = 1e-3
"""A millimetre, where lengths meet zero. Constants below 1e-8 are not safe: the ONNX exporter's
optimiser takes an added one for zero and drops it."""
_MASKED = 1e9  # a finite infinity: a softmax over nothing must not become NaN


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
    return vectors / length(vectors).clamp(min=_TINY)


def length(vectors: Tensor) -> Tensor:
    """Lengths (..., 1) of vectors (..., 2)."""
    lengths: Tensor = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return lengths


class LaneDirection(nn.Module):
    """Which way the lanes nearest to each target lead (no weights)."""

    both: Tensor
    """(L, L): adds each point and the next; the last one has none."""
    onward: Tensor
    """(L, L): from each point to the next, likewise."""

    def __init__(self, centerline_points: int) -> None:
        super().__init__()
        here = torch.diag(torch.tensor([1.0] * (centerline_points - 1) + [0.0]))
        after = torch.diag(torch.ones(centerline_points - 1), -1)
        self.register_buffer("both", here + after, persistent=False)
        self.register_buffer("onward", after - here, persistent=False)

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """The unit vector (B, 2); (0, 0) without any lane.

        points (B, 2, Q, L): metres from the target, in its tile's axes, 0 where not valid; valid
        (B, 1, Q, L): 1 or 0. A lane's points are about evenly spaced, so steps need no other weight
        than nearness.
        """
        both = (valid @ self.both - 1.0).relu()
        step = (points @ self.onward) * both
        distance2 = (points * points).sum(1, keepdim=True)
        score = (both - 1.0) * _MASKED - distance2  # d metres away weighs exp(-d^2)
        near = score.flatten(1).softmax(-1)  # (B, P)
        return unit((step.flatten(2) @ near.unsqueeze(-1)).squeeze(-1))


def heading_vector(moved: Tensor, heading: Tensor, lane: Tensor) -> Tensor:
    """The heading (B, 2) of the targets: of length 1 or less, (0, 0) where nothing defines one.

    moved (B, 2): displacement over the last second, metres. heading (B, 2): measured, or 0. lane
    (B, 2): `LaneDirection`.

    Where motion points against the other source, as of a car that reverses, their mixture turns
    round between one speed and another. It must not jump: there it is shorter than 1, down to 0
    where they are equal and opposite, and comes out longer again on the other side.
    """
    standing = heading + (1.0 - length(heading)) * lane
    far = length(moved)
    weight = ((far - CRAWL_M) / (DRIVE_M - CRAWL_M)).clamp(CRAWL_SHARE, 1.0)
    by_motion = weight * moved / far.clamp(min=_TINY)
    by_place = (1.0 - weight) * standing
    mixed = by_motion + by_place
    agreed = AGREED_SHARE * (length(by_motion) + length(by_place))
    return mixed / torch.maximum(length(mixed), agreed).clamp(min=_TINY)


def canonical_from_tile(heading: Tensor) -> Tensor:
    """The rotation (B, 2, 2) that turns the unit heading (B, 2) onto +x, for columns: R @ p."""
    # (x, y) -> [[x, y], [-y, x]]
    parts = [[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, -1.0, 0.0]]
    return (heading @ heading.new_tensor(parts)).view(-1, 2, 2)
