"""One cycle of detections brought to the map frame: the ego's own motion taken out.

What a broken message may hold (not finite, further or faster than anything a sensor can see) comes
out as NaN.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.detections import Detections, VelocityKind
from eqrt.runtime.tracking.ego import EgoState

Float64 = NDArray[np.float64]

_MAX_RANGE_M = 1000.0
_MAX_SPEED_MPS = 150.0


class Measurements(NamedTuple):
    """Arrays share the axis D. Map frame, NaN = not known."""

    object_id: NDArray[np.int64]
    """(D,)"""
    is_new: NDArray[np.bool_]
    """(D,)"""
    range_m: Float64
    """(D,) from the sensor."""
    position: Float64
    """(D, 2) metres."""
    velocity: Float64
    """(D, 2) m/s over ground."""
    heading_rad: Float64
    """(D,) in [-pi, pi]."""
    length_m: Float64
    """(D,)"""
    width_m: Float64
    """(D,)"""
    object_class: NDArray[np.uint8]
    """(D,) `ObjectClass`."""
    existence: Float64
    """(D,) probability 0..1."""

    def take(self, which: NDArray[np.bool_]) -> Measurements:
        """Those marked True, (D,)."""
        if which.all():
            return self
        return Measurements._make(values[which] for values in self)


def measure(detections: Detections, ego: EgoState, ego_from_sensor: Pose2) -> Measurements:
    """The detections as seen from `ego`, the state at their timestamp."""
    map_from_sensor = ego.map_from_ego @ ego_from_sensor
    range_m = np.hypot(detections.position[:, 0], detections.position[:, 1])
    heading_rad = np.where(np.isfinite(detections.heading_rad), detections.heading_rad, np.nan)
    heading_rad = heading_rad + (np.pi + map_from_sensor.yaw_rad)
    return Measurements(
        object_id=detections.object_id,
        is_new=detections.is_new,
        range_m=range_m,
        position=map_from_sensor.apply(_below(_MAX_RANGE_M, range_m, detections.position)),
        velocity=_over_ground(detections, ego, ego_from_sensor),
        heading_rad=heading_rad % (2.0 * np.pi) - np.pi,
        length_m=detections.length_m,
        width_m=detections.width_m,
        object_class=detections.object_class,
        existence=detections.existence,
    )


def _over_ground(detections: Detections, ego: EgoState, ego_from_sensor: Pose2) -> Float64:
    """Velocities (D, 2) over ground in the map frame; NaN where only a part of them is known."""
    velocity = detections.velocity
    if detections.velocity_kind in (VelocityKind.NONE, VelocityKind.RADIAL):
        return np.full(velocity.shape, np.nan)
    speed_mps = np.hypot(velocity[:, 0], velocity[:, 1])
    velocity = ego_from_sensor.rotate(_below(_MAX_SPEED_MPS, speed_mps, velocity))
    if detections.velocity_kind is VelocityKind.RELATIVE:
        # The mount point's own velocity: that of the ego's reference point, and what turning adds.
        forward_mps, left_mps = ego.velocity
        velocity[:, 0] += forward_mps - ego.yaw_rate_rad_s * ego_from_sensor.y_m
        velocity[:, 1] += left_mps + ego.yaw_rate_rad_s * ego_from_sensor.x_m
    return ego.map_from_ego.rotate(velocity)


def _below(limit: float, length: Float64, vectors: Float64) -> Float64:
    """The vectors (D, 2) whose length (D,) is within the limit, else NaN."""
    return np.where((length <= limit)[:, None], vectors, np.nan)
