"""The ego vehicle's own speed and yaw rate over the time of a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.can_check.observation import Observation
from eqrt.runtime.can_check.plain import bounded

Float64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoCourse:
    """What was measured, each on its own times, seconds; any of it may be empty."""

    speed_s: Float64
    """(s,)"""
    speed_mps: Float64
    """(s,)"""
    yaw_rate_s: Float64
    """(r,)"""
    yaw_rate_rad_s: Float64
    """(r,)"""
    pose_s: Float64
    """(p,)"""
    position: Float64
    """(p, 2) metres, map frame."""
    yaw_rad: Float64
    """(p,) unwrapped."""

    def speed_at(self, time_s: Float64) -> Float64:
        """m/s (n,), NaN where nothing was measured."""
        return _at(time_s, self.speed_s, self.speed_mps)

    def yaw_rate_at(self, time_s: Float64) -> Float64:
        """rad/s (n,), 0 where nothing was measured."""
        return np.nan_to_num(_at(time_s, self.yaw_rate_s, self.yaw_rate_rad_s))

    def sensor_velocity(self, time_s: Float64, ego_from_sensor: Pose2) -> Float64:
        """(n, 2) m/s: how a sensor at its mount point moves over ground, in its own axes."""
        turning = self.yaw_rate_at(time_s)
        along = self.speed_at(time_s) - turning * ego_from_sensor.y_m
        left = turning * ego_from_sensor.x_m
        in_ego = np.stack([along, left], axis=-1)
        return ego_from_sensor.inverse().rotate(in_ego)


def course_of(seen: Observation) -> EgoCourse:
    """The course that a log tells."""
    speeds = [(m.timestamp_s, m.speed_mps) for m in seen.motions if m.speed_mps is not None]
    turns = [
        (m.timestamp_s, m.yaw_rate_rad_s) for m in seen.motions if m.yaw_rate_rad_s is not None
    ]
    poses = [
        (p.timestamp_s, p.map_from_ego.x_m, p.map_from_ego.y_m, p.map_from_ego.yaw_rad)
        for p in seen.poses
    ]
    speed, turn, pose = _columns(speeds, 2), _columns(turns, 2), _columns(poses, 4)
    return EgoCourse(
        speed_s=speed[0],
        speed_mps=speed[1],
        yaw_rate_s=turn[0],
        yaw_rate_rad_s=turn[1],
        pose_s=pose[0],
        position=pose[1:3].T,
        yaw_rad=np.unwrap(pose[3]),
    )


def _columns(rows: Sequence[tuple[float, ...]], width: int) -> Float64:
    """(width, n) in the order of time, which comes first."""
    table = np.array(sorted(rows), np.float64).reshape(-1, width)
    return bounded(table.T)


def _at(time_s: Float64, known_s: Float64, values: Float64) -> Float64:
    if not len(known_s):
        return np.full(len(time_s), np.nan)
    return np.interp(time_s, known_s, values)
