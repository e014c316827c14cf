"""One minute of a Toyota RAV4 on a motorway (comma2k19): what its CAN says, where it really was."""

from __future__ import annotations

import gzip
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.detections import Detections, EgoMotion, EgoPose
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.tracking.ego import EgoTracker

DATA = Path(__file__).parent / "data" / "can" / "rav4"

HORIZONS_S = (2.0, 5.0)

Float64 = NDArray[np.float64]


@cache
def read_events() -> list[Detections | EgoMotion | EgoPose]:
    """The log through the real decoder, in the order in which it is known."""
    decoder = Decoder(load_profile("toyota-rav4"))
    events: list[Detections | EgoMotion | EgoPose] = []
    end_s = 0.0
    for message in read_log(DATA / "candump.log.gz"):
        events += decoder.poll(message.timestamp)
        events += decoder.feed(message, message.timestamp)
        end_s = message.timestamp
    return events + decoder.poll(end_s + 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """The ego's motion as measured, and its true track: 20 Hz, metres east and north."""

    motions: list[EgoMotion]
    times_s: Float64
    """(P,)"""
    position: Float64
    """(P, 2)"""
    course_rad: Float64
    """(P,) unwrapped, from the GNSS velocity."""

    @property
    def window_starts_s(self) -> Float64:
        """A window of dead reckoning begins every half second."""
        return np.arange(self.times_s[0] + 0.5, self.times_s[-1] - HORIZONS_S[-1], 0.5)

    def truth(self, time_s: float) -> Pose2:
        """GNSS pose, heading along the course."""
        x_m, y_m, yaw_rad = (
            float(np.interp(time_s, self.times_s, values))
            for values in (*self.position.T, self.course_rad)
        )
        return Pose2(x_m, y_m, math.remainder(yaw_rad, math.tau))

    def drift(self, calibrations: list[tuple[float, float]]) -> dict[float, float]:
        """Median distance to the truth after each horizon, dead reckoning from true poses.

        `calibrations`: yaw-rate bias in rad/s and speed scale to use in each window.
        """
        away_m: dict[float, list[float]] = {horizon_s: [] for horizon_s in HORIZONS_S}
        for start_s, (bias_rad_s, scale) in zip(self.window_starts_s, calibrations, strict=True):
            tracker = EgoTracker(yaw_rate_bias_rad_s=bias_rad_s, speed_scale=scale)
            for motion in self.motions:
                if start_s - 0.1 < motion.timestamp_s < start_s + HORIZONS_S[-1] + 0.1:
                    tracker.motion(motion)
            start = tracker.map_from_ego(start_s)
            for horizon_s in HORIZONS_S:
                end = tracker.map_from_ego(start_s + horizon_s)
                assert start is not None
                assert end is not None
                moved = start.inverse() @ end
                true = self.truth(start_s).inverse() @ self.truth(start_s + horizon_s)
                away_m[horizon_s].append(math.hypot(moved.x_m - true.x_m, moved.y_m - true.y_m))
        return {horizon_s: float(np.median(values)) for horizon_s, values in away_m.items()}

    def learn(self) -> list[tuple[float, float]]:
        """(bias, scale) known at each window's start from the poses and motions before it."""
        tracker, learned = EgoTracker(), []
        events: list[EgoMotion | EgoPose] = [
            EgoPose(timestamp_s=t, map_from_ego=self.truth(t)) for t in self.times_s.tolist()
        ]
        events += self.motions
        events.sort(key=lambda event: event.timestamp_s)
        starts_s = list(self.window_starts_s)
        for event in events:
            if starts_s and event.timestamp_s > starts_s[0]:
                starts_s.pop(0)
                learned.append((tracker.yaw_rate_bias.value_rad_s, tracker.speed_scale.value))
            if isinstance(event, EgoPose):
                tracker.pose(event)
            else:
                tracker.motion(event)
        return learned


def read_drive() -> Drive:
    """The ego's side of the minute."""
    east_north = _horizontal_axes(_load("frame_positions")[0])
    position = (_load("frame_positions") - _load("frame_positions")[0]) @ east_north
    velocity = _load("frame_velocities") @ east_north
    return Drive(
        motions=[event for event in read_events() if isinstance(event, EgoMotion)],
        times_s=_load("frame_times"),
        position=position,
        course_rad=np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0])),
    )


@cache
def _load(name: str) -> Float64:
    with gzip.open(DATA / f"{name}.npy.gz") as stream:
        values: Float64 = np.load(stream)
    return values


def _horizontal_axes(ecef: Float64) -> Float64:
    """East and north at a place, as the columns (3, 2) of earth-centred axes."""
    longitude = math.atan2(ecef[1], ecef[0])
    # Geodetic latitude near the surface, from the geocentric one; good to a micro-radian.
    latitude = math.atan2(ecef[2], math.hypot(ecef[0], ecef[1]) * (1.0 - 0.00669438))
    east = (-math.sin(longitude), math.cos(longitude), 0.0)
    north = (
        -math.sin(latitude) * math.cos(longitude),
        -math.sin(latitude) * math.sin(longitude),
        math.cos(latitude),
    )
    return np.array([east, north]).T
