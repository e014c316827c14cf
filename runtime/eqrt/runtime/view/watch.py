"""One stream of cycles and statuses, turned into what pages are told, in order."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from eqrt.core.errors import EqrtError
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.prediction.tiles import Tile, load_tile
from eqrt.runtime.view.hindsight import Ghosts, Hindsight, Score
from eqrt.runtime.view.updates import (
    ego_pose,
    encode_lanes,
    encode_update,
    is_on_map,
)

KEPT_S = 60.0
KEPT_BYTES = 64 << 20
LANES_M = 500.0
"""How far from the ego vehicle lanes are shown."""
_LANES_STEP_M = 200.0  # how far it drives before it gets others
BETWEEN_RUNS_S = 1.0
"""In a file, from the end of one run of the service to the beginning of the next."""
NO_LANES = -1
_LEAST_STEP_S = 0.01  # between two cycles as pages are told; those of a service are farther apart
LANES_KEPT = 10
"""As many as the page keeps (`scene.mjs`): a minute at 120 km/h."""


class Watch:
    """What happened, with hindsight; a service that starts again begins another stream."""

    def __init__(self, *, joins_runs: bool = False) -> None:
        """`joins_runs`: a service that starts again goes on where the one before ended, whatever
        its clock says then: one timeline for a folder of drives.
        """
        self._joins_runs = joins_runs
        self.stream = 0
        self.time_s = -math.inf
        """Of the newest cycle, `ForecastSet.moment_s` as pages are told it; grows in a stream."""
        self.shift_s = 0.0
        """From the service's clock to this."""
        self._hindsight = Hindsight()
        self._last: ForecastSet | None = None
        self._mode: Mode | None = None
        self.mode_since_s = 0.0

    def add(self, forecast: ForecastSet) -> tuple[Ghosts, Score | None]:
        """Take the next cycle: what became of the predictions before it."""
        if self._last is not None and _started_again(self._last, forecast):
            self.stream += 1
            self._hindsight = Hindsight()
            self._mode = None
            self._begin_again(forecast)
        # what was measured just before the silence ended may be older than its last word
        self.time_s = max(forecast.moment_s + self.shift_s, self.time_s + _LEAST_STEP_S)
        if forecast.mode is not self._mode:
            self._mode, self.mode_since_s = forecast.mode, self.time_s
        self._last = forecast
        return self._hindsight.add(forecast), self._hindsight.score()

    def update(self, forecast: ForecastSet, *, lanes: int = NO_LANES) -> bytes:
        """The same, as a page is told; `lanes`: the number of those around it."""
        ghosts, score = self.add(forecast)
        return encode_update(
            forecast,
            ghosts=ghosts,
            score=score,
            stream=self.stream,
            time_s=self.time_s,
            mode_since_s=self.mode_since_s,
            lanes=lanes,
        )

    def _begin_again(self, forecast: ForecastSet) -> None:
        if self._joins_runs:
            self.shift_s = self.time_s + BETWEEN_RUNS_S - forecast.moment_s
        else:
            self.time_s = -math.inf


def _started_again(last: ForecastSet, now: ForecastSet) -> bool:
    return (
        now.cycle <= last.cycle
        or now.model_id != last.model_id
        or now.timestamp_s < last.timestamp_s
    )


class LastMinute:
    """The updates of the last `KEPT_S`, or fewer where they would take too much memory."""

    def __init__(self, kept_s: float = KEPT_S, kept_bytes: int = KEPT_BYTES) -> None:
        self._updates: deque[tuple[float, bytes]] = deque()
        self._kept_s, self._kept_bytes = kept_s, kept_bytes
        self.bytes = 0

    def add(self, time_s: float, update: bytes) -> None:
        """Take the newest, let go of the oldest."""
        if self._updates and time_s < self._updates[-1][0]:  # another clock
            self.clear()
        self._updates.append((time_s, update))
        self.bytes += len(update)
        while self._updates[0][0] < time_s - self._kept_s or (
            self.bytes > self._kept_bytes and len(self._updates) > 1
        ):
            self.bytes -= len(self._updates.popleft()[1])

    def clear(self) -> None:
        """Forget all."""
        self._updates.clear()
        self.bytes = 0

    def newest_first(self) -> Iterator[bytes]:
        """Those kept now; what comes later is not among them."""
        return iter([update for _, update in reversed(self._updates)])


class Lanes:
    """The lanes around the ego vehicle, said again when it has driven on."""

    def __init__(self, tile: Path | None = None) -> None:
        """`tile`: shown whatever the service says; None = its own. Raises TileError."""
        self._tile = load_tile(tile) if tile else None
        self._is_fixed = tile is not None
        self._heard = ""
        self._trouble = ""
        self._centre: tuple[float, float] | None = None
        self._told = 0
        self.number = NO_LANES
        """Of the message with the lanes around the newest cycle, counted from 0."""
        self.recent: deque[str] = deque(maxlen=LANES_KEPT)
        """Of the last minute's ways, the newest last, for whoever joins."""

    def hear(self, status: ServiceStatus) -> str:
        """Take the map that the service says it uses; returns what is wrong with it, or ""."""
        if self._is_fixed or status.tile_id == self._heard:
            return self._trouble
        self._trouble = ""
        self._take(None, status.tile_id)
        if not status.tile:
            return ""
        try:
            tile = load_tile(Path(status.tile))
        except EqrtError as error:
            self._trouble = f"no lanes are shown: {error}"
            return self._trouble
        self._take(tile, status.tile_id)
        if tile.info.tile_id != status.tile_id:
            changed = f"{status.tile} has changed since the service read it"
            self._trouble = f"{changed}: its lanes may differ"
        return self._trouble

    def use(self, tile: Tile | None) -> None:
        """Take the map that a recording has with it."""
        if not self._is_fixed:
            self._take(tile, tile.info.tile_id if tile else "")

    def _take(self, tile: Tile | None, tile_id: str) -> None:
        self._tile, self._heard = tile, tile_id
        self._centre, self.number = None, NO_LANES

    def near(self, forecast: ForecastSet) -> str | None:
        """What to tell, if it is something new."""
        if self._tile is None or not is_on_map(forecast):
            return None
        position = _whereabouts(forecast)
        if position is None or (
            self._centre is not None and _far(position, self._centre) < _LANES_STEP_M
        ):
            return None
        self._centre = position
        self.number, self._told = self._told, self._told + 1
        told = encode_lanes(self._tile, centre=position, radius_m=LANES_M, number=self.number)
        self.recent.append(told)
        return told


def _whereabouts(forecast: ForecastSet) -> tuple[float, float] | None:
    """The ego vehicle's place, else the targets'; None = there is neither."""
    if (ego := ego_pose(forecast)) is not None:
        return ego[0], ego[1]
    if not forecast.num_targets:
        return None
    x_m, y_m = forecast.position.mean(axis=0).tolist()
    return x_m, y_m


def _far(a: tuple[float, float], b: tuple[float, float]) -> float:
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]))
