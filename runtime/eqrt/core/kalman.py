"""A Kalman filter of constant velocity: what a classical tracker would predict.

The state of a target is its position and velocity. Between two steps the velocity changes by white
noise; a step that was seen is a measurement of the position. Both axes have the same noise, so they
share their covariance, and the result does not depend on the frame: three numbers per target are
the whole of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

POSITION_STD_M = 0.2
"""Of a measured position: what automotive radars and cameras do at medium range."""
ACCELERATION_STD_MPS2 = 2.0
"""Constant between two steps, independent from one to the next: braking and cornering."""
FIRST_SPEED_STD_MPS = 15.0
"""Of a velocity of which nothing is known yet."""


def kalman_velocity(history: Float64, valid: Bool, dt_s: float) -> tuple[Float64, Float64]:
    """Position (B, 2) and velocity (B, 2) in m/s at the last step, from histories (B, T, 2).

    Steps that are not valid are predicted over; what stands there is never read. A target that was
    never seen is at the origin and stands.
    """
    batch, steps = valid.shape
    seen = np.where(valid[..., None], history, 0.0)
    position, velocity = np.zeros((batch, 2)), np.zeros((batch, 2))
    covariance = np.zeros((3, batch))
    started = np.zeros(batch, np.bool_)
    for step in range(steps):
        position, covariance = position + dt_s * velocity, _grown(covariance, dt_s)
        now = valid[:, step]
        position, velocity, covariance = _measured(
            seen[:, step], now & started, position, velocity, covariance
        )
        first = now & ~started
        position = np.where(first[:, None], seen[:, step], position)
        covariance = np.where(first, _FIRST[:, None], covariance)
        started |= now
    return position, velocity


def kalman(history: Float64, valid: Bool, horizon_steps: int, dt_s: float) -> Float64:
    """Histories (B, T, 2), valid (B, T) -> positions (B, H, 2): the filtered velocity goes on."""
    position, velocity = kalman_velocity(history, valid, dt_s)
    ahead_s = np.arange(1, horizon_steps + 1)[None, :, None] * dt_s
    return np.asarray(position[:, None] + velocity[:, None] * ahead_s)


def _grown(covariance: Float64, dt_s: float) -> Float64:
    """(3, B) of position, of position with velocity, of velocity: one step without measurement."""
    of_position, of_both, of_velocity = covariance
    noise = ACCELERATION_STD_MPS2**2 * dt_s**2
    return np.stack(
        [
            of_position + 2 * dt_s * of_both + dt_s**2 * (of_velocity + noise / 4),
            of_both + dt_s * (of_velocity + noise / 2),
            of_velocity + noise,
        ]
    )


def _measured(
    seen: Float64, now: Bool, position: Float64, velocity: Float64, covariance: Float64
) -> tuple[Float64, Float64, Float64]:
    """Take the measured positions (B, 2) of the targets `now` in."""
    of_position, of_both, of_velocity = covariance
    spread = of_position + POSITION_STD_M**2
    gain = np.where(now, covariance[:2] / spread, 0.0)  # (2, B) of position, of velocity
    surprise = seen - position
    return (
        position + gain[0][:, None] * surprise,
        velocity + gain[1][:, None] * surprise,
        np.stack(
            [
                of_position * (1.0 - gain[0]),
                of_both * (1.0 - gain[0]),
                of_velocity - gain[1] * of_both,
            ]
        ),
    )


_FIRST = np.array([POSITION_STD_M**2, 0.0, FIRST_SPEED_STD_MPS**2])
