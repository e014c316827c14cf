"""What is wrong with the car's own sensors: the bias of its yaw rate, the scale of its speed.

Both are learned while driving, from standstills (the yaw rate should be 0) and from map poses (INS,
GNSS course) held against what the sensors summed up to. Uncertainties are standard deviations.
"""

from __future__ import annotations

import math

from eqrt.core.frames import Pose2, wrap_angle

_GATE = 4.0  # standard deviations; what lies beyond is a pose error and not learned from


class YawRateBias:
    """Measured minus true yaw rate.

    A Kalman filter with two states: the angle from the summed yaw rate to the pose's yaw, and the
    bias at which that angle shrinks. So the whole drive since `restart` is one long baseline.
    """

    _INITIAL_STD_RAD_S = math.radians(0.7)
    _WANDER = math.radians(0.005)  # rad/s per square root of a second
    _STANDSTILL_STD_RAD_S = math.radians(0.1)  # 0.244 deg/s resolution: averaging does not help
    _MAX_RAD_S = math.radians(3.0)  # a sensor further off than this is broken, not biased
    _YAW_STD_RAD = math.radians(0.5)
    _YAW_WANDER = math.radians(0.1)  # rad per square root of a second: slip, yaw-rate scale
    _MIN_INTERVAL_S = 0.2  # poses closer than this share their errors

    def __init__(self, value_rad_s: float = 0.0) -> None:
        self.value_rad_s = value_rad_s
        self._variance = self._INITIAL_STD_RAD_S**2
        self._angle_rad = 0.0
        self._angle_variance = self._YAW_STD_RAD**2
        self._covariance = 0.0
        self._time_s: float | None = None
        """Of the angle; None = there is none yet."""

    @property
    def std_rad_s(self) -> float:
        """Uncertainty of `value_rad_s`."""
        return math.sqrt(self._variance)

    def observe_standstill(self, mean_rad_s: float, span_s: float) -> None:
        """The mean measured yaw rate over a span in which the car stood."""
        if abs(mean_rad_s) > self._MAX_RAD_S:
            return
        self._variance += self._WANDER**2 * span_s
        gain = 1.0 / (self._variance + self._STANDSTILL_STD_RAD_S**2)
        residual = mean_rad_s - self.value_rad_s
        self._angle_rad += self._covariance * gain * residual
        self._angle_variance -= self._covariance**2 * gain
        self.value_rad_s += self._variance * gain * residual
        self._covariance -= self._covariance * self._variance * gain
        self._variance -= self._variance**2 * gain

    def observe_yaw(self, timestamp_s: float, yaw_rad: float, turn_rad: float) -> None:
        """A pose's yaw, and the integral of the measured yaw rate up to then (not wrapped)."""
        angle_rad = yaw_rad - turn_rad
        if self._time_s is None:
            self._anchor(timestamp_s, angle_rad)
        elif timestamp_s - self._time_s >= self._MIN_INTERVAL_S:
            self._predict(timestamp_s - self._time_s)
            self._time_s = timestamp_s
            self._correct(wrap_angle(angle_rad - self._angle_rad), timestamp_s, angle_rad)

    def restart(self) -> None:
        """The pose or the dead reckoning jumped: start a new angle, keep the bias."""
        self._time_s = None

    def _anchor(self, timestamp_s: float, angle_rad: float) -> None:
        self._time_s, self._angle_rad = timestamp_s, angle_rad
        self._angle_variance, self._covariance = self._YAW_STD_RAD**2, 0.0

    def _predict(self, span_s: float) -> None:
        self._angle_rad -= self.value_rad_s * span_s
        self._angle_variance += (
            -2.0 * span_s * self._covariance
            + span_s**2 * self._variance
            + span_s * self._YAW_WANDER**2
        )
        self._covariance -= span_s * self._variance
        self._variance += span_s * self._WANDER**2

    def _correct(self, residual_rad: float, timestamp_s: float, angle_rad: float) -> None:
        variance = self._angle_variance + self._YAW_STD_RAD**2
        value_rad_s = self.value_rad_s + self._covariance / variance * residual_rad
        if residual_rad**2 > _GATE**2 * variance or abs(value_rad_s) > self._MAX_RAD_S:
            self._anchor(timestamp_s, angle_rad)
            return
        self.value_rad_s = value_rad_s
        self._angle_rad += self._angle_variance / variance * residual_rad
        self._variance -= self._covariance**2 / variance
        self._covariance *= 1.0 - self._angle_variance / variance
        self._angle_variance *= 1.0 - self._angle_variance / variance


class SpeedScale:
    """True over measured speed: tyre size, wear, a speedometer that flatters.

    Distances between poses about 30 m apart are held against the distance driven.
    """

    _INITIAL_STD = 0.02
    _WANDER_PER_CHORD = 1e-4
    _CHORD_M = 30.0
    _CHORD_STD_M = 0.4  # of the distance between two poses
    _MAX_TURN_RAD = 0.3  # in a tighter bend the chord says too little about the arc
    _MAX_SPAN_S = 20.0
    _MAX_ERROR = 0.15  # more than any tyre explains

    def __init__(self, value: float = 1.0) -> None:
        self.value = value
        self._variance = self._INITIAL_STD**2
        self._start: tuple[float, Pose2, float] | None = None

    @property
    def std(self) -> float:
        """Uncertainty of `value`."""
        return math.sqrt(self._variance)

    def observe_position(self, timestamp_s: float, pose: Pose2, distance_m: float) -> None:
        """A pose, and the integral of the measured speed up to then."""
        if self._start is None:
            self._start = (timestamp_s, pose, distance_m)
            return
        start_s, start, start_m = self._start
        driven_m = distance_m - start_m
        if abs(driven_m) < self._CHORD_M and timestamp_s - start_s < self._MAX_SPAN_S:
            return
        self._start = (timestamp_s, pose, distance_m)
        half_turn_rad = 0.5 * wrap_angle(pose.yaw_rad - start.yaw_rad)
        if abs(driven_m) < self._CHORD_M or abs(half_turn_rad) > 0.5 * self._MAX_TURN_RAD:
            return
        bend = math.sin(half_turn_rad) / half_turn_rad if half_turn_rad else 1.0
        chord_m = math.hypot(pose.x_m - start.x_m, pose.y_m - start.y_m)
        self._correct(chord_m / (abs(driven_m) * bend), self._CHORD_STD_M / abs(driven_m))

    def restart(self) -> None:
        """The pose or the dead reckoning jumped: start a new chord, keep the scale."""
        self._start = None

    def _correct(self, measured: float, std: float) -> None:
        self._variance += self._WANDER_PER_CHORD**2
        variance = self._variance + std**2
        residual = measured - self.value
        value = self.value + self._variance / variance * residual
        if residual**2 <= _GATE**2 * variance and abs(value - 1.0) <= self._MAX_ERROR:
            self.value = value
            self._variance -= self._variance**2 / variance


class Standstill:
    """The mean yaw rate of every second in which the car has stood for a second already.

    That it stood is known between two speeds that say so, and not after the last one.
    """

    _MAX_SPEED_MPS = 0.1
    _MAX_GAP_S = 1.0  # between two speeds; a car that is not heard of for longer may have moved
    _SPAN_S = 1.0

    def __init__(self) -> None:
        self._since_s: float | None = None
        """Start of the second, the first of which is for coming to rest; None = driving."""
        self._heard_s = -math.inf
        """Time of the last speed."""
        self._at_rest = False
        self._sum_rad_s = 0.0
        self._count = 0

    def add_speed(self, timestamp_s: float, speed_mps: float) -> tuple[float, float] | None:
        """One measured speed; (mean rad/s, span s) when it completes a second at rest."""
        gap_s, self._heard_s = timestamp_s - self._heard_s, timestamp_s
        if abs(speed_mps) > self._MAX_SPEED_MPS:
            self._since_s = None
            return None
        if self._since_s is None or not 0.0 <= gap_s <= self._MAX_GAP_S:
            self._begin(timestamp_s, at_rest=False)
            return None
        span_s = timestamp_s - self._since_s
        if span_s < self._SPAN_S:
            return None
        mean_rad_s, at_rest = self._sum_rad_s / max(1, self._count), self._at_rest and self._count
        self._begin(timestamp_s, at_rest=True)
        return (mean_rad_s, span_s) if at_rest else None

    def add_yaw_rate(self, yaw_rate_rad_s: float) -> None:
        """One measured yaw rate, not older than the last speed."""
        self._sum_rad_s += yaw_rate_rad_s
        self._count += 1

    def _begin(self, timestamp_s: float, *, at_rest: bool) -> None:
        self._since_s, self._at_rest = timestamp_s, at_rest
        self._sum_rad_s, self._count = 0.0, 0
