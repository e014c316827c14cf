"""Two predictions of the same targets: how far they are apart, and whether that is too far.

Lengths are allowed a millimetre, and what float32 cannot resolve at that distance from zero:
0.06 mm within 1 km. Modes of almost equal probability may come in another order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.prediction.predictor import Prediction, disagreement

TRAJECTORY_M = 1e-3
PROBABILITY = 1e-4
LARGEST_M = 2000.0
COVARIANCE = 1e-2
"""As a share of the covariance (`disagreement`)."""

Float64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """Between two predictions of one target."""

    where: str
    """Which scene."""
    trajectory_m: float
    """Largest in any mode, step and axis."""
    allowed_m: float
    probability: float
    covariance: float
    """0 where the model predicts none."""
    allowed_covariance: float

    @property
    def failures(self) -> list[str]:
        """What is too large, in words."""
        parts = (
            (self.trajectory_m, self.allowed_m, "trajectories differ by", " m"),
            (self.probability, PROBABILITY, "probabilities differ by", ""),
            (self.covariance, self.allowed_covariance, "covariances differ by a share of", ""),
        )
        return [
            f"{self.where}: {what} {found:.3g}{unit}, allowed {allowed:.3g}{unit}"
            for found, allowed, what, unit in parts
            if not found <= allowed
        ]

    @property
    def excess(self) -> float:
        """Above 1 if something is too large."""
        return max(
            self.trajectory_m / self.allowed_m,
            self.probability / PROBABILITY,
            self.covariance / self.allowed_covariance,
        )


def differences(
    names: Sequence[str],
    found: Prediction,
    expected: Prediction,
    *,
    base_m: float = TRAJECTORY_M,
    covariance: float = COVARIANCE,
) -> list[Difference]:
    """Per target, its scene's name given, and what is allowed.

    Float32's resolution is added to `base_m`.
    """
    return [
        Difference(
            where=name,
            trajectory_m=_largest(found.trajectories[row, order] - expected.trajectories[row]),
            allowed_m=base_m
            + resolution_m(found.trajectories[row])
            + resolution_m(expected.trajectories[row]),
            probability=_largest(found.probabilities[row, order] - expected.probabilities[row]),
            covariance=_of_covariances(found, expected, row, order),
            allowed_covariance=covariance,
        )
        for row, name in enumerate(names)
        for order in (_same_modes(found, expected, row),)
    ]


def _of_covariances(
    found: Prediction, expected: Prediction, row: int, order: NDArray[np.intp]
) -> float:
    if expected.covariances is None or found.covariances is None:
        return 0.0
    share = disagreement("covariances", found.covariances[row, order], expected.covariances[row])
    return share if share >= 0.0 else np.inf


def resolution_m(positions: NDArray[np.floating]) -> float:
    """Half the distance between neighbouring float32 at the largest coordinate.

    No prediction from within a kilometre leads farther than LARGEST_M: nonsense excuses nothing.
    """
    largest = np.abs(positions[np.isfinite(positions)]).max(initial=0.0)
    return 0.5 * float(np.spacing(np.float32(min(largest, LARGEST_M))))


def _same_modes(found: Prediction, expected: Prediction, row: int) -> NDArray[np.intp]:
    """For every expected mode the found one: of those as probable, the nearest."""
    modes = found.probabilities.shape[1]
    # (found modes, expected modes)
    distance = _apart(found.trajectories[row][:, None] - expected.trajectories[row])
    level = np.abs(found.probabilities[row][:, None] - expected.probabilities[row]) <= PROBABILITY
    order, free = np.arange(modes), np.ones(modes, np.bool_)
    for mode in range(modes):
        candidates = np.flatnonzero(level[:, mode] & free)
        if not len(candidates):
            return np.arange(modes)  # no reordering explains this
        order[mode] = candidates[np.argmin(distance[candidates, mode])]
        free[order[mode]] = False
    return order


def _apart(offset: Float64) -> Float64:
    return np.asarray(np.abs(np.where(np.isfinite(offset), offset, np.inf)).max(axis=(-2, -1)))


def _largest(values: NDArray[np.floating]) -> float:
    """Infinite if there is any value that is not a number."""
    return float(np.abs(values).max()) if np.isfinite(values).all() else np.inf
