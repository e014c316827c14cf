"""Features of the target to trajectories."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eqrt.training.config import ModelConfig
from eqrt.training.layers import GatedVectorMlp, mlp
from eqrt.training.motion import SLOPE_STEPS, deviations

BASIS = 6
"""Smooth functions of time that a trajectory is made of."""


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
