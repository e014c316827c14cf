"""Displacement errors, as the field defines them (Argoverse motion forecasting).

ADE: mean distance to the truth over the steps up to a horizon; FDE: distance at that horizon.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def displacement(trajectories: Float64, truth: Float64) -> Float64:
    """Distances (..., H) in metres between positions (..., H, 2)."""
    return np.asarray(np.linalg.norm(trajectories - truth, axis=-1))


def average_displacement(distance: Float64, steps: int) -> float:
    """ADE in metres over the first `steps` of distances (B, H)."""
    return float(distance[:, :steps].mean())


def final_displacement(distance: Float64, steps: int) -> float:
    """FDE in metres at step `steps` of distances (B, H)."""
    return float(distance[:, steps - 1].mean())


def error_table(
    distance: Float64, dt_s: float, seconds: tuple[int, ...] = (1, 2, 3)
) -> dict[str, float]:
    """`{"ade_1s": ..., "fde_1s": ..., ...}` in metres for distances (B, H)."""
    table: dict[str, float] = {}
    for horizon_s in seconds:
        steps = round(horizon_s / dt_s)
        table[f"ade_{horizon_s}s"] = average_displacement(distance, steps)
        table[f"fde_{horizon_s}s"] = final_displacement(distance, steps)
    return table
