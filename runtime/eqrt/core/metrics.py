"""Displacement errors, as the field defines them (Argoverse motion forecasting), and calibration.

ADE: mean distance to the truth over the steps up to a horizon; FDE: distance at that horizon.

Of K modes, the *best* is the one that ends nearest to the truth, the more probable one on a tie.
minFDE is its FDE, and minADE is *its* ADE: so does the evaluation code of Argoverse 1 and 2, and so
do the papers that report on them. The least ADE of any mode would be smaller or equal, but would
take the two numbers from two different trajectories. With one mode, minADE is ADE and minFDE FDE.

A predicted covariance C stands for an elliptical exponential distribution with the shape S = C / 3:
at a Mahalanobis length m = |S^-1/2 offset| its density is exp(-m) / (2 pi |S|^1/2), and the share
of it within m is 1 - (1 + m) exp(-m).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

SECONDS = (1.0, 2.0, 3.0)
"""The times that the field gives errors for."""
MISS_M = 2.0
"""A best mode that ends farther than this from the truth has missed it."""

COVARIANCE_OF_SHAPE = 3.0
"""Of the elliptical exponential distribution in the plane: its covariance is so many times S."""
LENGTH_OF_SHARE = {50: 1.6783469900, 90: 3.8897201698}
"""Percent -> the Mahalanobis length m with 1 - (1 + m) exp(-m) of it: an ellipse's size."""
_LEAST = 1e-12  # where a logarithm would meet zero


def displacement(trajectories: Float64, truth: Float64) -> Float64:
    """Distances (..., H) in metres between positions (..., H, 2)."""
    return np.asarray(np.linalg.norm(trajectories - truth, axis=-1))


def horizons_s(dt_s: float, horizon_steps: int) -> tuple[float, ...]:
    """The times that errors are given for: 1, 2, 3 s as far as they go, and the horizon's end."""
    end = round(horizon_steps * dt_s, 6)
    return (*(seconds for seconds in SECONDS if seconds < end), end)


def average_displacement(distance: Float64, steps: int) -> float:
    """ADE in metres over the first `steps` of distances (B, H)."""
    return float(distance[:, :steps].mean())


def final_displacement(distance: Float64, steps: int) -> float:
    """FDE in metres at step `steps` of distances (B, H)."""
    return float(distance[:, steps - 1].mean())


def error_table(
    distance: Float64, dt_s: float, seconds: Sequence[float] | None = None
) -> dict[str, float]:
    """`{"ade_1s": ..., "fde_1s": ..., ...}` in metres for distances (B, H).

    At `seconds`, ascending; None = `horizons_s`. Raises ValueError for one beyond the horizon.
    """
    horizon_steps = distance.shape[1]
    table: dict[str, float] = {}
    for horizon_s in horizons_s(dt_s, horizon_steps) if seconds is None else seconds:
        steps = round(horizon_s / dt_s)
        if not 1 <= steps <= horizon_steps:
            raise ValueError(f"no error at {horizon_s:g} s: {horizon_steps} steps of {dt_s:g} s")
        table[f"ade_{horizon_s:g}s"] = average_displacement(distance, steps)
        table[f"fde_{horizon_s:g}s"] = final_displacement(distance, steps)
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


def least_ade(distance: Float64) -> Float64:
    """(B,) metres: the least ADE of any mode, of distances (B, K, H); never above `min_ade`.

    nuScenes calls this minADE (its prediction challenge); it may be another mode's than `min_fde`.
    """
    return np.asarray(distance.mean(axis=-1).min(axis=-1))


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


def mahalanobis(offset: Float64, covariances: Float64) -> Float64:
    """Lengths m (...) of offsets (..., 2) in metres under covariances (..., 2, 2)."""
    shape, determinant = _shape(covariances)
    x, y = offset[..., 0], offset[..., 1]
    square = (
        shape[..., 1, 1] * x**2 - 2 * shape[..., 0, 1] * x * y + shape[..., 0, 0] * y**2
    ) / determinant
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def log_density(offset: Float64, covariances: Float64) -> Float64:
    """Logarithms (...) of the density per square metre at offsets (..., 2), likewise."""
    _, determinant = _shape(covariances)
    area = np.log(2 * np.pi) + 0.5 * np.log(determinant)
    return np.asarray(-mahalanobis(offset, covariances) - area)


def surprise(offset: Float64, covariances: Float64, probabilities: Float64) -> Float64:
    """(B,) nats: minus the logarithm of the density that all K modes together gave the truth.

    Of offsets (B, K, 2) from each mode to the truth in metres, covariances (B, K, 2, 2) and
    probabilities (B, K), made to sum to 1. Lower is better; being wrong and sure costs most.
    """
    share = probabilities / probabilities.sum(axis=-1, keepdims=True)
    of_mode = log_density(offset, covariances) + np.log(np.maximum(share, _LEAST))
    return np.asarray(-np.logaddexp.reduce(of_mode, axis=-1))


def inside(offset: Float64, covariances: Float64, percent: int) -> NDArray[np.bool_]:
    """(...) whether offsets (..., 2) lie in the ellipse that holds so many percent.

    `percent` is a key of LENGTH_OF_SHARE. Of a predictor that knows its errors, as many are inside.
    """
    return np.asarray(mahalanobis(offset, covariances) < LENGTH_OF_SHARE[percent])


def calibration(
    trajectories: Float64, probabilities: Float64, covariances: Float64, truth: Float64
) -> dict[str, Float64]:
    """How well a predictor knows its errors at the end of its horizon; each (B,).

    `nll` is the surprise of all modes, in nats; `inside_50` and `inside_90` whether the truth lies
    in these ellipses of the best mode, 1 or 0. Of trajectories (B, K, H, 2), probabilities (B, K),
    covariances (B, K, 2, 2) at the last step, and truth (B, H, 2).
    """
    offset = truth[:, None, -1] - trajectories[:, :, -1]  # (B, K, 2)
    best = best_mode(np.linalg.norm(offset, axis=-1, keepdims=True))[:, None]
    nearest = np.take_along_axis(offset, best[..., None], axis=1)[:, 0]
    spread = np.take_along_axis(covariances, best[..., None, None], axis=1)[:, 0]
    table = {"nll": surprise(offset, covariances, probabilities)}
    for percent in LENGTH_OF_SHARE:
        table[f"inside_{percent}"] = inside(nearest, spread, percent).astype(np.float64)
    return table


def _shape(covariances: Float64) -> tuple[Float64, Float64]:
    """Shapes S (..., 2, 2) and their determinants (...), which stay above zero."""
    shape = covariances / COVARIANCE_OF_SHAPE
    determinant = shape[..., 0, 0] * shape[..., 1, 1] - shape[..., 0, 1] * shape[..., 1, 0]
    return shape, np.maximum(determinant, _LEAST)
