"""Histories to features: what the agents' own motion says (EqMotion's initialisation layer)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.canonical import masked
from eqrt.training.config import UNIT_M, ModelConfig
from eqrt.training.layers import cross, dot, length, mlp

SLOPE_STEPS = (5, 10, 20)
"""Velocity is fitted over the last half, one and two seconds."""
COURSE = 1
"""Index in SLOPE_STEPS of the mean course."""


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


def deviations(config: ModelConfig) -> int:
    """V, the vectors that say how a history deviates from its mean course."""
    return 2 * config.history_steps - 1 + len(SLOPE_STEPS)
