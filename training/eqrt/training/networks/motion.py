"""What the agents' own histories say: a mean course, and how they left it.

Coordinates stand before agents and steps, (B, 2, N, T): masks then spread over contiguous rows, and
everything is a product with a small constant matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.config import SceneConfig

SLOPE_STEPS = (5, 10, 20)
"""Velocity is fitted over the last half, one and two seconds."""
COURSE = 1
"""Index in SLOPE_STEPS of the mean course."""


@dataclass(frozen=True, slots=True)
class FittedMotion:
    """Histories taken apart; all of it turns with the world."""

    last: Tensor
    """(B, 2, N, 1) metres, where each agent was last seen; 0 for one that never was."""
    relative: Tensor
    """(B, 2, N, T) metres, where it was before, from there; 0 where not seen."""
    velocity: Tensor
    """(B, 2, N, S) m/s, fitted over SLOPE_STEPS."""
    off_course: Tensor
    """(B, 2, N, T) metres, how it left its mean course; 0 where not seen."""
    change: Tensor
    """(B, 2, N, T - 1) m/s, of that from step to step; 0 where one of the two was not seen."""


class MotionFit(nn.Module):
    """Fits each agent's mean course, and keeps how it deviates from it (no weights).

    The deviations are where braking and turning show; they are centimetres beside tens of metres.
    """

    later: Tensor
    """(T, T): column t counts against a step the valid ones after it."""
    sums: Tensor
    """(T, 2 S): per window of SLOPE_STEPS, sums of 1, then of t."""
    squares: Tensor
    """(T, 2 S): likewise of t^2, then of t."""
    places: Tensor
    """(T, 2 S): likewise of t, then of 1."""
    difference: Tensor
    """(2 S, S): the first half minus the second."""
    course: Tensor
    """(S, T): where the mean course was at each step, seconds."""
    neighbours: Tensor
    """(T, T - 1): adds each two steps that follow each other."""
    steps: Tensor
    """(T, T - 1): from each step to the next, per second."""

    def __init__(self, scene: SceneConfig) -> None:
        super().__init__()
        steps, windows = scene.history_steps, len(SLOPE_STEPS)
        time = torch.arange(1 - steps, 1) * scene.dt_s
        within = torch.stack([time > -(n - 0.5) * scene.dt_s for n in SLOPE_STEPS], -1).to(time)
        one, by_time, by_time2 = (within * time.unsqueeze(-1) ** power for power in range(3))
        before, after = torch.eye(steps)[:, :-1], torch.eye(steps)[:, 1:]
        constants = {
            "later": torch.eye(steps) - torch.ones(steps, steps).tril(-1),
            "sums": torch.cat([one, by_time], -1),
            "squares": torch.cat([by_time2, by_time], -1),
            "places": torch.cat([by_time, one], -1),
            "difference": torch.cat([torch.eye(windows), -torch.eye(windows)]),
            "course": torch.eye(windows)[:, COURSE : COURSE + 1] * time,
            "neighbours": before + after,
            "steps": (after - before) / scene.dt_s,
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)
        self._least_spread = 0.25 * scene.dt_s**2

    def forward(self, history: Tensor, valid: Tensor) -> FittedMotion:
        """Masked history (B, 2, N, T) in metres, valid (B, 1, N, T) 1 or 0."""
        is_last = (valid @ self.later).relu()  # 1 at the last valid step only
        last = (is_last * history).sum(-1, keepdim=True)
        relative = (history - last) * valid
        velocity = self._slopes(relative, valid)
        off_course = (relative - velocity @ self.course) * valid
        both = (valid @ self.neighbours - 1.0).relu()
        change = (off_course @ self.steps) * both
        return FittedMotion(last, relative, velocity, off_course, change)

    def _slopes(self, relative: Tensor, valid: Tensor) -> Tensor:
        """Least-squares velocities (B, 2, N, S) over the seen steps of each window; 0 for one."""
        sums = valid @ self.sums
        spread = (sums * (valid @ self.squares)) @ self.difference
        along = (sums * (relative @ self.places)) @ self.difference
        return along / spread.clamp(min=self._least_spread)
