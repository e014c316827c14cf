"""Displacement errors, as the field defines them (Argoverse motion forecasting).

ADE: mean distance to the truth over the steps up to a horizon; FDE: distance at that horizon.

Of K modes, the *best* is the one that ends nearest to the truth, the more probable one on a tie.
minFDE is its FDE, and minADE is *its* ADE: so does the evaluation code of Argoverse 1 and 2, and so
do the papers that report on them. The least ADE of any mode would be smaller or equal, but would
take the two numbers from two different trajectories. With one mode, minADE is ADE and minFDE FDE.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

MISS_M = 2.0
"""A best mode that ends farther than this from the truth has missed it."""


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


def best_mode(distance: Float64) -> NDArray[np.intp]:
    """(B,) which mode ends nearest to the truth, of distances (B, K, H) in order of probability."""
    return np.asarray(np.argmin(distance[..., -1], axis=-1))


def min_fde(distance: Float64) -> Float64:
    """(B,) metres: FDE of the best mode, of distances (B, K, H)."""
    return np.asarray(distance[..., -1].min(axis=-1))


def min_ade(distance: Float64) -> Float64:
    """(B,) metres: ADE of the best mode (not the least ADE), of distances (B, K, H)."""
    best = best_mode(distance)[..., None, None]
    return np.asarray(np.take_along_axis(distance, best, axis=-2)[..., 0, :].mean(axis=-1))


def missed(distance: Float64) -> NDArray[np.bool_]:
    """(B,) whether every mode of distances (B, K, H) ends more than MISS_M from the truth."""
    return np.asarray(min_fde(distance) > MISS_M)


def miss_rate(distance: Float64) -> float:
    """The share, 0 to 1, of B targets that all K modes of distances (B, K, H) missed."""
    return float(missed(distance).mean())


def brier_min_fde(distance: Float64, probabilities: Float64) -> Float64:
    """(B,) metres: minFDE + (1 - p)^2, p the best mode's probability, of (B, K, H) and (B, K).

    The probabilities are made to sum to 1 over the K modes that are handed in.
    """
    share = probabilities / probabilities.sum(axis=-1, keepdims=True)
    best = np.take_along_axis(share, best_mode(distance)[..., None], axis=-1)[..., 0]
    return np.asarray(min_fde(distance) + np.square(1.0 - best))
