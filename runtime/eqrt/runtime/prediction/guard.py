"""The last check before a prediction leaves: finite, continuous and physically possible.

A target whose prediction fails falls back to constant turn rate and velocity (CTRV) from its own
history, alone, and says so. So does a target that the model said nothing about (NaN). The limits
are wide: they catch a broken model, not a bold one.

A target that was just found goes by the velocity that the sensor measured: what the model, or a
fit, makes of so few steps is worse (docs/results.md). Where none is measured, the model has its say
from the second step on, and before that nothing is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.kinematics import FIT_STEPS, constant_turn, fit_motion
from eqrt.runtime.decoding.detections import ObjectClass

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MIN_STEPS = 4
"""Steps in the last second from which on a history says more than a measured velocity."""
START_M = 2.0
"""How far the first step may lie from where the target is and was going."""
WINDOW_STEPS = 5
"""Accelerations are means over half a second: single steps may jitter by centimetres."""
TURNING_MPS = 3.0
"""Slower than this, a limit of curvature would be one of centimetres."""
MAX_GAIN_MPS = 10.0
"""A target measured to be faster than its class allows may go on so, and this much faster."""
MAX_SPEED_MPS = 90.0
"""But never faster than anything on a public road."""
_SUM_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True)
class Limits:
    """What a class of road users can do, with room."""

    speed_mps: float
    along_mps2: float
    """Speeding up and braking: tyres on a dry road give about 10 m/s^2."""
    across_mps2: float
    """Turning."""
    curvature_per_m: float
    """One over the radius of the tightest turn."""


LIMITS = {
    ObjectClass.UNKNOWN: Limits(MAX_SPEED_MPS, 15.0, 15.0, np.inf),
    ObjectClass.CAR: Limits(MAX_SPEED_MPS, 15.0, 15.0, 0.5),
    ObjectClass.TRUCK: Limits(50.0, 13.0, 11.0, 0.35),
    ObjectClass.MOTORCYCLE: Limits(MAX_SPEED_MPS, 15.0, 15.0, 0.7),
    ObjectClass.BICYCLE: Limits(25.0, 10.0, 10.0, 1.5),
    ObjectClass.PEDESTRIAN: Limits(12.0, 10.0, 10.0, np.inf),
    ObjectClass.ANIMAL: Limits(25.0, 15.0, 15.0, np.inf),
    ObjectClass.STATIC: Limits(MAX_SPEED_MPS, 15.0, 15.0, np.inf),  # the sensor may be wrong
}
_TABLE = np.array(
    [
        (limits.speed_mps, limits.along_mps2, limits.across_mps2, limits.curvature_per_m)
        for _, limits in sorted(LIMITS.items())
    ]
)


@dataclass(frozen=True, slots=True)
class Guarded:
    """Trajectories that may be published."""

    trajectories: Float64
    """(B, K, H, 2) map frame."""
    probabilities: Float64
    """(B, K)"""
    covariances: Float64 | None
    """(B, K, H, 2, 2) NaN for a target that fell back; None from a model that predicts none."""
    accepted: Bool
    """(B,) False: this target fell back to CTRV."""
    velocity: Float64
    """(B, 2) m/s, fitted to the history, or as measured; NaN = not known, and `trajectories` stay
    where the target is.
    """


def guard(
    trajectories: Float64,
    probabilities: Float64,
    history: Float64,
    valid: Bool,
    dt_s: float,
    *,
    object_class: NDArray[np.uint8] | None = None,
    measured: Float64 | None = None,
    covariances: Float64 | None = None,
) -> Guarded:
    """Check trajectories (B, K, H, 2) against the targets' own histories (B, T, 2), map frame.

    The last step of every history must be valid. `object_class` (B,): None = unknown. `measured`:
    velocities (B, 2) in m/s over ground as the sensor says, NaN or None = it does not.
    """
    velocity, turn_rate = fit_motion(history, valid, dt_s)
    found, velocity = _just_found(velocity, measured, valid)
    position = history[:, -1]
    known = np.zeros(len(history), np.uint8) if object_class is None else object_class
    accepted = _finite(trajectories, probabilities, covariances)
    path = np.where(accepted[:, None, None, None], trajectories, position[:, None, None])
    accepted &= found | _possible(path, position, velocity, dt_s, known)
    by_model = accepted & ~found
    if by_model.all():
        return Guarded(trajectories, probabilities, covariances, accepted, velocity)
    course = constant_turn(position, velocity, turn_rate, trajectories.shape[2], dt_s)
    certain = np.zeros_like(probabilities)
    certain[:, 0] = 1.0
    if covariances is not None:
        covariances = np.where(by_model[:, None, None, None, None], covariances, np.nan)
    return Guarded(
        np.where(by_model[:, None, None, None], trajectories, course[:, None]),
        np.where(by_model[:, None], probabilities, certain),
        covariances,
        accepted,
        velocity,
    )


def _just_found(fitted: Float64, measured: Float64 | None, valid: Bool) -> tuple[Bool, Float64]:
    """(B,) which targets the model is not asked about yet, and the velocities (B, 2) of all."""
    unfitted = np.isnan(fitted[:, 0])
    if measured is None:
        return unfitted, fitted
    is_measured = np.linalg.norm(measured, axis=1) <= MAX_SPEED_MPS  # no for NaN
    found = unfitted | (is_measured & (valid[:, -FIT_STEPS:].sum(axis=1) < MIN_STEPS))
    return found, np.where((found & is_measured)[:, None], measured, fitted)


def _finite(trajectories: Float64, probabilities: Float64, covariances: Float64 | None) -> Bool:
    """(B,) numbers, probabilities that are none below zero and sum to one."""
    finite = np.isfinite(trajectories).all(axis=(1, 2, 3))
    finite &= (probabilities >= 0.0).all(axis=1)
    finite &= np.abs(probabilities.sum(axis=1) - 1.0) <= _SUM_TOLERANCE  # no for NaN and infinity
    if covariances is not None:
        finite &= np.isfinite(covariances).all(axis=(1, 2, 3, 4))
    return np.asarray(finite)


def _possible(
    path: Float64, position: Float64, velocity: Float64, dt_s: float, known: NDArray[np.uint8]
) -> Bool:
    """(B,) whether every mode of a target is continuous and within its class's limits."""
    first_m = np.linalg.norm(path[:, :, 0] - (position + velocity * dt_s)[:, None], axis=-1)
    step = np.diff(path, axis=2) / dt_s  # (B, K, H - 1, 2) m/s
    rows = _TABLE[np.minimum(known, len(_TABLE) - 1)]
    max_speed, *others = rows.T[..., None, None]  # (B, 1, 1) each
    measured = np.linalg.norm(velocity, axis=1)[:, None, None]
    max_speed = np.maximum(max_speed, np.minimum(measured + MAX_GAIN_MPS, MAX_SPEED_MPS))
    within = (np.linalg.norm(step, axis=-1) <= max_speed).all(axis=-1)
    within &= (first_m <= START_M) & _turns_possibly(step, dt_s, *others)
    return np.asarray(within.all(axis=1))


def _turns_possibly(
    step: Float64, dt_s: float, along: Float64, across: Float64, curvature: Float64
) -> Bool:
    """(B, K) whether the velocities (B, K, H - 1, 2) change as limits of (B, 1, 1) allow."""
    window = min(WINDOW_STEPS, step.shape[2] - 1)
    before, after = step[:, :, :-window], step[:, :, window:]
    change = (after - before) / (window * dt_s)
    total = before + after
    direction = total / np.maximum(np.linalg.norm(total, axis=-1), 1e-6)[..., None]
    speed = 0.5 * (np.linalg.norm(before, axis=-1) + np.linalg.norm(after, axis=-1))
    forward = np.abs((change * direction).sum(axis=-1))
    sideways = np.abs(change[..., 0] * direction[..., 1] - change[..., 1] * direction[..., 0])
    moving = np.maximum(speed, TURNING_MPS)
    most = np.minimum(across, curvature * moving**2)
    return np.asarray(((forward <= along) & (sideways <= most)).all(axis=-1))
