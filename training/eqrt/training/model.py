"""The paper's predictor: an equivariant network over agents, plus a canonicalised map.

    history ----> geometric features (turn) ----+--> P feature-learning layers --> decoder
         \\-----> pattern features (do not) -----+          ^
    centerlines -> canonical frame -> transformer -> fused into pattern; lane vectors into geometric

Inputs and outputs are contract version 1. Inside, lengths are in units of UNIT_M, and positions are
relative to the target's last seen position, so nothing depends on where the tile lies.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.core.contract import ModelContract
from eqrt.training.canonical import (
    canonical_from_tile,
    heading_vector,
    last_valid,
    masked,
)
from eqrt.training.layers import (
    FeatureLearning,
    GatedVectorMlp,
    InteractionReasoning,
    Pairs,
    cross,
    dot,
    length,
    mlp,
    relations,
)
from eqrt.training.map_encoder import PointTransformer, point_directions

UNIT_M = 10.0
"""Network units: features of traffic (speeds per second, gaps) are about 1."""
SLOPE_STEPS = (5, 10, 20)
"""Velocity is fitted over the last half, one and two seconds."""


COURSE = 1
"""Index in SLOPE_STEPS of the mean course."""
BASIS = 6
"""Smooth functions of time that a trajectory is made of."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """What the network is; travels in the checkpoint."""

    num_agents: int
    history_steps: int
    num_centerlines: int
    centerline_points: int
    horizon_steps: int
    num_modes: int
    dt_s: float
    layers: int
    """P, feature-learning layers."""
    channels: int
    """C, vectors per agent."""
    width: int
    """D, pattern width."""
    categories: int
    """R, interaction categories."""
    token_width: int
    """Width of a map token, a multiple of `heads`."""
    heads: int
    pointers: int
    """Lane vectors handed from the map to the target."""
    dropout: float
    """Share of pattern updates dropped while training."""

    def contract(self, name: str, version: str) -> ModelContract:
        """The contract an artifact of this network promises."""
        return ModelContract(
            name=name,
            version=version,
            num_agents=self.num_agents,
            history_steps=self.history_steps,
            num_centerlines=self.num_centerlines,
            centerline_points=self.centerline_points,
            horizon_steps=self.horizon_steps,
            num_modes=self.num_modes,
            dt_s=self.dt_s,
        )


class EquivariantPredictor(nn.Module):
    """Rotated map, point transformer, EqMotion layers (row 6 of the paper's table)."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.motion = MotionInit(config)
        self.dropout = nn.Dropout(config.dropout)
        self.map = PointTransformer(config.token_width, config.heads, config.pointers, config.width)
        self.fuse = nn.Linear(config.channels + config.pointers, config.channels, bias=False)
        self.interaction = InteractionReasoning(config.channels, config.width, config.categories)
        self.layers = nn.ModuleList(
            FeatureLearning(config.channels, config.width, config.categories, config.dropout)
            for _ in range(config.layers)
        )
        self.decoder = Decoder(config)

    def forward(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Contract version 1: trajectories (B, K, H, 2) tile frame, probabilities (B, K)."""
        history = masked(history, history_valid)
        last = last_valid(history, history_valid)  # (B, N, 2)
        origin = last[:, 0]  # (B, 2) the target, now
        motion = self.motion(history, history_valid, last)
        geometric, pattern = self.fuse_map(motion, origin, heading, centerlines, centerlines_valid)

        exists = history_valid.any(-1)  # (B, N)
        apart = ~torch.eye(exists.shape[1], dtype=torch.bool, device=exists.device)
        pair_valid = (exists.unsqueeze(1) & apart).to(geometric.dtype).unsqueeze(-1)
        offset = geometric.unsqueeze(1) - geometric.unsqueeze(2)
        relation = relations((last - last[:, :1]) / UNIT_M, motion.velocity[..., 1])
        weights = self.interaction(torch.cat([length(offset), relation], -1), pattern)
        pairs = Pairs(weights, relation, pair_valid)
        for layer in self.layers:
            geometric, pattern = layer(geometric, pattern, pairs)

        trajectories, probabilities = self.decoder(
            geometric[:, 0], pattern[:, 0], motion.velocity[:, 0], motion.deviation
        )
        return origin[:, None, None, :] + UNIT_M * trajectories, probabilities

    def fuse_map(
        self,
        motion: MotionFeatures,
        origin: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Read the map from the target's own frame; hand it to the target's features."""
        points = (centerlines - origin[:, None, None, :]) / UNIT_M
        points = masked(points, centerlines_valid)  # (B, Q, L, 2)
        direction, has_direction = point_directions(points, centerlines_valid)
        points, direction = points.flatten(1, 2), direction.flatten(1, 2)  # (B, P, 2)
        valid = (centerlines_valid & has_direction).flatten(1)  # (B, P)
        distance2 = points.square().sum(-1) * UNIT_M**2
        moved = (
            motion.velocity[:, 0, :, 1] * UNIT_M
        )  # (B, 2) metres in a second, over the last second
        canonical = canonical_from_tile(heading_vector(moved, heading, direction, distance2, valid))
        tokens = torch.cat([points @ canonical, direction @ canonical], -1)  # (B, P, 4) invariant
        feature, lanes = self.map(tokens, valid, masked(points, valid), motion.pattern[:, 0])

        target = torch.cat([motion.geometric[:, 0], lanes], -1)  # (B, 2, C + pointers) turns
        geometric = torch.cat([self.fuse(target).unsqueeze(1), motion.geometric[:, 1:]], 1)
        pattern = torch.cat(
            [(motion.pattern[:, 0] + self.dropout(feature)).unsqueeze(1), motion.pattern[:, 1:]], 1
        )
        return geometric, pattern


def deviations(config: ModelConfig) -> int:
    """V, the vectors that say how a history deviates from its mean course."""
    return 2 * config.history_steps - 1 + len(SLOPE_STEPS)


@dataclass(frozen=True, slots=True)
class MotionFeatures:
    """What the agents' histories say."""

    geometric: Tensor
    """(B, N, 2, C) network units, relative to the target."""
    pattern: Tensor
    """(B, N, D)"""
    velocity: Tensor
    """(B, N, 2, S) velocities fitted over SLOPE_STEPS, network units per second."""
    deviation: Tensor
    """(B, 2, V) how the target's history deviates from its mean course: vectors, see MotionInit."""


class MotionInit(nn.Module):
    """EqMotion's initialisation layer, with masks.

    Geometric: bias-free mixing of the steps of each history. Pattern: speeds, changes of speed and
    direction between steps, which steps were seen.

    A history is taken apart into its mean course (the velocity fitted over a second) and how it
    deviates from it. The deviations are where braking and turning show; they are centimetres beside
    tens of metres, so they are handed on in metres, not in network units.
    """

    time: Tensor
    """(T,) seconds, the last is 0."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        steps = config.history_steps
        self.dt_s = config.dt_s
        time = torch.arange(1 - steps, 1) * config.dt_s
        self.register_buffer("time", time, persistent=False)
        self.mix = nn.Linear(deviations(config) + 1, config.channels, bias=False)
        self.gate = nn.Linear(config.width, config.channels)
        invariants = steps + (steps - 1) + 2 * (steps - 2) + 3 * len(SLOPE_STEPS)
        self.pattern = mlp([invariants, config.width, config.width])

    def forward(self, history: Tensor, valid: Tensor, last: Tensor) -> MotionFeatures:
        """Masked history (B, N, T, 2), valid (B, N, T), last seen positions (B, N, 2)."""
        relative = masked((history - last.unsqueeze(2)) / UNIT_M, valid).transpose(2, 3)
        both = valid[..., 1:] & valid[..., :-1]  # (B, N, T - 1)
        step = (relative[..., 1:] - relative[..., :-1]) * both.unsqueeze(2) / self.dt_s
        slopes = self._slopes(relative, valid)  # (B, N, 2, S)
        course = slopes[..., COURSE : COURSE + 1]  # (B, N, 2, 1)
        off_course = (relative - course * self.time) * valid.unsqueeze(2)
        change = (step - course) * both.unsqueeze(2)
        deviation = UNIT_M * torch.cat([off_course, change, slopes - course], -1)  # (B, N, 2, V)
        pattern = self.pattern(self._invariants(step, slopes, valid))
        mixed = self.mix(torch.cat([course, deviation], -1))  # (B, N, 2, C)
        mixed = mixed * (1.0 + self.gate(pattern).unsqueeze(-2))
        place = ((last - last[:, :1]) / UNIT_M) * valid.any(-1).unsqueeze(-1)  # (B, N, 2)
        return MotionFeatures(mixed + place.unsqueeze(-1), pattern, slopes, deviation[:, 0])

    def _slopes(self, relative: Tensor, valid: Tensor) -> Tensor:
        """Least-squares velocities (B, N, 2, S) over the seen steps of each window; 0 for one."""
        time = self.time
        window = torch.stack([(time > -(n - 0.5) * self.dt_s).to(time) for n in SLOPE_STEPS])
        weight = valid.unsqueeze(-2).to(relative.dtype) * window  # (B, N, S, T)
        count = weight.sum(-1, keepdim=True).clamp(min=1.0)
        centred = (time - (weight * time).sum(-1, keepdim=True) / count) * weight
        spread = (centred * time).sum(-1, keepdim=True)  # 0 with one seen step
        weight = centred / spread.clamp(min=0.25 * self.dt_s**2)
        return relative @ weight.transpose(-1, -2)

    def _invariants(self, step: Tensor, slopes: Tensor, valid: Tensor) -> Tensor:
        """(B, N, I): speeds, accelerations along and across, curvature; what was seen."""
        before, after = step[..., :-1], step[..., 1:]
        speed = length(before) + 0.1  # m/s / UNIT_M: standing does not divide by 0
        other = slopes.roll(1, -1)
        return torch.cat(
            [
                valid.to(step.dtype),
                length(step),
                UNIT_M * dot(after - before, before) / speed,  # m/s per step, along
                UNIT_M * cross(before, after) / speed,  # and across
                length(slopes),
                dot(slopes, other),
                cross(slopes, other) * UNIT_M,
            ],
            -1,
        )


class Decoder(nn.Module):
    """Vectors of the target -> K trajectories around its constant-velocity course.

    A trajectory is a sum of BASIS smooth functions of time, each 0 now: what the network cannot
    draw, it need not learn to avoid.

    The course is a bias-free mixture of the target's own fitted velocities, chosen by its pattern
    features; how it deviated from its course so far carries on linearly; the rest is the gated
    perceptron's. All of it turns with the world.
    """

    time: Tensor
    """(H,) seconds."""
    basis: Tensor
    """(BASIS, H)"""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.modes, self.steps = config.num_modes, config.horizon_steps
        hidden, width = config.channels, config.width
        self.vectors = GatedVectorMlp([hidden, hidden, hidden, hidden, self.modes * BASIS], width)
        self.carry_on = nn.Linear(deviations(config), self.modes * BASIS, bias=False)
        nn.init.zeros_(self.carry_on.weight)  # training starts from the mean course
        self.course = nn.Linear(width, len(SLOPE_STEPS))
        self.logits = mlp([width, width, self.modes])
        time = torch.arange(1, self.steps + 1) * config.dt_s
        self.register_buffer("time", time, persistent=False)
        self.register_buffer("basis", _basis(self.steps), persistent=False)

    def forward(
        self, geometric: Tensor, pattern: Tensor, velocity: Tensor, deviation: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Geometric (B, 2, C), pattern (B, D), velocity (B, 2, S), deviation (B, 2, V).

        Returns trajectories (B, K, H, 2) relative to the target, network units, and probabilities
        (B, K); the most probable mode first.
        """
        share = self.course(pattern).softmax(-1).unsqueeze(-2)  # (B, 1, S)
        course = (velocity * share).sum(-1, keepdim=True) * self.time  # (B, 2, H)
        coefficients = self.vectors(geometric, pattern) + self.carry_on(deviation)
        offset = coefficients.unflatten(-1, (self.modes, BASIS)) @ self.basis  # (B, 2, K, H)
        trajectories = (course.unsqueeze(2) + offset).permute(0, 2, 3, 1)
        probabilities = self.logits(pattern).softmax(-1)
        if self.modes == 1:
            return trajectories, probabilities
        probabilities, order = probabilities.topk(self.modes, dim=-1)
        order = order[..., None, None].expand(-1, -1, self.steps, 2)
        return trajectories.gather(1, order), probabilities


def _basis(steps: int) -> Tensor:
    """(BASIS, H): s T_k(2 s - 1) with the Chebyshev polynomials T_k, s from 1 / H to 1."""
    share = torch.arange(1, steps + 1, dtype=torch.float64) / steps
    angle = torch.arccos((2 * share - 1).clamp(-1.0, 1.0))
    rows = [share * torch.cos(k * angle) for k in range(BASIS)]
    return torch.stack(rows).to(torch.get_default_dtype())
