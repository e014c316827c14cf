"""The contract's inputs as the target sees them: everything in its own frame. Has no weights."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.canonical import (
    LaneDirection,
    canonical_from_tile,
    heading_vector,
    unit,
)
from eqrt.training.networks.config import UNIT_M, SceneConfig
from eqrt.training.networks.motion import COURSE, SLOPE_STEPS, MotionFit
from eqrt.training.networks.target_frame import one_step_heading, upright

TOKENS = ("line", "point")
"""What a token of the map is."""
_NEAR, _FAR = 1.0, 1.0 / UNIT_M
"""What brings metres of deviation to about 1, and tens of metres of place."""


@dataclass(frozen=True, slots=True)
class Seen:
    """A scene as the target sees it; only the last three know where that is."""

    agents: Tensor
    """(B, 1, N, .) where each agent is, how it moved, and when it was seen."""
    lanes: Tensor
    """(B, 1, Q, 3 L) the points of each centerline, and which exist; or (B, 1, Q L, 4) each point,
    and which way its line leads there."""
    valid: Tensor
    """(B, 1, N + Q) or (B, 1, N + Q L), 1 or 0: which agents, lines or points exist."""
    origin: Tensor
    """(B, 1, 1, 2) the target now, metres, tile frame."""
    turn: Tensor
    """(B, 2, 2) turns columns into the target's frame, so rows of it back into the tile's axes; a
    fraction of that where the sources of its heading contradict each other (`heading_vector`)."""
    velocity: Tensor
    """(B, 2, S) the target's fitted velocities, m/s, tile's axes."""


class TargetView(nn.Module):
    """Brings agents and lanes into the target's frame.

    Coordinates stand before everything else, (B, 2, ...): masks then spread over whole rows, and
    turning all vectors of a scene is one product.
    """

    def __init__(self, scene: SceneConfig, heading: str, frame: str, tokens: str) -> None:
        super().__init__()
        self.heading, self.frame, self.tokens = heading, frame, tokens
        self.motion = MotionFit(scene)
        self.lane_direction = LaneDirection(scene.centerline_points)
        self.of_agent = _of_agent(scene.history_steps)
        """(F, numbers of an agent): the F inputs of a perceptron that they make."""
        of_line = 2 * scene.centerline_points * [_FAR] + scene.centerline_points * [_NEAR]
        self.of_lane = torch.diag(torch.tensor(of_line if tokens == "line" else 2 * [_FAR, _NEAR]))
        """Likewise of a token of the map."""

    def forward(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> Seen:
        """The contract's inputs."""
        places = history.permute(0, 3, 1, 2)  # (B, 2, N, T)
        places = torch.where(history_valid.unsqueeze(1), places, 0.0)
        valid = history_valid.to(places.dtype).unsqueeze(1)  # (B, 1, N, T)
        motion = self.motion(places, valid)
        origin = motion.last[:, :, :1]  # (B, 2, 1, 1)

        points = centerlines.permute(0, 3, 1, 2) - origin  # (B, 2, Q, L)
        points = torch.where(centerlines_valid.unsqueeze(1), points, 0.0)
        points_valid = centerlines_valid.to(points.dtype).unsqueeze(1)
        lane = self.lane_direction(points, points_valid)
        turn = self._turn(places, history_valid, heading, motion.velocity, lane)

        place = motion.last - origin
        numbers = [motion.off_course, motion.change, motion.velocity, motion.relative, place]
        vectors = torch.cat(numbers, -1)
        lanes, lanes_valid = self._lanes(points, points_valid, turn)
        exists = valid.amax(-1)  # (B, 1, N)
        return Seen(
            agents=torch.cat([_turned(turn, vectors), valid], -1),
            lanes=lanes,
            valid=torch.cat([exists, lanes_valid], -1),
            origin=origin.view(-1, 1, 1, 2),
            turn=turn,
            velocity=motion.velocity[:, :, 0],
        )

    def _turn(
        self, places: Tensor, valid: Tensor, heading: Tensor, velocity: Tensor, lane: Tensor
    ) -> Tensor:
        """What turns columns into the target's frame, (B, 2, 2)."""
        if self.frame == "translated":
            return upright(heading)
        if self.heading == "one_step":
            history = places[:, :, 0].transpose(-1, -2)  # (B, T, 2)
            return canonical_from_tile(one_step_heading(history, valid[:, 0], heading, lane))
        moved = velocity[:, :, 0, COURSE]  # metres in one second
        return canonical_from_tile(heading_vector(moved, heading, lane))

    def _lanes(self, points: Tensor, valid: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
        """What is known of each token of the map, and which exist (B, 1, tokens)."""
        if self.tokens == "point":
            ways, defined = point_directions(points, valid)
            both = torch.stack([points, ways], -1).flatten(2, 3)  # (B, 2, Q L, 2)
            return _turned(turn, both), (valid * defined).flatten(2)
        lines = _turned(turn, points)  # (B, 1, Q, 2 L)
        return torch.cat([lines, valid], -1), valid.amax(-1)


def _of_agent(steps: int) -> Tensor:
    """(2 V + T, 2 W + T): what a perceptron reads of an agent, of the numbers that are at hand.

    Those of each coordinate, then which steps were seen. It reads one thing more than there is: how
    each velocity differs from the mean course, which is linear in them and costs no operator so.
    """
    sizes = [2 * steps - 1, len(SLOPE_STEPS), steps, 1]
    deviation, velocity, relative, place = torch.split(torch.eye(sum(sizes)), sizes)
    off_course = velocity - velocity[COURSE]
    near, far = torch.cat([deviation, off_course]), torch.cat([relative, velocity, place])
    axis = torch.cat([_NEAR * near, _FAR * far])
    seen = _NEAR * torch.eye(steps)
    whole: Tensor = torch.block_diag(axis, axis, seen)  # type: ignore[no-untyped-call]
    return whole


def _turned(turn: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (B, 2, M, V) -> (B, 1, M, 2 V), turned."""
    _, axes, count, numbers = vectors.shape
    turned = (turn @ vectors.flatten(2)).view(-1, axes, count, numbers)
    return turned.transpose(1, 2).reshape(-1, 1, count, axes * numbers)


def point_directions(points: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Unit direction (B, 2, Q, L) of the lane at each point, and where it is defined (B, 1, Q, L).

    To the next point; at a line's last valid point, from the previous one.
    """
    both = valid[..., 1:] * valid[..., :-1]
    step = ((points[..., 1:] - points[..., :-1]) * both).movedim(1, -1)
    step = unit(step).movedim(-1, 1)
    none, nowhere = torch.zeros_like(step[..., :1]), torch.zeros_like(both[..., :1])
    has_next = torch.cat([both, nowhere], -1)
    has_last = torch.cat([nowhere, both], -1)
    onward, from_last = torch.cat([step, none], -1), torch.cat([none, step], -1)
    return onward + (1.0 - has_next) * from_last, torch.maximum(has_next, has_last)
