"""What the agents' own histories say: a mean course, and how they left it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.canonical import masked
from eqrt.training.networks.config import UNIT_M, SceneConfig

SLOPE_STEPS = (5, 10, 20)
"""Velocity is fitted over the last half, one and two seconds."""
COURSE = 1
"""Index in SLOPE_STEPS of the mean course."""


@dataclass(frozen=True, slots=True)
class FittedMotion:
    """Histories taken apart; all of it turns with the world."""

    velocity: Tensor
    """(B, N, 2, S) velocities fitted over SLOPE_STEPS, network units per second."""
    vectors: Tensor
    """(B, N, 2, V) where each agent was before its last place, and how it left its mean course."""


class MotionFit(nn.Module):
    """Fits each agent's mean course, and keeps how it deviates from it (no weights).

    The deviations are where braking and turning show; they are centimetres beside tens of metres,
    so they are handed on in metres, not in network units.
    """

    time: Tensor
    """(T,) seconds, the last is 0."""

    def __init__(self, scene: SceneConfig) -> None:
        super().__init__()
        self.dt_s = scene.dt_s
        time = torch.arange(1 - scene.history_steps, 1) * scene.dt_s
        self.register_buffer("time", time, persistent=False)

    def forward(self, history: Tensor, valid: Tensor, last: Tensor) -> FittedMotion:
        """Masked history (B, N, T, 2), valid (B, N, T), last seen positions (B, N, 2)."""
        relative = masked((history - last.unsqueeze(2)) / UNIT_M, valid).transpose(2, 3)
        both = (valid[..., 1:] & valid[..., :-1]).unsqueeze(2)  # (B, N, 1, T - 1)
        step = (relative[..., 1:] - relative[..., :-1]) / self.dt_s
        slopes = fitted_slopes(relative, valid, self.time, self.dt_s)  # (B, N, 2, S)
        course = slopes[..., COURSE : COURSE + 1]
        off_course = UNIT_M * (relative - course * self.time) * valid.unsqueeze(2)
        change = UNIT_M * (step - course) * both
        vectors = [relative, off_course, change, slopes, UNIT_M * (slopes - course)]
        return FittedMotion(slopes, torch.cat(vectors, -1))


def fitted_vectors(scene: SceneConfig) -> int:
    """V of FittedMotion."""
    return 3 * scene.history_steps - 1 + 2 * len(SLOPE_STEPS)


def fitted_slopes(relative: Tensor, valid: Tensor, time: Tensor, dt_s: float) -> Tensor:
    """Least-squares velocities (B, N, 2, S) over the seen steps of each window; 0 for one step.

    relative (B, N, 2, T), valid (B, N, T), time (T,) in seconds.
    """
    window = torch.stack([(time > -(n - 0.5) * dt_s).to(time) for n in SLOPE_STEPS])
    weight = valid.unsqueeze(-2).to(relative.dtype) * window  # (B, N, S, T)
    count = weight.sum(-1, keepdim=True).clamp(min=1.0)
    centred = (time - (weight * time).sum(-1, keepdim=True) / count) * weight
    spread = (centred * time).sum(-1, keepdim=True)  # 0 with one seen step
    weight = centred / spread.clamp(min=0.25 * dt_s**2)
    return relative @ weight.transpose(-1, -2)
