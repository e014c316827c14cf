"""The last check before a prediction leaves: finite, continuous and physically possible.

A target whose prediction fails falls back to constant turn rate and velocity (CTRV) from its own
history, alone, and says so. The limits are wide: they catch a broken model, not a bold one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.kinematics import constant_turn, fit_motion

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MAX_SPEED_MPS = 90.0
"""Above anything on a public road."""
MAX_ACCELERATION_MPS2 = 15.0
"""1.5 g, averaged over WINDOW_STEPS: tyres give about 1 g."""
WINDOW_STEPS = 5
"""Half a second: single steps may jitter by centimetres."""
START_M = 2.0
"""How far the first step may lie from where the target is and was going."""


@dataclass(frozen=True, slots=True)
class Guarded:
    """Trajectories that may be published."""

    trajectories: Float64
    """(B, K, H, 2) map frame."""
    probabilities: Float64
    """(B, K)"""
    accepted: Bool
    """(B,) False: this target fell back to CTRV."""
    velocity: Float64
    """(B, 2) m/s, fitted to the history."""


def guard(
    trajectories: Float64, probabilities: Float64, history: Float64, valid: Bool, dt_s: float
) -> Guarded:
    """Check trajectories (B, K, H, 2) against the targets' own histories (B, T, 2), map frame.

    The last step of every history must be valid.
    """
    velocity, turn_rate = fit_motion(history, valid, dt_s)
    position = history[:, -1]
    accepted = _possible(trajectories, probabilities, position, velocity, dt_s)
    if accepted.all():
        return Guarded(trajectories, probabilities, accepted, velocity)
    steps = trajectories.shape[2]
    course = constant_turn(position, velocity, turn_rate, steps, dt_s)[:, None]  # (B, 1, H, 2)
    certain = np.zeros_like(probabilities)
    certain[:, 0] = 1.0
    return Guarded(
        np.where(accepted[:, None, None, None], trajectories, course),
        np.where(accepted[:, None], probabilities, certain),
        accepted,
        velocity,
    )


def _possible(
    trajectories: Float64, probabilities: Float64, position: Float64, velocity: Float64, dt_s: float
) -> Bool:
    """(B,) whether every mode of a target is finite, continuous and within the limits."""
    finite: Bool = np.asarray(
        np.isfinite(trajectories).all(axis=(1, 2, 3)) & np.isfinite(probabilities).all(axis=1)
    )
    path = np.where(finite[:, None, None, None], trajectories, position[:, None, None])
    first = np.linalg.norm(path[:, :, 0] - (position + velocity * dt_s)[:, None], axis=-1)
    step = np.diff(path, axis=2) / dt_s  # (B, K, H - 1, 2) m/s
    speed = np.linalg.norm(step, axis=-1)
    window = min(WINDOW_STEPS, step.shape[2] - 1)
    change = np.linalg.norm(step[:, :, window:] - step[:, :, :-window], axis=-1) / (window * dt_s)
    within = (
        (first <= START_M).all(axis=1)
        & (speed <= MAX_SPEED_MPS).all(axis=(1, 2))
        & (change <= MAX_ACCELERATION_MPS2).all(axis=(1, 2))
    )
    sums = np.abs(np.where(finite[:, None], probabilities, 1.0).sum(axis=1) - 1.0) <= 1e-3
    return np.asarray(finite & within & sums)
