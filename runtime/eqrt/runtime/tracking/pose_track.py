"""The newest map poses, and the steady motion between them."""

from __future__ import annotations

from bisect import bisect_right
from typing import NamedTuple

from eqrt.core.frames import Pose2
from eqrt.runtime.tracking.arcs import arc, steady_motion
from eqrt.runtime.tracking.odometry import num_forgotten

_MAX_POSES = 1024  # then the older half is forgotten: 5 s stay at 100 Hz


class MovingPose(NamedTuple):
    """A pose, and the velocity and turn rate of the steady motion through it."""

    map_from_ego: Pose2
    velocity: tuple[float, float]
    """m/s over ground: forward, left."""
    yaw_rate_rad_s: float


class PoseTrack:
    """Map poses in order of time; poses more than `max_gap_s` apart are not joined."""

    def __init__(self, max_gap_s: float) -> None:
        self._max_gap_s = max_gap_s
        self._times: list[float] = []
        self._poses: list[Pose2] = []

    @property
    def newest_s(self) -> float | None:
        """Time of the newest pose."""
        return self._times[-1] if self._times else None

    @property
    def newest(self) -> Pose2:
        """The newest pose; there must be one."""
        return self._poses[-1]

    def append(self, timestamp_s: float, map_from_ego: Pose2) -> None:
        """Take a pose newer than all before."""
        self._times.append(timestamp_s)
        self._poses.append(map_from_ego)
        forgotten = num_forgotten(self._times, _MAX_POSES)
        del self._times[:forgotten], self._poses[:forgotten]

    def clear(self) -> None:
        """Forget all poses."""
        del self._times[:], self._poses[:]

    def at(self, timestamp_s: float, *, ahead_s: float) -> MovingPose | None:
        """Between two poses, or up to `ahead_s` after the newest one as it last moved."""
        after = min(bisect_right(self._times, timestamp_s), len(self._times) - 1)
        if after < 1 or not timestamp_s <= self._times[-1] + ahead_s:  # NaN is refused, too
            return None
        start_s, end_s = self._times[after - 1 : after + 1]
        if end_s - start_s > self._max_gap_s:
            return None
        start, end = self._poses[after - 1 : after + 1]
        rate = 1.0 / (end_s - start_s)
        fraction = rate * (timestamp_s - start_s)
        forward_m, left_m, turn_rad = steady_motion(start, end)
        return MovingPose(
            start @ arc(fraction * forward_m, fraction * turn_rad, fraction * left_m),
            (rate * forward_m, rate * left_m),
            rate * turn_rad,
        )
