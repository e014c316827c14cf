"""What became of earlier predictions: where they put everybody now, and how far off that is.

`Hindsight.ghosts` looks back exactly 1, 2 and 3 s from a cycle. The running score is that of
`eqrt demo` (`Scoreboard`): every prediction whose whole horizon has been measured since, beside
constant velocity on the same predictions, here over the last minute.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.metrics import displacement, error_table
from eqrt.runtime.demo.score import VELOCITY_S, Scoreboard, Scored
from eqrt.runtime.output.forecasts import ForecastSet

Float64 = NDArray[np.float64]

LOOK_BACK_S = (1, 2, 3)
WINDOW_S = 60.0
"""What the running score speaks of."""
_NEAR_S = 0.06  # between a cycle and the moment looked for
_KEPT_S = max(LOOK_BACK_S) + 2 * _NEAR_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Ghosts:
    """Where the targets of a cycle were predicted to be now. Axis G: `LOOK_BACK_S`; NaN = no
    prediction of this target then. Map frame, metres.
    """

    position: Float64
    """(A, G, 2) by the most probable mode."""
    error_m: Float64
    """(A, G) from there to where the target was measured."""
    constant_velocity_error_m: Float64
    """(A, G) likewise of constant velocity."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Mean errors of the predictions of the last minute, by name (`ade_1s`, `fde_3s` ...), m."""

    count: int
    """Predictions."""
    eqrt: dict[str, float]
    constant_velocity: dict[str, float]


class Hindsight:
    """Follows one stream of cycles."""

    def __init__(self) -> None:
        self._recent: deque[ForecastSet] = deque()
        self._board = Scoreboard(keep=0)
        self._tally = _Tally()

    def add(self, forecast: ForecastSet) -> Ghosts:
        """Take the next cycle; says what became of earlier predictions of its targets."""
        self._tally.add(forecast, self._board.add(forecast))
        ghosts = self._ghosts(forecast)
        if forecast.num_targets:  # silence may last for days, and repeats its time
            self._recent.append(forecast)
        while self._recent and self._recent[0].timestamp_s < forecast.timestamp_s - _KEPT_S:
            self._recent.popleft()
        return ghosts

    def score(self) -> Score | None:
        """Of the last minute; None = nothing could be scored."""
        return self._tally.score()

    def _ghosts(self, now: ForecastSet) -> Ghosts:
        shape = (now.num_targets, len(LOOK_BACK_S))
        position = np.full((*shape, 2), np.nan)
        errors = np.full((2, *shape), np.nan)
        for column, back_s in enumerate(LOOK_BACK_S):
            then = self._cycle_at(now.timestamp_s - back_s)
            if then is None or not now.num_targets:
                continue
            rows, old = _same_targets(now, then)
            predicted = ~then.is_standstill_assumed[old]
            rows, old = rows[predicted], old[predicted]
            ahead_s = now.anchor_s[rows] - then.anchor_s[old]
            places = (_along(then, old, ahead_s), _straight_on(then, old, ahead_s))
            position[rows, column] = places[0]
            for of, place in zip(errors, places, strict=True):
                of[rows, column] = displacement(place, now.position[rows])
        return Ghosts(position=position, error_m=errors[0], constant_velocity_error_m=errors[1])

    def _cycle_at(self, time_s: float) -> ForecastSet | None:
        best = min(self._recent, key=lambda f: abs(f.timestamp_s - time_s), default=None)
        if best is None or abs(best.timestamp_s - time_s) > _NEAR_S:
            return None
        return best


def _same_targets(now: ForecastSet, then: ForecastSet) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of `now`, and the rows of the same tracks in `then`; only what was measured since."""
    _, rows, old = np.intersect1d(
        now.track_id, then.track_id, assume_unique=True, return_indices=True
    )
    since = now.anchor_s[rows] > then.anchor_s[old] + 0.5
    return rows[since], old[since]


def _along(then: ForecastSet, rows: NDArray[np.intp], ahead_s: Float64) -> Float64:
    """(n, 2) on the most probable trajectory, `ahead_s` after the anchor; NaN beyond its end.

    Cycles do not come exactly 3 s apart: up to `_NEAR_S` after its end, the last step goes on.
    """
    paths = np.concatenate([then.position[rows, None], then.trajectories[rows, 0]], axis=1)
    steps = ahead_s / then.dt_s
    low = np.floor(steps).astype(int).clip(0, paths.shape[1] - 2)
    part = (steps - low)[:, None]
    index = np.arange(len(rows))
    place = paths[index, low] * (1.0 - part) + paths[index, low + 1] * part
    place[steps > paths.shape[1] - 1 + _NEAR_S / then.dt_s + 1e-6] = np.nan
    return np.asarray(place)


def _straight_on(then: ForecastSet, rows: NDArray[np.intp], ahead_s: Float64) -> Float64:
    """(n, 2) likewise at the velocity of the half second before; NaN = seen for less."""
    steps = round(VELOCITY_S / then.dt_s)
    if then.history.shape[1] <= steps:
        return np.full((len(rows), 2), np.nan)
    before = then.history[rows, -1 - steps]
    velocity = (then.position[rows] - before) / (steps * then.dt_s)
    place = then.position[rows] + velocity * ahead_s[:, None]
    place[~then.history_valid[rows, -1 - steps]] = np.nan
    return np.asarray(place)


class _Tally:
    """Sums of errors, cycle after cycle, for as long as they count."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, int, Float64]] = deque()
        self._names: list[str] = []

    def add(self, forecast: ForecastSet, scored: list[Scored]) -> None:
        if scored:
            truth = np.array([s.truth for s in scored])
            tables = [
                error_table(
                    displacement(np.array(lines), truth), forecast.dt_s, _horizons(forecast)
                )
                for lines in (
                    [s.predicted for s in scored],
                    [s.constant_velocity for s in scored],
                )
            ]
            self._names = list(tables[0])
            sums = np.array([list(table.values()) for table in tables]) * len(scored)
            self._kept.append((forecast.moment_s, len(scored), sums))
        while self._kept and self._kept[0][0] < forecast.moment_s - WINDOW_S:
            self._kept.popleft()

    def score(self) -> Score | None:
        if not self._kept or not self._names:
            return None
        count = sum(kept[1] for kept in self._kept)
        ours, baseline = np.sum([kept[2] for kept in self._kept], axis=0) / count
        return Score(
            count=count,
            eqrt=dict(zip(self._names, ours.tolist(), strict=True)),
            constant_velocity=dict(zip(self._names, baseline.tolist(), strict=True)),
        )


def _horizons(forecast: ForecastSet) -> tuple[float, ...]:
    reach_s = forecast.trajectories.shape[2] * forecast.dt_s
    return tuple(s for s in LOOK_BACK_S if s <= reach_s + 1e-6) or (reach_s,)
