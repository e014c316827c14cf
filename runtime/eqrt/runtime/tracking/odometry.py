"""Dead reckoning: speed and yaw rate, which may come in different messages, integrated along arcs.

Between two samples a signal runs linearly, so a span is settled once both signals are known at its
two ends; past the newest samples their values are held. Poses are `odometry_from_ego`: the ego
reference point (which must not move sideways: the rear axle) in a frame whose origin is where the
dead reckoning began.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from typing import NamedTuple

from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.latency_checks import MAX_EXTRAPOLATION_S
from eqrt.runtime.tracking.arcs import arc, between

MAX_GAP_S = 1.0
"""A signal silent for longer, or a clock that steps by more, breaks the dead reckoning."""
KEPT_S = 10.0
"""At least so much of the past is kept, and at most twice as much. Histories of 2 s need less; to
a model of longer ones than this, the ego vehicle's places before would not be known.
"""
_MAX_NODES = 4096  # then the older half is forgotten: 5 s stay even at 400 samples/s


class OdometryState(NamedTuple):
    """Where the dead reckoning says the ego is, and how it moves, at one time."""

    odometry_from_ego: Pose2
    turn_rad: float
    """Integral of the yaw rate as measured (bias not removed), not wrapped."""
    distance_m: float
    """Integral of the speed as measured (scale not applied)."""
    speed_mps: float
    """Scale applied."""
    yaw_rate_rad_s: float
    """Bias removed."""


def num_forgotten(times: list[float], max_count: int) -> int:
    """How many of the oldest may go, seldom and then many at once, so that it costs next to
    nothing: those before KEPT_S once they reach twice as far back, or half of too many.
    """
    if len(times) > max_count:
        return max_count // 2
    if times[0] < times[-1] - 2.0 * KEPT_S:
        return bisect_left(times, times[-1] - KEPT_S) - 1
    return 0


class Odometry:
    """The ego's state at any time of the last seconds, from samples of speed and yaw rate."""

    def __init__(self) -> None:
        self.yaw_rate_bias_rad_s = 0.0
        """Taken off every yaw rate that is integrated from now on."""
        self.speed_scale = 1.0
        """True over measured speed, for all that is integrated from now on."""
        self.restarts = 0
        """How often the dead reckoning broke: poses before and after are unrelated."""
        self._speed = _Signal()
        self._yaw_rate = _Signal()
        self._times: list[float] = []
        self._states: list[OdometryState] = []

    def add_speed(self, timestamp_s: float, speed_mps: float) -> bool:
        """One measured speed; False if it is not newer than the last one (and ignored)."""
        return self._add(self._speed, timestamp_s, speed_mps)

    def add_yaw_rate(self, timestamp_s: float, yaw_rate_rad_s: float) -> bool:
        """One measured yaw rate, bias included; False as in `add_speed`."""
        return self._add(self._yaw_rate, timestamp_s, yaw_rate_rad_s)

    @property
    def has_begun(self) -> bool:
        """Whether speed and yaw rate are known, so that there is something to integrate."""
        return bool(self._times)

    def at(self, timestamp_s: float) -> OdometryState | None:
        """State at a time up to 0.2 s past the newest; None beyond, or before the oldest kept."""
        if not self._times:
            return None
        if not self._times[0] <= timestamp_s <= self._times[-1] + MAX_EXTRAPOLATION_S:
            return None
        if timestamp_s > self._times[-1]:
            *_, (_, state) = self._walk(timestamp_s)
            return state
        after = bisect_right(self._times, timestamp_s)
        if after == len(self._times):
            return self._states[-1]
        start_s, end_s = self._times[after - 1 : after + 1]
        fraction = (timestamp_s - start_s) / (end_s - start_s)
        return _between(self._states[after - 1], self._states[after], fraction)

    def restart(self) -> None:
        """Forget all samples; the dead reckoning goes on from the last pose when new ones come."""
        self.restarts += 1
        self._speed.clear()
        self._yaw_rate.clear()
        del self._times[:], self._states[:-1]

    def _add(self, signal: _Signal, timestamp_s: float, value: float) -> bool:
        if signal.times and abs(timestamp_s - signal.times[-1]) > MAX_GAP_S:
            self.restart()
        if signal.times and timestamp_s <= signal.times[-1]:
            return False
        signal.append(timestamp_s, value)
        both = self._speed.times and self._yaw_rate.times
        if both and abs(self._speed.times[-1] - self._yaw_rate.times[-1]) > MAX_GAP_S:
            self.restart()  # the other signal has fallen silent
            signal.append(timestamp_s, value)
        elif self._times:
            self._settle()
        elif both:
            self._begin(timestamp_s)
        else:
            signal.forget_before(timestamp_s)
        return True

    def _begin(self, timestamp_s: float) -> None:
        pose = self._states[-1].odometry_from_ego if self._states else Pose2()
        self._times = [timestamp_s]
        self._states = [self._state(pose, 0.0, 0.0, timestamp_s)]

    def _settle(self) -> None:
        """Integrate up to the time where both signals are known."""
        for time_s, state in self._walk(min(self._speed.times[-1], self._yaw_rate.times[-1])):
            self._times.append(time_s)
            self._states.append(state)
        self._speed.forget_before(self._times[-1])
        self._yaw_rate.forget_before(self._times[-1])
        forgotten = num_forgotten(self._times, _MAX_NODES)
        del self._times[:forgotten], self._states[:forgotten]

    def _walk(self, until_s: float) -> Iterator[tuple[float, OdometryState]]:
        """States after the newest settled one: at every sample's time, the last at `until_s`."""
        start_s, state = self._times[-1], self._states[-1]
        ends = {t for t in self._speed.times + self._yaw_rate.times if start_s < t < until_s}
        if until_s > start_s:
            ends.add(until_s)
        for end_s in sorted(ends):
            span_s = end_s - start_s
            distance_m = self._speed.mean(start_s, end_s) * span_s
            turn_rad = self._yaw_rate.mean(start_s, end_s) * span_s
            pose = state.odometry_from_ego @ arc(
                distance_m * self.speed_scale, turn_rad - self.yaw_rate_bias_rad_s * span_s
            )
            state = self._state(
                pose, state.turn_rad + turn_rad, state.distance_m + distance_m, end_s
            )
            yield end_s, state
            start_s = end_s

    def _state(
        self, pose: Pose2, turn_rad: float, distance_m: float, timestamp_s: float
    ) -> OdometryState:
        speed_mps = self._speed.value(timestamp_s) * self.speed_scale
        yaw_rate_rad_s = self._yaw_rate.value(timestamp_s) - self.yaw_rate_bias_rad_s
        return OdometryState(pose, turn_rad, distance_m, speed_mps, yaw_rate_rad_s)


class _Signal:
    """Samples of one signal in order of time; linear between them, held outside."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self._values: list[float] = []

    def append(self, timestamp_s: float, value: float) -> None:
        self.times.append(timestamp_s)
        self._values.append(value)

    def clear(self) -> None:
        del self.times[:], self._values[:]

    def forget_before(self, timestamp_s: float) -> None:
        """Drop the samples that `value` at `timestamp_s` and later does not need."""
        unneeded = bisect_right(self.times, timestamp_s) - 1
        if unneeded > 0:
            del self.times[:unneeded], self._values[:unneeded]

    def value(self, timestamp_s: float) -> float:
        after = bisect_right(self.times, timestamp_s)
        if after == 0:
            return self._values[0]
        if after == len(self.times):
            return self._values[-1]
        start_s, end_s = self.times[after - 1 : after + 1]
        start, end = self._values[after - 1 : after + 1]
        return start + (end - start) * (timestamp_s - start_s) / (end_s - start_s)

    def mean(self, start_s: float, end_s: float) -> float:
        """Over a span that has no sample strictly inside."""
        return 0.5 * (self.value(start_s) + self.value(end_s))


def _between(start: OdometryState, end: OdometryState, fraction: float) -> OdometryState:
    pose = between(start.odometry_from_ego, end.odometry_from_ego, fraction)
    return OdometryState(
        pose, *(a + fraction * (b - a) for a, b in zip(start[1:], end[1:], strict=True))
    )
