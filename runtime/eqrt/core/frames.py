"""Planar rigid transforms.

Metres, radians, counter-clockwise positive; x points forward (or east), y to the left (or north).
A transform is named `dst_from_src`, so that neighbouring frames cancel when composed:
`map_from_sensor = map_from_ego @ ego_from_sensor`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Pose2:
    """Position and yaw of a frame `src` in a frame `dst`, as the transform `dst_from_src`."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0

    def apply(self, points: Float64) -> Float64:
        """Points (..., 2) in metres, from `src` to `dst`."""
        moved: Float64 = self.rotate(points) + np.array([self.x_m, self.y_m])
        return moved

    def rotate(self, vectors: Float64) -> Float64:
        """Free vectors (..., 2), from `src` to `dst`: turned, not moved."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        turned: Float64 = vectors @ np.array([[cos, sin], [-sin, cos]])
        return turned

    def inverse(self) -> Pose2:
        """`src_from_dst`."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Pose2(
            -cos * self.x_m - sin * self.y_m, sin * self.x_m - cos * self.y_m, -self.yaw_rad
        )

    def __matmul__(self, other: Pose2) -> Pose2:
        """`dst_from_src @ src_from_other` is `dst_from_other`."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Pose2(
            self.x_m + cos * other.x_m - sin * other.y_m,
            self.y_m + sin * other.x_m + cos * other.y_m,
            wrap_angle(self.yaw_rad + other.yaw_rad),
        )


def wrap_angle(angle_rad: float) -> float:
    """The same direction in [-pi, pi]."""
    return math.remainder(angle_rad, math.tau)
