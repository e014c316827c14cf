"""What a decoded sensor says: one closed cycle of detections, and the ego vehicle's own motion.

Arrays of one `Detections` share their first axis D (objects in the cycle). Every value is in the
sensor frame (x forward, y left, origin at the mount point), metres, radians, seconds; NaN means
that the sensor does not say. Times are seconds on the pipeline's clock: the log's clock when
replaying, the monotonic clock when serving.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2


class ObjectClass(IntEnum):
    """What an object is; the numbers are those of `eqrt.dbc` and of the generic input DBC."""

    UNKNOWN = 0
    CAR = 1
    TRUCK = 2
    MOTORCYCLE = 3
    BICYCLE = 4
    PEDESTRIAN = 5
    ANIMAL = 6
    STATIC = 7


class VelocityKind(IntEnum):
    """What a sensor's velocity is measured against."""

    NONE = 0
    """The sensor gives no velocity."""
    RELATIVE = 1
    """Against the moving sensor: a parked car ahead has minus our own speed."""
    ABSOLUTE = 2
    """Over ground, in the sensor's axes."""
    RADIAL = 3
    """Only the part along the line of sight is known (relative), given as a vector along it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Detections:
    """One closed cycle of one sensor."""

    sensor: str
    """Name of the sensor, unique within the profile."""
    timestamp_s: float
    """When it was measured: arrival of the cycle's first message minus the sensor's latency."""
    received_s: float
    """Arrival of the cycle's last message."""
    complete: bool
    """False if a timeout or the next cycle closed it before all messages had come."""
    object_id: NDArray[np.int64]
    """(D,) as the sensor numbers them, id offset of the profile added."""
    is_new: NDArray[np.bool_]
    """(D,) the sensor says that this id now belongs to a new object."""
    position: NDArray[np.float64]
    """(D, 2) metres."""
    velocity: NDArray[np.float64]
    """(D, 2) m/s, meaning as `velocity_kind` says."""
    velocity_kind: VelocityKind
    heading_rad: NDArray[np.float64]
    """(D,) direction the object faces."""
    length_m: NDArray[np.float64]
    """(D,)"""
    width_m: NDArray[np.float64]
    """(D,)"""
    object_class: NDArray[np.uint8]
    """(D,) `ObjectClass`."""
    existence: NDArray[np.float64]
    """(D,) probability 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoMotion:
    """Speed and yaw rate of the ego vehicle at one time; None where this message does not say."""

    timestamp_s: float
    speed_mps: float | None = None
    """Forward positive."""
    yaw_rate_rad_s: float | None = None
    """Counter-clockwise (to the left) positive, as measured: its bias is not removed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoPose:
    """The ego vehicle's pose in the map at one time, from an INS or another localisation."""

    timestamp_s: float
    map_from_ego: Pose2
