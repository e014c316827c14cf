"""Where the ego vehicle is in the map at any time of the last seconds, and how it moves.

Map poses (an INS on CAN, another localisation) say where; speed and yaw rate say how it goes on
between and after them. Without any pose, the map frame begins where the dead reckoning began, and
`has_map_pose` is False: tracks work, a lane map does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from eqrt.core.frames import Pose2, wrap_angle
from eqrt.runtime.decoding.detections import EgoMotion, EgoPose
from eqrt.runtime.decoding.latency_checks import MAX_EXTRAPOLATION_S, MAX_POSE_AGE_S
from eqrt.runtime.tracking.ego_calibration import SpeedScale, Standstill, YawRateBias
from eqrt.runtime.tracking.odometry import Odometry, OdometryState
from eqrt.runtime.tracking.pose_track import PoseTrack

_MAX_SPEED_MPS = 100.0
_MAX_YAW_RATE_RAD_S = 4.0
_MAX_COORDINATE_M = 1e8  # further than anything on Earth, in any map projection
_MAX_CLOCK_STEP_S = 1.0  # a pose older than the newest by more: the clock was set back
_JUMP_M = 1.0  # against the prediction; less is a correction, which tracks survive
_JUMP_RAD = math.radians(5.0)
_MIN_CALIBRATION_SPEED_MPS = 2.0  # below, a yaw that comes from GNSS course is noise
_STANDING = OdometryState(Pose2(), 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoState:
    """The ego vehicle at one time."""

    map_from_ego: Pose2
    velocity: tuple[float, float]
    """m/s over ground of the ego reference point: forward, left."""
    yaw_rate_rad_s: float
    """Counter-clockwise positive, bias removed."""
    has_map_pose: bool
    """Rests on a map pose that is recent enough; False = dead reckoning alone."""
    epoch: int
    """Places in the map frame must not be compared across epochs."""


@dataclass(slots=True)
class EgoCounters:
    """What became of the input."""

    motions: int = 0
    """Values of speed or yaw rate used."""
    poses: int = 0
    """Poses used."""
    stale: int = 0
    """Values and poses not newer than the last one: ignored."""
    refused: int = 0
    """Values and poses not finite or not possible: ignored."""
    pose_jumps: int = 0
    """Poses that the motion since the last one does not explain: each starts an epoch."""


class EgoTracker:
    """Takes speed, yaw rate and poses as they come, tells the ego's state at any recent time.

    `yaw_rate_bias_rad_s` and `speed_scale` are where their running estimates start. `stationary`
    says that nothing tells the ego's motion because there is none: a parked car, a mast.
    """

    def __init__(
        self,
        *,
        yaw_rate_bias_rad_s: float = 0.0,
        speed_scale: float = 1.0,
        stationary: bool = False,
        max_pose_age_s: float = MAX_POSE_AGE_S,
    ) -> None:
        self.counters = EgoCounters()
        self.yaw_rate_bias = YawRateBias(yaw_rate_bias_rad_s)
        self.speed_scale = SpeedScale(speed_scale)
        self.epoch = 0
        """Grows when places told before can no longer be compared with those told after."""
        self._stationary = stationary
        self._max_pose_age_s = max_pose_age_s
        self._odometry = Odometry()
        self._use_calibration()
        self._standstill = Standstill()
        self._poses = PoseTrack(max_pose_age_s)
        self._map_from_odometry = Pose2() if stationary else None
        """None = the newest pose and the dead reckoning have not met yet."""
        self._anchored_s = -math.inf
        """Time of the pose that gave `_map_from_odometry`."""

    def motion(self, motion: EgoMotion) -> None:
        """Take speed, yaw rate or both."""
        timestamp_s, speed, yaw_rate = motion.timestamp_s, motion.speed_mps, motion.yaw_rate_rad_s
        restarts = self._odometry.restarts
        if speed is not None and self._is_possible(timestamp_s, speed, _MAX_SPEED_MPS):
            self._count(self._odometry.add_speed(timestamp_s, speed))
            rest = self._standstill.add_speed(timestamp_s, speed)
            if rest is not None:
                self.yaw_rate_bias.observe_standstill(*rest)
                self._use_calibration()
        if yaw_rate is not None and self._is_possible(timestamp_s, yaw_rate, _MAX_YAW_RATE_RAD_S):
            self._count(self._odometry.add_yaw_rate(timestamp_s, yaw_rate))
            self._standstill.add_yaw_rate(yaw_rate)
        if self._odometry.restarts > restarts:
            self._cut(None)
        if self._map_from_odometry is None:
            self._go_on_alone(timestamp_s)

    def pose(self, pose: EgoPose) -> None:
        """Take one map pose."""
        timestamp_s, newest_s = pose.timestamp_s, self._poses.newest_s
        if not _is_place(pose):
            self.counters.refused += 1
            return
        if newest_s is not None and newest_s - _MAX_CLOCK_STEP_S <= timestamp_s <= newest_s:
            self.counters.stale += 1
            return
        if not self._continues(pose):
            self.counters.pose_jumps += newest_s is not None
            self._poses.clear()
            self._begin_epoch(None)
        self.counters.poses += 1
        self._poses.append(timestamp_s, pose.map_from_ego)
        self._anchor(timestamp_s, pose.map_from_ego)

    def leave_map(self) -> None:
        """Poses to come are of another map frame: nothing told before can be compared with them.

        Dead reckoning goes on, from nowhere in the map, until the next pose.
        """
        self._poses.clear()
        self._begin_epoch(Pose2() if self._stationary else None)

    def map_from_ego(self, timestamp_s: float) -> Pose2 | None:
        """Where the ego is in the map, see `at`; quicker than that between two poses."""
        pose = self._poses.at(timestamp_s, ahead_s=0.0)
        if pose is not None:
            return pose.map_from_ego
        state = self.at(timestamp_s)
        return None if state is None else state.map_from_ego

    def at(self, timestamp_s: float) -> EgoState | None:
        """State at a time of the last seconds, or up to 0.2 s ahead of the input; else None."""
        odometry, base = self._dead_reckoning(timestamp_s), self._map_from_odometry
        ahead_s = MAX_EXTRAPOLATION_S if odometry is None or base is None else 0.0
        pose = self._poses.at(timestamp_s, ahead_s=ahead_s)
        if pose is not None:
            map_from_ego, velocity, yaw_rate_rad_s = pose
        elif odometry is not None and base is not None:
            map_from_ego = base @ odometry.odometry_from_ego
        else:
            return None
        if odometry is not None:
            velocity, yaw_rate_rad_s = (odometry.speed_mps, 0.0), odometry.yaw_rate_rad_s
        return EgoState(
            map_from_ego=map_from_ego,
            velocity=velocity,
            yaw_rate_rad_s=yaw_rate_rad_s,
            has_map_pose=pose is not None or self._is_anchored(timestamp_s),
            epoch=self.epoch,
        )

    def _continues(self, pose: EgoPose) -> bool:
        """Whether the motion since the newest pose explains this one."""
        newest_s = self._poses.newest_s
        if newest_s is None or pose.timestamp_s < newest_s:
            return False
        expected = self.at(pose.timestamp_s)
        if expected is not None:
            return _is_near(expected.map_from_ego, pose.map_from_ego, unknown_s=0.0)
        unknown_s = pose.timestamp_s - newest_s
        return unknown_s <= self._max_pose_age_s and _is_near(
            self._poses.newest, pose.map_from_ego, unknown_s
        )

    def _dead_reckoning(self, timestamp_s: float) -> OdometryState | None:
        if self._stands():
            return _STANDING
        return self._odometry.at(timestamp_s)

    def _stands(self) -> bool:
        """As was said, until its speed and its yaw rate both are known."""
        return self._stationary and not self._odometry.has_begun

    def _is_anchored(self, timestamp_s: float) -> bool:
        if self._stands():
            return self._poses.newest_s is not None
        return abs(timestamp_s - self._anchored_s) <= self._max_pose_age_s

    def _anchor(self, timestamp_s: float, map_from_ego: Pose2) -> None:
        """Join the dead reckoning to a new pose, and learn from how far they had come apart."""
        odometry = self._dead_reckoning(timestamp_s)
        if odometry is None:
            return
        self._map_from_odometry = map_from_ego @ odometry.odometry_from_ego.inverse()
        self._anchored_s = timestamp_s
        if abs(odometry.speed_mps) >= _MIN_CALIBRATION_SPEED_MPS:
            self.yaw_rate_bias.observe_yaw(timestamp_s, map_from_ego.yaw_rad, odometry.turn_rad)
            self.speed_scale.observe_position(timestamp_s, map_from_ego, odometry.distance_m)
            self._use_calibration()

    def _go_on_alone(self, timestamp_s: float) -> None:
        """Without a recent pose, go on from the last one, or from the map's origin."""
        odometry, newest_s = self._odometry.at(timestamp_s), self._poses.newest_s
        if odometry is None:
            return
        if newest_s is None:
            self._begin_epoch(Pose2())
        elif abs(timestamp_s - newest_s) > self._max_pose_age_s:
            last = self._poses.newest
            self._begin_epoch(last @ odometry.odometry_from_ego.inverse())

    def _begin_epoch(self, map_from_odometry: Pose2 | None) -> None:
        self.epoch += 1
        self._cut(map_from_odometry)

    def _cut(self, map_from_odometry: Pose2 | None) -> None:
        """Poses from now on say nothing about the dead reckoning until now."""
        self._map_from_odometry, self._anchored_s = map_from_odometry, -math.inf
        self.yaw_rate_bias.restart()
        self.speed_scale.restart()

    def _use_calibration(self) -> None:
        self._odometry.yaw_rate_bias_rad_s = self.yaw_rate_bias.value_rad_s
        self._odometry.speed_scale = self.speed_scale.value

    def _is_possible(self, timestamp_s: float, value: float, limit: float) -> bool:
        possible = math.isfinite(timestamp_s) and abs(value) <= limit  # NaN compares False
        self.counters.refused += not possible
        return possible

    def _count(self, used: bool) -> None:
        self.counters.motions += used
        self.counters.stale += not used


def _is_place(pose: EgoPose) -> bool:
    place = pose.map_from_ego
    coordinates = (place.x_m, place.y_m)
    return (
        math.isfinite(pose.timestamp_s)
        and math.isfinite(place.yaw_rad)
        and all(abs(value) <= _MAX_COORDINATE_M for value in coordinates)
    )


def _is_near(expected: Pose2, measured: Pose2, unknown_s: float) -> bool:
    """Whether they agree, after a time in which the motion was not known."""
    away_m = math.hypot(measured.x_m - expected.x_m, measured.y_m - expected.y_m)
    turned_rad = abs(wrap_angle(measured.yaw_rad - expected.yaw_rad))
    return (
        away_m <= _JUMP_M + _MAX_SPEED_MPS * unknown_s
        and turned_rad <= _JUMP_RAD + _MAX_YAW_RATE_RAD_S * unknown_s
    )
