"""How far predictions lie from what happened, beside constant velocity."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from eqrt.core.errors import EqrtError
from eqrt.core.kinematics import constant_velocity
from eqrt.core.metrics import displacement, error_table
from eqrt.training.data import Windows
from eqrt.training.model import EquivariantPredictor

INPUTS = ("history", "history_valid", "heading", "centerlines", "centerlines_valid")
_BATCH = 256


def evaluate(model: EquivariantPredictor, windows: Windows) -> dict[str, float]:
    """ADE/FDE at 1, 2, 3 s of the most probable mode, over complete windows, metres."""
    complete = _complete(windows)
    best = predict(model, complete)[:, 0].astype(np.float64)
    return error_table(displacement(best, complete.future.astype(np.float64)), model.config.dt_s)


def evaluate_constant_velocity(windows: Windows, dt_s: float) -> dict[str, float]:
    """The same table for constant velocity."""
    complete = _complete(windows)
    future = complete.future.astype(np.float64)
    history = complete.history[:, 0].astype(np.float64)
    course = constant_velocity(history, complete.history_valid[:, 0], future.shape[1])
    return error_table(displacement(course, future), dt_s)


def _complete(windows: Windows) -> Windows:
    complete = windows.complete()
    if not len(complete):
        raise EqrtError(
            f"none of {len(windows)} windows has a whole history and future; evaluate on recordings"
            " that are longer than both together"
        )
    return complete


def predict(model: EquivariantPredictor, windows: Windows) -> NDArray[np.float32]:
    """Trajectories (W, K, H, 2), tile frame."""
    tensors = windows.tensors()
    parts = []
    model.eval()
    with torch.no_grad():
        for start in range(0, len(windows), _BATCH):
            inputs = [tensors[name][start : start + _BATCH] for name in INPUTS]
            parts.append(model(*inputs)[0].numpy())
    return np.concatenate(parts)
