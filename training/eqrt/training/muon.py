"""Muon: momentum made orthogonal for the hidden matrices, AdamW for everything else.

A matrix's averaged gradient G = U S V' is replaced by U V', so that every direction of it learns at
the same rate. U V' comes from a Newton-Schulz iteration, an odd polynomial of G that pushes all
singular values towards 1 (K. Jordan et al., "Muon: an optimizer for hidden layers", 2024), scaled
to the size of an AdamW step (J. Liu et al., "Muon is scalable for LLM training", 2025), so that one
learning rate and one weight decay serve all weights.

torch has a Muon, too. It iterates in bfloat16, which CPUs without bfloat16 units do several times
more slowly than float32, and one matrix at a time; here equal shapes go through as one batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import AdamW

MOMENTUM = 0.95
MIN_SIDE = 16
"""A matrix with a shorter side is a vector or two: AdamW's."""
_ADAM_RMS = 0.2  # what the entries of an AdamW step are, about
_STEPS = 5
_COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # Jordan's: steep at 0, then between 0.7 and 1.2
_TINY = 1e-7


class Muon(AdamW):
    """AdamW, but for hidden matrices: the `.weight`s with both sides of MIN_SIDE or more.

    Biases and scales decay not at all.
    """

    def __init__(self, network: nn.Module, lr: float, weight_decay: float) -> None:
        named = [(name, w) for name, w in network.named_parameters() if w.requires_grad]
        hidden = [weight for name, weight in named if _is_hidden(name, weight)]
        taken = set(map(id, hidden))
        rest = [weight for _, weight in named if id(weight) not in taken]
        groups: Sequence[dict[str, Any]] = [
            {"params": [w for w in rest if w.dim() >= 2], "weight_decay": weight_decay},
            {"params": [w for w in rest if w.dim() < 2], "weight_decay": 0.0},
            {"params": hidden, "weight_decay": weight_decay, "hidden": True},
        ]
        super().__init__([group for group in groups if group["params"]], lr=lr)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """One step on every weight that has a gradient."""
        if closure is not None:
            raise ValueError("Muon takes no closure")
        everything = self.param_groups
        hidden = [group for group in everything if group.get("hidden")]
        for group in hidden:
            self._step_hidden(group)
        self.param_groups = [group for group in everything if not group.get("hidden")]
        try:
            super().step()
        finally:
            self.param_groups = everything

    def _step_hidden(self, group: dict[str, Any]) -> None:
        by_shape: dict[torch.Size, list[Any]] = {}
        for matrix in group["params"]:
            if matrix.grad is not None:
                by_shape.setdefault(matrix.shape, []).append(matrix)
        for shape, matrices in by_shape.items():
            directions = orthogonalized(torch.stack([self._direction(m) for m in matrices]))
            rate = group["lr"] * _ADAM_RMS * max(shape) ** 0.5
            for matrix, direction in zip(matrices, directions, strict=True):
                matrix.mul_(1.0 - group["lr"] * group["weight_decay"])
                matrix.add_(direction, alpha=-rate)

    def _direction(self, matrix: nn.Parameter) -> Tensor:
        """Nesterov's momentum of the gradient."""
        gradient: Tensor = matrix.grad  # type: ignore[assignment]  # checked by the caller
        state = self.state[matrix]
        if "momentum" not in state:
            state["momentum"] = torch.zeros_like(gradient)
        momentum: Tensor = state["momentum"]
        momentum.lerp_(gradient, 1.0 - MOMENTUM)
        direction: Tensor = gradient.lerp(momentum, MOMENTUM)
        return direction


def orthogonalized(matrices: Tensor) -> Tensor:
    """The matrices (M, a, b) with singular values about 1 (0.7 to 1.2), and the same directions."""
    a, b, c = _COEFFICIENTS
    tall = matrices.shape[-2] > matrices.shape[-1]
    x = matrices.transpose(-1, -2) if tall else matrices
    x = x / (x.flatten(1).norm(dim=-1)[:, None, None] + _TINY)
    for _ in range(_STEPS):
        square = x @ x.transpose(-1, -2)
        x = a * x + torch.baddbmm(square, square, square, beta=b, alpha=c) @ x
    even: Tensor = x.transpose(-1, -2) if tall else x
    return even


def _is_hidden(name: str, weight: nn.Parameter) -> bool:
    return name.endswith(".weight") and weight.dim() == 2 and min(weight.shape) >= MIN_SIDE
