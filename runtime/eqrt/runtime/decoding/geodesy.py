"""Latitude and longitude (WGS 84) to the map: the plane that touches the Earth at its origin.

The plane's axes are east and north at the origin. Heights are taken as zero; a car 100 m above sea
level, 1 km from the origin, is off by 16 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from eqrt.core.frames import Pose2, wrap_angle

_EQUATOR_M = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY2 = _FLATTENING * (2.0 - _FLATTENING)

Vector3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class MapOrigin:
    """Where on Earth the map frame has its origin. NaN = not known, and so is every pose."""

    latitude_rad: float
    longitude_rad: float

    def pose(self, latitude_rad: float, longitude_rad: float, heading_rad: float) -> Pose2:
        """`map_from_ego` of a car there; `heading_rad` is clockwise from true north."""
        here, origin = _on_earth(latitude_rad, longitude_rad), self._on_earth()
        offset = [a - b for a, b in zip(here, origin, strict=True)]
        sin_lat, cos_lat = math.sin(self.latitude_rad), math.cos(self.latitude_rad)
        sin_lon, cos_lon = math.sin(self.longitude_rad), math.cos(self.longitude_rad)
        outward = cos_lon * offset[0] + sin_lon * offset[1]  # away from the Earth's axis
        east = cos_lon * offset[1] - sin_lon * offset[0]
        north = cos_lat * offset[2] - sin_lat * outward
        # Meridians draw together towards the poles: north there is not quite the map's.
        convergence = wrap_angle(longitude_rad - self.longitude_rad) * math.sin(latitude_rad)
        return Pose2(east, north, wrap_angle(math.pi / 2.0 - heading_rad + convergence))

    def _on_earth(self) -> Vector3:
        return _on_earth(self.latitude_rad, self.longitude_rad)


def _on_earth(latitude_rad: float, longitude_rad: float) -> Vector3:
    """Earth-centred, earth-fixed position at height zero, metres."""
    sin_lat, cos_lat = math.sin(latitude_rad), math.cos(latitude_rad)
    normal = _EQUATOR_M / math.sqrt(1.0 - _ECCENTRICITY2 * sin_lat * sin_lat)
    return (
        normal * cos_lat * math.cos(longitude_rad),
        normal * cos_lat * math.sin(longitude_rad),
        normal * (1.0 - _ECCENTRICITY2) * sin_lat,
    )
