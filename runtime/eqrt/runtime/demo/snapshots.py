"""One telling moment of a stream of predictions, kept until the truth is known, for a picture."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.demo.picture import Moment
from eqrt.runtime.demo.score import Scored
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.prediction.tiles import Tile

Float64 = NDArray[np.float64]

HISTORY_S = 2.0
_KEPT = 60  # forecasts: the horizon and the history before it, at 10 Hz


class BestMoment:
    """Keeps the moment in which the most moving agents have a prediction and a known future."""

    def __init__(self) -> None:
        self._recent: deque[ForecastSet] = deque(maxlen=_KEPT)
        self._best: tuple[ForecastSet, list[Scored], dict[int, list[Float64]]] | None = None
        self._motion_m = 0.0

    def add(self, forecast: ForecastSet, scored: list[Scored]) -> None:
        """Take one cycle, and what it made scorable: predictions of an earlier cycle or two."""
        self._recent.append(forecast)
        newest_s = max((s.anchor_s for s in scored), default=0.0)
        scored = [s for s in scored if s.anchor_s > newest_s - forecast.dt_s / 2]
        motion_m = sum(float(np.linalg.norm(s.truth[-1] - s.truth[0])) for s in scored)
        if motion_m <= self._motion_m:
            return
        then = min(self._recent, key=lambda f: abs(f.timestamp_s - newest_s))
        self._motion_m = motion_m
        self._best = (then, scored, self._histories(then, {s.track_id for s in scored}))

    def picture(self, tile: Tile | None) -> Moment | None:
        """What to draw, or None if nothing was ever scored."""
        if self._best is None:
            return None
        then, scored, histories = self._best
        limited = "" if then.mode is Mode.RUN else f", mode {then.mode.name}"
        moment = Moment(title=f"{len(scored)} agents{limited}")
        for s in scored:
            start = histories[s.track_id][-1][None]
            for name, line in (
                ("truth", s.truth),
                ("predicted", s.predicted),
                ("constant velocity", s.constant_velocity),
            ):
                moment.lines[name].append(np.concatenate([start, line]))
            moment.lines["history"].append(np.array(histories[s.track_id]))
            moment.agents.append(start[0])
        if (pose := then.map_from_ego) is not None:
            moment.ego = np.array([pose.x_m, pose.y_m])
        moment.is_north_known = tile is not None and then.mode is not Mode.NO_POSE
        if tile is not None:
            moment.lanes = _lanes_near(tile, np.concatenate(moment.lines["truth"]))
        return moment

    def _histories(self, then: ForecastSet, track_ids: set[int]) -> dict[int, list[Float64]]:
        """Where each track was measured in the two seconds until `then`."""
        histories: dict[int, list[Float64]] = {track_id: [] for track_id in track_ids}
        for forecast in self._recent:
            if then.timestamp_s - HISTORY_S <= forecast.timestamp_s <= then.timestamp_s:
                pairs = zip(forecast.track_id.tolist(), forecast.position, strict=True)
                for track_id, position in pairs:
                    if track_id in histories:
                        histories[track_id].append(position)
        return histories


def _lanes_near(tile: Tile, points: Float64) -> list[Float64]:
    """The lanes that pass through the box around the points, with some room."""
    low, high = points.min(axis=0) - 30.0, points.max(axis=0) + 30.0
    lanes = [
        tile.lane_map.lane_points(lane).astype(np.float64)
        for lane in range(tile.lane_map.num_lanes)
    ]
    return [lane for lane in lanes if ((lane >= low) & (lane <= high)).all(axis=1).any()]
