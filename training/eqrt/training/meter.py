"""The losses of the steps done, looked at now and then: looking makes an accelerator wait."""

from __future__ import annotations

import math
import time

import torch
from torch import Tensor

from eqrt.core.errors import EqrtError
from eqrt.training.ranks import Ranks
from eqrt.training.state import TrainingState

_SMOOTHING = 0.98


class LossMeter:
    """Keeps the running mean of the loss, and sees to it that it stays a number."""

    def __init__(self, ranks: Ranks) -> None:
        self._ranks = ranks
        self._unseen: list[Tensor] = []

    def add(self, loss: Tensor, grad_norm: Tensor) -> None:
        """Of the step just done: the loss, and the length of its gradient."""
        self._unseen.append(torch.stack([loss.detach(), grad_norm.detach()]))

    def settle(self, state: TrainingState) -> None:
        """Bring `state.loss` up to date. All ranks must do so after the same step.

        Raises EqrtError that names the first step whose loss or gradient is not finite.
        """
        if not self._unseen:
            return
        values = self._ranks.mean(torch.stack(self._unseen)).tolist()
        first = state.step - len(values) + 1
        self._unseen.clear()
        for step, (loss, grad_norm) in enumerate(values, first):
            if not (math.isfinite(loss) and math.isfinite(grad_norm)):
                raise EqrtError(
                    f"training broke down at step {step}: loss {loss:g}, length of its gradient "
                    f"{grad_norm:g}; lower the learning rate or max_grad_norm (what was written at "
                    "the last evaluation is still good)"
                )
            before = loss if state.loss is None else state.loss
            state.loss = _SMOOTHING * before + (1.0 - _SMOOTHING) * loss


class Stopwatch:
    """Counts samples and the time spent training on them, pauses left out."""

    def __init__(self) -> None:
        self.samples = 0
        self.seconds = 0.0
        self._began = time.perf_counter()

    def lap(self, samples: int) -> float:
        """`samples` more are done; samples/s since the last lap or pause."""
        seconds = time.perf_counter() - self._began
        self.samples, self.seconds = self.samples + samples, self.seconds + seconds
        self.resume()
        return samples / seconds

    def resume(self) -> None:
        """Time counts from now."""
        self._began = time.perf_counter()
