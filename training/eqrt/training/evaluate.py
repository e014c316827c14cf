"""How far predictions lie from what happened, beside constant velocity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from eqrt.core.errors import EqrtError
from eqrt.core.kinematics import constant_velocity
from eqrt.core.metrics import (
    calibration,
    displacement,
    error_table,
    min_ade,
    min_fde,
    miss_rate,
)
from eqrt.training.dataset.windows import Windows

INPUTS = ("history", "history_valid", "heading", "centerlines", "centerlines_valid")
"""The contract's, in the order in which a network takes them."""
_BATCH = 256


@dataclass(frozen=True, slots=True)
class Predicted:
    """What is said of W windows; tile frame."""

    trajectories: NDArray[np.float64]
    """(W, K, H, 2) metres, most probable mode first."""
    probabilities: NDArray[np.float64]
    """(W, K)"""
    end_covariances: NDArray[np.float64] | None = None
    """(W, K, 2, 2) square metres, at the horizon; None where none are predicted."""


def evaluate(network: nn.Module, windows: Windows, dt_s: float) -> dict[str, float]:
    """Errors over complete windows.

    ADE/FDE of the most probable mode at 1, 2, 3 s and the horizon's end (`horizons_s`), and if
    there are more also the best mode's `min_ade`, `min_fde` (metres) and `miss_rate` (0 to 1), at
    the end. Of a network that predicts covariances also `nll` (nats), `inside_50` and `inside_90`
    (0 to 1) there: how well it knows its errors (`eqrt.core.metrics.calibration`).
    """
    complete = _complete(windows)
    predicted = predict(network, complete)
    modes = predicted.trajectories
    table = _errors(modes, complete, modes.shape[1], dt_s)
    if predicted.end_covariances is not None:
        truth = complete.future.astype(np.float64)
        known = calibration(modes, predicted.probabilities, predicted.end_covariances, truth)
        table |= {name: float(values.mean()) for name, values in known.items()}
    return table


def evaluate_constant_velocity(windows: Windows, num_modes: int, dt_s: float) -> dict[str, float]:
    """The same table for constant velocity, whose one mode is then also the best of `num_modes`."""
    complete = _complete(windows)
    history = complete.history[:, 0].astype(np.float64)
    horizon = complete.future.shape[1]
    course = constant_velocity(history, complete.history_valid[:, 0], horizon)
    return _errors(course[:, None], complete, num_modes, dt_s)


def predict(network: nn.Module, windows: Windows) -> Predicted:
    """What the network says; it is in evaluation mode afterwards."""
    device = next(network.parameters()).device
    tensors = windows.tensors()
    parts: list[list[NDArray[np.float32]]] = []
    network.eval()
    with torch.no_grad():
        for start in range(0, len(windows), _BATCH):
            inputs = [tensors[name][start : start + _BATCH].to(device) for name in INPUTS]
            trajectories, probabilities, *covariances = network(*inputs)
            of_end = [values[:, :, -1] for values in covariances]  # all steps would fill the memory
            outputs = [trajectories, probabilities, *of_end]
            parts.append([output.cpu().numpy() for output in outputs])
    return Predicted(
        *(np.concatenate(pieces).astype(np.float64) for pieces in zip(*parts, strict=True))
    )


def _errors(
    trajectories: NDArray[np.float64], windows: Windows, num_modes: int, dt_s: float
) -> dict[str, float]:
    distance = displacement(trajectories, windows.future[:, None].astype(np.float64))  # (W, K, H)
    table = error_table(distance[:, 0], dt_s)
    if num_modes > 1:
        table["min_ade"] = float(min_ade(distance).mean())
        table["min_fde"] = float(min_fde(distance).mean())
        table["miss_rate"] = miss_rate(distance)
    return table


def _complete(windows: Windows) -> Windows:
    complete = windows.complete()
    if not len(complete):
        raise EqrtError(
            f"none of {len(windows)} windows has a whole history and future; evaluate on recordings"
            " that are longer than both together"
        )
    return complete
