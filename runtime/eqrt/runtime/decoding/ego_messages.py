"""Messages about the ego vehicle to its motion and its pose, one group of messages at a time."""

from __future__ import annotations

import math

from eqrt.core.frames import Pose2, wrap_angle
from eqrt.runtime.decoding.dbc_tables import Payload
from eqrt.runtime.decoding.detections import EgoMotion, EgoPose
from eqrt.runtime.decoding.ego_profile import EgoProfile
from eqrt.runtime.decoding.geodesy import MapOrigin

_NEVER = float("-inf")
_NAN = float("nan")


class EgoDecoder:
    """Decodes the messages of one `[[ego]]` of the profile."""

    def __init__(self, profile: EgoProfile, origin: MapOrigin | None) -> None:
        """`origin`: of the map, for latitudes and longitudes; None = the first of them is it."""
        self._profile = profile
        self._origin = origin
        self._values = [[_NAN] * len(part.columns) for part in profile.parts]
        self._arrived_s = [_NEVER] * len(profile.parts)

    @property
    def is_geodetic(self) -> bool:
        """Whether it tells poses by latitude and longitude."""
        return "latitude" in self._profile.numbers

    def set_origin(self, origin: MapOrigin | None) -> None:
        """The map has another origin from now on, see `__init__`."""
        self._origin = origin

    def add(self, part: int, data: Payload, timestamp_s: float) -> list[EgoMotion | EgoPose]:
        """Take a message; the last one of the group tells, together with what is still fresh.

        Of a pose, only what came after the last one before: an old place at a new time is wrong.
        """
        profile = self._profile
        self._values[part] = [column.read(data) for column in profile.parts[part].columns]
        self._arrived_s[part] = timestamp_s
        if part < len(profile.parts) - 1:
            return []
        for other, arrived_s in enumerate(self._arrived_s):
            if not 0.0 <= timestamp_s - arrived_s <= profile.hold_s:
                self._values[other] = [_NAN] * len(self._values[other])
        events = self._told(timestamp_s)
        for column in profile.pose_columns:
            self._values[column.part][column.row] = _NAN
        return events

    def _told(self, arrived_s: float) -> list[EgoMotion | EgoPose]:
        events: list[EgoMotion | EgoPose] = []
        if self._profile.valid is not None and not self._profile.valid.holds(self._values):
            return events
        age_s = max(0.0, self._number("age") or 0.0)  # nothing is measured after it came
        timestamp_s = arrived_s - self._profile.latency_s - age_s
        speed, yaw_rate = self._number("speed"), self._number("yaw_rate")
        if speed is not None and self._profile.reverse is not None:
            speed = -speed if self._profile.reverse.holds(self._values) else speed
        if speed is not None or yaw_rate is not None:
            events.append(
                EgoMotion(timestamp_s=timestamp_s, speed_mps=speed, yaw_rate_rad_s=yaw_rate)
            )
        pose = self._map_pose() or self._geodetic_pose()
        if pose is not None:
            events.append(EgoPose(timestamp_s=timestamp_s, map_from_ego=pose))
        return events

    def _map_pose(self) -> Pose2 | None:
        x, y, yaw = self._number("x"), self._number("y"), self._number("yaw")
        if x is None or y is None or yaw is None:
            return None
        return Pose2(x, y, wrap_angle(yaw))

    def _geodetic_pose(self) -> Pose2 | None:
        latitude, longitude = self._number("latitude"), self._number("longitude")
        heading = self._number("heading")
        if latitude is None or longitude is None or heading is None:
            return None
        if abs(latitude) > math.pi / 2.0 or abs(longitude) > math.pi:
            return None
        if self._origin is None:
            self._origin = MapOrigin(latitude, longitude)
        pose = self._origin.pose(latitude, longitude, heading)
        return pose if math.isfinite(pose.x_m) else None

    def _number(self, key: str) -> float | None:
        field = self._profile.numbers.get(key)
        if field is None:
            return None
        value = field.number(self._values)
        return value if math.isfinite(value) else None
