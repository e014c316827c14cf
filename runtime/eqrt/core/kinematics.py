"""Prediction by physics alone: the baseline every figure is compared with, and the fallback.

Both are straight applications of a target's own history, in whatever frame it is given in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

BASELINE_STEPS = 5
"""Velocity of the baseline is the mean of the last half second."""
FIT_STEPS = 10
"""The fallback's velocity is fitted over the last second."""
TURNING_MPS = 2.0
"""Slower than this, a direction is mostly noise."""
MAX_TURN_RAD_S = 0.8
"""A tight turn at a junction; more is noise."""


def constant_velocity(history: Float64, valid: Bool, horizon_steps: int) -> Float64:
    """Histories (B, T, 2), valid (B, T) -> positions (B, H, 2): the mean recent velocity goes on.

    The velocity is the displacement between the last seen step and the first seen of the
    BASELINE_STEPS before it (or, where none of those was seen, the newest seen before them); a
    target seen once stands still. One step of the result is one step of the history.
    """
    batch, steps = valid.shape
    rows = np.arange(batch)
    last = steps - 1 - np.argmax(valid[:, ::-1], axis=1)
    first = _velocity_start(valid, last)
    spent = np.maximum(last - first, 1)[:, None]
    velocity = (history[rows, last] - history[rows, first]) / spent  # (B, 2) per step
    ahead = np.arange(1, horizon_steps + 1)[None, :, None]
    return np.asarray(history[rows, last][:, None] + velocity[:, None] * ahead)


def constant_turn(
    position: Float64,
    velocity: Float64,
    turn_rate_rad_s: Float64,
    horizon_steps: int,
    dt_s: float,
) -> Float64:
    """Constant turn rate and velocity (CTRV): (B, 2), (B, 2) m/s, (B,) -> positions (B, H, 2).

    What has no known velocity (NaN) stays where it is.
    """
    velocity = np.where(np.isnan(velocity), 0.0, velocity)
    time = np.arange(1, horizon_steps + 1)[None] * dt_s  # (1, H)
    turned = turn_rate_rad_s[:, None] * time
    along = time * np.sinc(turned / np.pi)  # sin(wt) / w, defined at w = 0
    across = time * np.sinc(turned / (2 * np.pi)) * np.sin(turned / 2)  # (1 - cos(wt)) / w
    left = np.stack([-velocity[:, 1], velocity[:, 0]], axis=-1)
    return np.asarray(
        position[:, None] + along[..., None] * velocity[:, None] + across[..., None] * left[:, None]
    )


def fit_motion(history: Float64, valid: Bool, dt_s: float) -> tuple[Float64, Float64]:
    """Velocity (B, 2) in m/s and turn rate (B,) in rad/s now, from histories (B, T, 2).

    The velocity is the least-squares slope over the last second, NaN where that has fewer than two
    valid steps. The turn rate compares it with the slope over the second before, and is 0 for a
    target too slow or too shortly seen to tell.
    """
    steps = valid.shape[1]
    half = min(FIT_STEPS, steps)
    now = _slope(history[:, -half:], valid[:, -half:], dt_s)
    before = _slope(history[:, :-half], valid[:, :-half], dt_s)
    apart_s = 0.5 * steps * dt_s  # between the middles of the two windows
    cross = before[:, 0] * now[:, 1] - before[:, 1] * now[:, 0]
    turned = np.arctan2(cross, (before * now).sum(-1))
    slower = np.minimum(np.linalg.norm(now, axis=1), np.linalg.norm(before, axis=1))
    turn_rate = np.clip(turned / apart_s, -MAX_TURN_RAD_S, MAX_TURN_RAD_S)
    return now, np.where(slower >= TURNING_MPS, turn_rate, 0.0)  # 0 where either is NaN


def _slope(history: Float64, valid: Bool, dt_s: float) -> Float64:
    """Least-squares velocity (B, 2) over the valid steps of (B, T, 2); NaN with fewer than two."""
    time = np.arange(valid.shape[1]) * dt_s
    count = valid.sum(axis=1, keepdims=True)
    mean = (valid * time).sum(axis=1, keepdims=True) / np.maximum(count, 1)
    centred = np.where(valid, time - mean, 0.0)
    spread = np.where(count < 2, np.nan, (centred**2).sum(axis=1, keepdims=True))
    seen = np.where(valid[..., None], history, 0.0)
    return np.asarray((centred[..., None] * seen).sum(axis=1) / spread)


def _velocity_start(valid: Bool, last: NDArray[np.intp]) -> NDArray[np.intp]:
    steps = np.arange(valid.shape[1])[None]
    before = valid & (steps < last[:, None])
    within = before & (steps >= last[:, None] - BASELINE_STEPS)
    earlier = valid.shape[1] - 1 - np.argmax(before[:, ::-1], axis=1)
    start = np.where(within.any(axis=1), np.argmax(within, axis=1), earlier)
    return np.asarray(np.where(before.any(axis=1), start, last))
