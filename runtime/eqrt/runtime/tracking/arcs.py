"""Steady planar motion: constant speed along and across, constant turn rate.

Such a motion traces an arc; every pose on it, and beyond it, follows from its two ends.
"""

from __future__ import annotations

import math

from eqrt.core.frames import Pose2


def arc(forward_m: float, turn_rad: float, left_m: float = 0.0) -> Pose2:
    """`before_from_after` of a steady motion: metres along (forward, left) while turning."""
    if abs(turn_rad) < 1e-6:
        sine, versine = 1.0, 0.5 * turn_rad
    else:
        sine, versine = math.sin(turn_rad) / turn_rad, (1.0 - math.cos(turn_rad)) / turn_rad
    return Pose2(sine * forward_m - versine * left_m, versine * forward_m + sine * left_m, turn_rad)


def between(start: Pose2, end: Pose2, fraction: float) -> Pose2:
    """Pose on the steady motion from `start` (0) to `end` (1), and beyond it."""
    forward_m, left_m, turn_rad = steady_motion(start, end)
    return start @ arc(fraction * forward_m, fraction * turn_rad, fraction * left_m)


def steady_motion(start: Pose2, end: Pose2) -> tuple[float, float, float]:
    """Metres forward, metres left and turn in radians of the arc that leads from start to end."""
    step = start.inverse() @ end
    half = 0.5 * step.yaw_rad
    cotangent = half / math.tan(half) if abs(half) > 1e-6 else 1.0
    return (
        cotangent * step.x_m + half * step.y_m,
        cotangent * step.y_m - half * step.x_m,
        step.yaw_rad,
    )
