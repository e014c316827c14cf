"""Identity over time: which detections are the same object, and where it was.

A sensor reuses its object ids, so an identity is (sensor, id, epoch): the epoch ends when the
sensor flags a new object, after a gap, at a jump no vehicle can make, and when the map frame itself
jumps. Each gets a `track_id` that never comes again. Detections are placed in the map frame at
their own time, so that the ego's motion is gone from the histories.

Everything lives in arrays of fixed size: rows for tracks, right-aligned columns for measurements.
A measurement without which the gap around it stays short is not kept once the next one comes, so
that the columns reach as far back as the model asks, however fast the sensor measures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.detections import Detections
from eqrt.runtime.decoding.latency_checks import MAX_INPUT_AGE_S
from eqrt.runtime.tracking.ego import EgoState
from eqrt.runtime.tracking.measurements import Measurements, measure
from eqrt.runtime.tracking.track_history import (
    FIT_S,
    MAX_GAP_S,
    SAME_TIME_S,
    Float64,
    fit_velocity,
    resample,
)

MOVING_MPS = 1.0
"""An object faster than this over ground moves."""
_FORGET_S = 2.0  # an object unseen for longer leaves the store; neighbors keep their past till then
_MAX_CLOCK_STEP_S = 1.0  # a cycle older than the newest by more: the clock was set back
# How far from its expected place a measurement may lie and still be the same object.
_JUMP_M = 2.0  # the reflection wanders over a vehicle
_JUMP_PER_RANGE = 0.02  # 1.1 degrees of bearing noise
_JUMP_KNOWN_MPS = 15.0  # how wrong a velocity fitted or measured may be
_JUMP_UNKNOWN_MPS = 80.0  # faster over ground than anything on a road
_MAX_THINNED_S = 0.08
"""No gap gets longer by thinning than this; what comes at up to 20 Hz is kept whole."""
_THINNED_STEPS = 0.8
"""Nor than this many of the model's steps."""
_NO_ROW = -1

Index = NDArray[np.intp]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracks:
    """The objects seen recently. Arrays share the axis M; map frame; NaN = not known."""

    row: Index
    """(M,) what `TrackStore.history` calls them; good until the next `update`."""
    track_id: NDArray[np.int64]
    """(M,) unique as long as the store lives."""
    sensor: NDArray[np.intp]
    """(M,) index into `TrackStore.sensors`."""
    object_id: NDArray[np.int64]
    """(M,) as the sensor numbers it."""
    timestamp_s: Float64
    """(M,) of the last measurement."""
    told_until_s: Float64
    """(M,) up to when its sensor has told: the time of the snapshot, less what the sensor's cycles
    lag behind others'. From `timestamp_s` to then they were without it."""
    position: Float64
    """(M, 2) metres, the last measurement."""
    velocity: Float64
    """(M, 2) m/s over ground as measured."""
    speed_mps: Float64
    """(M,) over ground: measured, else from the displacement of the last second."""
    is_moving: Bool
    """(M,) faster than 1 m/s over ground; False while the speed is not known."""
    heading_rad: Float64
    """(M,) as measured."""
    object_class: NDArray[np.uint8]
    """(M,) `ObjectClass`."""
    length_m: Float64
    """(M,)"""
    width_m: Float64
    """(M,)"""
    existence: Float64
    """(M,) probability 0..1."""
    num_measurements: NDArray[np.int64]
    """(M,) of this object so far."""


@dataclass(slots=True)
class TrackCounters:
    """What became of the detections."""

    cycles: int = 0
    measurements: int = 0
    """Detections that became part of a track."""
    tracks: int = 0
    """Tracks begun."""
    ids_reused: int = 0
    """Tracks begun on an id that another object held until then."""
    refused: int = 0
    """Detections whose position is not finite or not possible."""
    duplicates: int = 0
    """Detections whose id came before in the same cycle."""
    late: int = 0
    """Detections not newer than their track."""
    without_ego: int = 0
    """Cycles at whose time the ego's pose is not known: ignored."""
    dropped: int = 0
    """Tracks forgotten, and detections that began none, because the store was full."""
    resets: int = 0
    """Times that all tracks were forgotten: the map frame jumped or the clock was set back."""


class _Cycle(NamedTuple):
    """When a sensor's newest cycle was measured, and when it came."""

    timestamp_s: float = -np.inf
    received_s: float = 0.0


class TrackStore:
    """Up to `capacity` tracks, known as far back as a model's history of `steps` at `dt_s` reaches.

    When it is full, a new object takes the place of one that its sensor lists no more; if there is
    none, it has to wait, so that sensors with too many objects do not drive out each other's.
    """

    def __init__(self, steps: int = 20, dt_s: float = 0.1, *, capacity: int = 256) -> None:
        self.counters = TrackCounters()
        self.sensors: list[str] = []
        """Names, in order of appearance."""
        self._next_track_id = 1
        self._ego_epoch: int | None = None
        self._newest_s = -np.inf
        self._cycles: list[_Cycle] = []  # the newest of each sensor
        self._behind_s = np.zeros(1)  # (sensors,) see `_hear`
        self._used = np.zeros(capacity, np.bool_)
        self._sensor = np.zeros(capacity, np.intp)
        self._object_id = np.zeros(capacity, np.int64)
        self._track_id = np.zeros(capacity, np.int64)
        self._count = np.zeros(capacity, np.int64)
        self._times_s = np.full((capacity, 1), -np.inf)
        self._positions = np.full((capacity, 1, 2), np.nan)
        self._fitted_velocity = np.full((capacity, 2), np.nan)
        self._velocity = np.full((capacity, 2), np.nan)
        self._heading_rad = np.full(capacity, np.nan)
        self._length_m = np.full(capacity, np.nan)
        self._width_m = np.full(capacity, np.nan)
        self._existence = np.full(capacity, np.nan)
        self._object_class = np.zeros(capacity, np.uint8)
        self.reach(steps, dt_s)

    def reach(self, steps: int, dt_s: float) -> None:
        """From now on, be ready for histories of `steps` at `dt_s`; what is known stays.

        Of any three measurements kept, the outer two are further apart than `_thinned_s`: that says
        how many columns are enough, also for the first step of a neighbor, on the clock of the
        target whose sensor tells last.
        """
        self._thinned_s = min(_MAX_THINNED_S, _THINNED_STEPS * dt_s)
        past_s = max((steps - 1) * dt_s, FIT_S) + 2.0 * MAX_GAP_S + MAX_INPUT_AGE_S
        depth = 2 * math.ceil(past_s / self._thinned_s) + 1
        more = (0, 0), (max(0, depth - self._times_s.shape[1]), 0)
        self._times_s = np.pad(self._times_s, more, constant_values=-np.inf)
        self._positions = np.pad(self._positions, (*more, (0, 0)), constant_values=np.nan)

    def update(self, detections: Detections, ego: EgoState | None, ego_from_sensor: Pose2) -> None:
        """Take one cycle, measured from `ego` (the state at its timestamp)."""
        self.counters.cycles += 1
        if ego is None:
            self.counters.without_ego += 1
            return
        now_s = detections.timestamp_s
        self._advance(now_s, ego.epoch)
        sensor = self._hear(detections)
        found = self._admit(measure(detections, ego, ego_from_sensor))
        row = self._match(sensor, found.object_id)
        on_time = (row == _NO_ROW) | (self._times_s[row, -1] < now_s)
        self.counters.late += int(np.count_nonzero(~on_time))
        found, row = found.take(on_time), row[on_time]
        begins = ~self._continues(row, found, now_s)
        self.counters.ids_reused += int(np.count_nonzero(begins & (row != _NO_ROW)))
        row = self._with_room(row)
        kept = row != _NO_ROW
        found, row, begins = found.take(kept), row[kept], begins[kept]
        self._begin(row[begins], sensor, found.object_id[begins])
        self._append(row, now_s, found)

    def snapshot(self, now_s: float, max_age_s: float = MAX_GAP_S) -> Tracks:
        """The tracks whose sensors were at most `max_age_s` without them at `now_s`, the time of a
        cycle.
        """
        told_until_s = self._told_until_s(now_s)
        is_recent = self._times_s[:, -1] >= told_until_s - max_age_s - SAME_TIME_S
        row = np.flatnonzero(self._used & is_recent)
        velocity = self._velocity[row]
        speed_mps = np.hypot(velocity[:, 0], velocity[:, 1])
        fitted = self._fitted_velocity[row]
        speed_mps = np.where(np.isnan(speed_mps), np.hypot(fitted[:, 0], fitted[:, 1]), speed_mps)
        return Tracks(
            row=row,
            track_id=self._track_id[row],
            sensor=self._sensor[row],
            object_id=self._object_id[row],
            timestamp_s=self._times_s[row, -1],
            told_until_s=told_until_s[row],
            position=self._positions[row, -1],
            velocity=velocity,
            speed_mps=speed_mps,
            is_moving=speed_mps > MOVING_MPS,
            heading_rad=self._heading_rad[row],
            object_class=self._object_class[row],
            length_m=self._length_m[row],
            width_m=self._width_m[row],
            existence=self._existence[row],
            num_measurements=self._count[row],
        )

    def history(self, now_s: float, steps: int, dt_s: float, row: Index) -> tuple[Float64, Bool]:
        """Where the tracks were at now_s - k dt_s, k = steps - 1 .. 0, see `resample`.

        Positions (A, T, 2) in the map frame, NaN where not valid, and valid (A, T). `row` comes
        from the snapshot. To end a track's history on a true measurement, let `now_s` be its
        `timestamp_s`.
        """
        return resample(self._times_s[row], self._positions[row], now_s, steps, dt_s)

    def _advance(self, now_s: float, ego_epoch: int) -> None:
        """Bring the store to a cycle's time and frame."""
        if ego_epoch != self._ego_epoch or now_s < self._newest_s - _MAX_CLOCK_STEP_S:
            self._clear()
            self._ego_epoch, self._newest_s = ego_epoch, now_s
        self._newest_s = max(self._newest_s, now_s)
        self._used &= self._times_s[:, -1] >= self._newest_s - _FORGET_S

    def _clear(self) -> None:
        self.counters.resets += bool(self._used.any())
        self._used[:] = False
        self._cycles = [_Cycle()] * len(self.sensors)

    def _hear(self, detections: Detections) -> int:
        """Note a sensor's cycle, and how far each sensor's cycles lag behind the newest of all.

        Counted as if each sensor had gone on since its last cycle came, so that one that falls
        silent does not seem to lag more and more.
        """
        if detections.sensor not in self.sensors:
            self.sensors.append(detections.sensor)
            self._cycles.append(_Cycle())
        sensor = self.sensors.index(detections.sensor)
        if detections.timestamp_s > self._cycles[sensor].timestamp_s:
            self._cycles[sensor] = _Cycle(detections.timestamp_s, detections.received_s)
        behind_s = [
            self._newest_s - (cycle.timestamp_s + (detections.received_s - cycle.received_s))
            for cycle in self._cycles
        ]
        self._behind_s = np.array([min(max(0.0, lag_s), MAX_INPUT_AGE_S) for lag_s in behind_s])
        return sensor

    def _told_until_s(self, now_s: float) -> Float64:
        """Of every row, see `Tracks.told_until_s`."""
        told_until_s: Float64 = now_s - self._behind_s[self._sensor]
        return told_until_s

    def _admit(self, found: Measurements) -> Measurements:
        """Those with a possible position and an id of their own."""
        possible = ~np.isnan(found.position[:, 0])
        self.counters.refused += int(np.count_nonzero(~possible))
        found = found.take(possible)
        first = np.zeros(len(found.object_id), np.bool_)
        first[np.unique(found.object_id, return_index=True)[1]] = True
        self.counters.duplicates += int(np.count_nonzero(~first))
        return found.take(first)

    def _match(self, sensor: int, object_id: NDArray[np.int64]) -> Index:
        """Rows (D,) that hold these ids of this sensor."""
        mine = np.flatnonzero(self._used & (self._sensor == sensor))
        same = object_id[:, None] == self._object_id[mine]  # (D, mine)
        which, of_mine = np.nonzero(same)
        row = np.full(len(object_id), _NO_ROW)
        row[which] = mine[of_mine]
        return row

    def _continues(self, row: Index, found: Measurements, now_s: float) -> Bool:
        """Whether each measurement (D,) is of the object that its row holds."""
        since_s = now_s - self._times_s[row, -1]
        velocity = np.where(
            np.isnan(self._fitted_velocity[row]), self._velocity[row], self._fitted_velocity[row]
        )
        is_known = ~np.isnan(velocity[:, 0])
        step = np.where(is_known[:, None], velocity * since_s[:, None], 0.0)
        off = found.position - self._positions[row, -1] - step
        reach_m = since_s * np.where(is_known, _JUMP_KNOWN_MPS, _JUMP_UNKNOWN_MPS)
        reach_m += _JUMP_M + _JUMP_PER_RANGE * found.range_m
        near = np.hypot(off[:, 0], off[:, 1]) <= reach_m
        is_soon = since_s <= MAX_GAP_S + SAME_TIME_S
        same: Bool = (row != _NO_ROW) & ~found.is_new & is_soon & near
        return same

    def _with_room(self, row: Index) -> Index:
        """Rows (D,) with a row for each new object too, as long as there are any.

        The stalest tracks make room, of those that cannot go on any more.
        """
        needed = int(np.count_nonzero(row == _NO_ROW))
        free = np.flatnonzero(~self._used)
        if needed > len(free):
            self.counters.dropped += needed - len(free)
            has_ended = self._times_s[:, -1] < self._told_until_s(self._newest_s) - MAX_GAP_S
            ended = np.setdiff1d(np.flatnonzero(self._used & has_ended), row)
            stalest = ended[np.argsort(self._times_s[ended, -1], kind="stable")]
            free = np.concatenate([free, stalest])
        row = row.copy()
        wanting = np.flatnonzero(row == _NO_ROW)[: len(free)]
        row[wanting] = free[: len(wanting)]
        return row

    def _begin(self, row: Index, sensor: int, object_id: NDArray[np.int64]) -> None:
        self._used[row] = True
        self._sensor[row] = sensor
        self._object_id[row] = object_id
        self._track_id[row] = np.arange(self._next_track_id, self._next_track_id + len(row))
        self._next_track_id += len(row)
        self._count[row] = 0
        self._times_s[row] = -np.inf
        self._positions[row] = np.nan
        self.counters.tracks += len(row)

    def _append(self, row: Index, now_s: float, found: Measurements) -> None:
        # The last one gives way to this one if the gap that this leaves is short.
        keeps = row[now_s - self._times_s[row, -2] > self._thinned_s]
        self._times_s[keeps, :-1] = self._times_s[keeps, 1:]
        self._times_s[row, -1] = now_s
        self._positions[keeps, :-1] = self._positions[keeps, 1:]
        self._positions[row, -1] = found.position
        self._fitted_velocity[row] = fit_velocity(self._times_s[row], self._positions[row])
        self._velocity[row] = found.velocity
        self._heading_rad[row] = found.heading_rad
        self._length_m[row] = found.length_m
        self._width_m[row] = found.width_m
        self._object_class[row] = found.object_class
        self._existence[row] = found.existence
        self._count[row] += 1
        self.counters.measurements += len(row)
