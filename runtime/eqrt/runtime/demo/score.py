"""Predictions against what really happened: the same tracks, measured a little later.

Needs no labels, only the service's own output: where a track is now is the truth for what was
predicted for it before. Constant velocity is scored on exactly the same predictions.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.metrics import displacement, error_table
from eqrt.runtime.output.forecasts import ForecastSet

Float64 = NDArray[np.float64]

VELOCITY_S = 0.5
"""Constant velocity is the displacement of the last half second; younger tracks do not count."""
MAX_GAP_S = 0.3
"""The truth is interpolated between measurements at most this far apart."""
_FORGET_S = 8.0
_SAME_TIME_S = 1e-6


@dataclass(frozen=True, slots=True)
class Scored:
    """One prediction whose whole horizon has since been measured. Map frame, metres."""

    track_id: int
    anchor_s: float
    predicted: Float64
    """(H, 2) the most probable mode."""
    constant_velocity: Float64
    """(H, 2)"""
    truth: Float64
    """(H, 2)"""


class Scoreboard:
    """Running displacement errors of one stream of predictions."""

    def __init__(self, keep: int | None = None) -> None:
        """`keep`: how many of the newest predictions `tables` speaks of; None = of all."""
        self.too_young = 0
        """Predictions that are left out although what happened is known: of tracks that were not
        there VELOCITY_S before, for which constant velocity could not say anything."""
        self._places: dict[int, _Places] = {}
        self._pending: deque[ForecastSet] = deque()
        self._model: deque[Float64] = deque(maxlen=keep)
        self._baseline: deque[Float64] = deque(maxlen=keep)
        self._dt_s = 0.1

    def add(self, forecast: ForecastSet) -> list[Scored]:
        """Take one cycle; returns the predictions that can be scored now."""
        for track_id, anchor_s, position in zip(
            forecast.track_id.tolist(), forecast.anchor_s.tolist(), forecast.position, strict=True
        ):
            self._places.setdefault(track_id, _Places()).append(anchor_s, position)
        if forecast.num_targets:
            self._pending.append(forecast)
        self._dt_s = forecast.dt_s
        scored: list[Scored] = []
        horizon_s = forecast.trajectories.shape[2] * forecast.dt_s + MAX_GAP_S
        while self._pending and self._pending[0].timestamp_s + horizon_s <= forecast.timestamp_s:
            scored += self._score(self._pending.popleft())
        self._forget(forecast.timestamp_s)
        return scored

    @property
    def count(self) -> int:
        """Predictions scored so far, of those kept."""
        return len(self._model)

    def tables(self) -> tuple[dict[str, float], dict[str, float]]:
        """ADE/FDE at 1, 2, 3 s in metres: of the model, and of constant velocity. Needs a count."""
        pair = (np.array(self._model), np.array(self._baseline))
        return error_table(pair[0], self._dt_s), error_table(pair[1], self._dt_s)

    def _score(self, forecast: ForecastSet) -> list[Scored]:
        ahead_s = forecast.dt_s * np.arange(1, forecast.trajectories.shape[2] + 1)
        scored: list[Scored] = []
        for row, track_id in enumerate(forecast.track_id.tolist()):
            places, anchor_s = self._places.get(track_id), float(forecast.anchor_s[row])
            if places is None or (truth := places.at(anchor_s + ahead_s)) is None:
                continue
            before = places.at(np.array([anchor_s - VELOCITY_S]))
            if before is None:
                self.too_young += 1
                continue
            velocity = (forecast.position[row] - before[0]) / VELOCITY_S
            course = forecast.position[row] + velocity * ahead_s[:, None]
            best = forecast.trajectories[row, 0]
            self._model.append(displacement(best, truth))
            self._baseline.append(displacement(course, truth))
            scored.append(Scored(track_id, anchor_s, best, course, truth))
        return scored

    def _forget(self, now_s: float) -> None:
        old = [key for key, places in self._places.items() if places.newest_s < now_s - _FORGET_S]
        for key in old:
            del self._places[key]


class _Places:
    """Where one track was measured."""

    def __init__(self) -> None:
        self._times_s: deque[float] = deque()
        self._positions: deque[Float64] = deque()

    @property
    def newest_s(self) -> float:
        return self._times_s[-1]

    def append(self, time_s: float, position: Float64) -> None:
        """A coasting track repeats its last measurement: that adds nothing."""
        if not self._times_s or time_s > self._times_s[-1]:
            self._times_s.append(time_s)
            self._positions.append(position)
        while self._times_s[0] < self._times_s[-1] - _FORGET_S:
            self._times_s.popleft()
            self._positions.popleft()

    def at(self, times_s: Float64) -> Float64 | None:
        """Positions (n, 2) at `times_s` (n,); None if one of them is not between measurements."""
        known = np.array(self._times_s)
        after = np.searchsorted(known, times_s - _SAME_TIME_S)
        if after[-1] == len(known) or times_s[0] < known[0] - _SAME_TIME_S:
            return None
        before = np.maximum(after - 1, 0)
        hit = np.abs(known[after] - times_s) <= _SAME_TIME_S
        if (~hit & (known[after] - known[before] > MAX_GAP_S + _SAME_TIME_S)).any():
            return None
        positions = np.array(self._positions)
        return np.stack([np.interp(times_s, known, positions[:, i]) for i in (0, 1)], axis=-1)
