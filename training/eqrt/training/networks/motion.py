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
    vectors: tuple[Tensor, ...]
    """(B, 2, N, .) metres and m/s, V together: how each agent left its mean course, and how its
    course of half a second and of two seconds differs from it."""


class MotionFit(nn.Module):
    """Fits each agent's mean course, and keeps how it deviates from it (no weights).

    The deviations are where braking and turning show; they are centimetres beside tens of metres.
    """

    time: Tensor
    """(T,) seconds, the last is 0."""
    later: Tensor
    """(T, T): column t counts against a step the valid ones after it."""
    sums: Tensor
    """(T, 3 S): per window of SLOPE_STEPS, sums of 1, of t, and of t^2."""
    neighbours: Tensor
    """(T, T - 1): adds each two steps that follow each other."""
    change: Tensor
    """(T, T - 1): from each step to the next, per second."""

    def __init__(self, scene: SceneConfig) -> None:
        super().__init__()
        steps, self.dt_s = scene.history_steps, scene.dt_s
        time = torch.arange(1 - steps, 1) * scene.dt_s
        within = torch.stack([time > -(n - 0.5) * scene.dt_s for n in SLOPE_STEPS], -1).to(time)
        powers = [within * time.unsqueeze(-1) ** power for power in range(3)]
        before, after = torch.eye(steps)[:, :-1], torch.eye(steps)[:, 1:]
        constants = {
            "time": time,
            "later": torch.eye(steps) - torch.ones(steps, steps).tril(-1),
            "sums": torch.cat(powers, -1),
            "neighbours": before + after,
            "change": (after - before) / scene.dt_s,
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, history: Tensor, valid: Tensor) -> FittedMotion:
        """Masked history (B, 2, N, T) in metres, valid (B, 1, N, T) 1 or 0."""
        is_last = (valid @ self.later).relu()  # 1 at the last valid step only
        last = (is_last * history).sum(-1, keepdim=True)
        relative = (history - last) * valid
        velocity = self._slopes(relative, valid)
        course = velocity[..., COURSE : COURSE + 1]
        off_course = (relative - course * self.time) * valid
        both = (valid @ self.neighbours - 1.0).relu()
        change = (off_course @ self.change) * both
        return FittedMotion(last, relative, velocity, (off_course, change, velocity - course))

    def _slopes(self, relative: Tensor, valid: Tensor) -> Tensor:
        """Least-squares velocities (B, 2, N, S) over the seen steps of each window; 0 for one."""
        count, time, time2 = (valid @ self.sums).chunk(3, -1)
        place, place_time = (relative @ self.sums[:, : 2 * len(SLOPE_STEPS)]).chunk(2, -1)
        spread = (count * time2 - time * time).clamp(min=0.25 * self.dt_s**2)
        return (count * place_time - time * place) / spread


def fitted_vectors(scene: SceneConfig) -> int:
    """V of FittedMotion."""
    return 2 * scene.history_steps - 1 + len(SLOPE_STEPS)
