"""Recorded CAN logs as recordings to train on: what the car would have seen, and what came then.

The service itself runs over the log, without a model. At every `stride`-th of its predictions it
is asked what it stands on: all tracks on the model's clock, as far as they were known then. That is
a recording's past. Its future is filled in while the log goes on, from what the same tracker
measures of the same tracks later. So:

- A recording is one clock of one prediction, history and horizon long, and its now is the step at
  which its targets were measured. One grid over the whole log would not do: sensors measure at 11
  to 20 Hz, so the car's clock begins anew at each measurement, and a step between two of them
  would know of the later one before it came.
- Tracks that were measured at different times (several sensors, or not seen in this cycle) have
  clocks of their own, as in the service: one prediction may give several recordings.
- Positions stay as they were placed. The tracker puts each measurement into the map frame once, by
  the ego motion known at that moment; yaw-rate bias and speed scale that are learned later change
  how the frame goes on, never what is in it. Where the frame itself jumps, all tracks end, and so
  do the futures. What dead reckoning drifts within the horizon is part of the truth: give the
  profile a good `yaw_rate_bias_deg_s` to start from, or the log an INS.
- The ego vehicle is a neighbour, as in the service, and never a target; its future is left out.

The map frame is that of the poses in the log, or begins where dead reckoning began; only the former
has lanes. Object classes that no vehicle has are no targets; most radars tell none.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.errors import LogError
from eqrt.core.scene import Scene
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.bus.logs import FORMATS, read_log
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import NEIGHBOR_AGE_S, Pipeline
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.tiles import Tile, load_tile
from eqrt.runtime.replay import replay
from eqrt.runtime.tracking.track_history import MAX_GAP_S, SAME_TIME_S
from eqrt.runtime.tracking.tracks import Tracks, TrackStore
from eqrt.training.recordings.formats import forbids_commerce
from eqrt.training.recordings.recording import Part, Recording, Source, TrackGrid

RECORDERS_OWN = "the recorder's own"
NO_VEHICLES = (
    ObjectClass.BICYCLE,
    ObjectClass.PEDESTRIAN,
    ObjectClass.ANIMAL,
    ObjectClass.STATIC,
)
EGO_ID = "ego"
_STEPS_AT_ONCE = 5  # of a future; the tracker keeps a lost track for 2 s

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class CanLogReader:
    """Reads the CAN logs of cars with one setup of sensors. A log is one part, and one group."""

    profile: str
    """Name or file, as `eqrt serve --profile` takes it."""
    contract: ModelContract
    """Whose clock and history the recordings get; its other sizes do not matter."""
    tile: Path | None = None
    """The map around, for logs with poses in it."""
    channels: tuple[str, ...] = ()
    """As `eqrt replay --can` takes them: `can1`, `radar=can1`; empty = all channels."""
    stationary: bool = False
    """The sensor stands still, and nothing on the bus says so."""
    stride: int = 5
    """Predictions of the service from one that is recorded to the next."""
    license: str = RECORDERS_OWN
    """Under which the logs may be used: an SPDX expression, or a name."""
    credits: str = RECORDERS_OWN
    """Whose they are."""

    @property
    def source(self) -> Source:
        """What its owner says about the logs."""
        return Source(
            name="CAN logs",
            credits=self.credits,
            license=self.license,
            non_commercial=forbids_commerce(self.license),
        )

    def parts(self, path: Path) -> Sequence[Part]:
        """Every log in the folder `path` and the folders in it, by name, or the one log `path`.

        Raises LogError if there is none, or two have one name: recordings are called by it.
        """
        if path.is_file():
            return [Part(str(path))]
        logs = find_logs(path)
        for one, other in itertools.pairwise(logs):
            if one.name == other.name:
                raise LogError(f"{one} and {other} have the same name; rename one of them")
        return [Part(str(log)) for log in logs]

    def read(self, part: Part) -> Iterator[Recording]:
        """The recordings of one log, in the order of time.

        Raises LogError if the log cannot be read or the profile knows nothing in it, ProfileError,
        TileError or UsageError if an option is wrong.
        """
        profile = load_profile(self.profile)
        pipeline = Pipeline(
            profile,
            _NoModel(self.contract),  # type: ignore[arg-type]  # has what the pipeline uses of it
            _tile(self.tile) if self.tile else None,
            channels=parse_channels(self.channels, profile.roles) or None,
            stationary=self.stationary,
        )
        log = read_log(Path(part.path))
        recorder = _Recorder(self, pipeline, log.path.name)
        for forecast in replay(pipeline, log):
            yield from recorder.watch(forecast)
        yield from recorder.finish()
        if not pipeline.decoder.counters.cycles:
            raise LogError(
                f"{log.path}: no object list of the profile {profile.name!r} in its "
                f"{log.messages} messages; give the profile of the sensor that was recorded"
            )


def find_logs(folder: Path) -> list[Path]:
    """The logs in `folder` and the folders in it, by name.

    Raises LogError if there is none.
    """
    logs = [
        path
        for path in folder.rglob("*")
        if Path(path.name.lower().removesuffix(".gz")).suffix in FORMATS and path.is_file()
    ]
    if not logs:
        formats = " ".join(FORMATS)
        found = "no CAN log" if folder.is_dir() else "no such folder of CAN logs"
        raise LogError(f"{folder}: {found} ({formats}, also with .gz)")
    return sorted(logs, key=lambda path: (path.name, path))


@lru_cache(maxsize=2)
def _tile(path: Path) -> Tile:
    """One object for all logs, so that what is derived from its lanes is derived once."""
    return load_tile(path)


class _NoModel:
    """Stands where the pipeline has its predictor, and predicts nothing."""

    def __init__(self, contract: ModelContract) -> None:
        # What nobody reads need not be searched for.
        self.contract = replace(
            contract, num_agents=1, num_centerlines=1, centerline_points=2, num_modes=1
        )
        self.model_id = ""

    def predict(self, scene: Scene) -> Prediction:
        """Not a number, so the guard lets nothing of it through."""
        shape = (len(scene.history), 1, self.contract.horizon_steps, 2)
        return Prediction(np.full(shape, np.nan), np.ones(shape[:2], np.float32))


class _Recorder:
    """Takes down what the pipeline knows at its predictions, and then what becomes of it."""

    def __init__(self, reader: CanLogReader, pipeline: Pipeline, log_name: str) -> None:
        self._reader = reader
        self._pipeline = pipeline
        self._log_name = log_name
        self._begun: deque[_Begun] = deque()

    def watch(self, forecast: ForecastSet) -> Iterator[Recording]:
        """The pipeline has just made `forecast`: recordings whose futures are now complete."""
        # A measurement yet to come may still settle the steps within a gap before now.
        yield from self._go_on(forecast.timestamp_s - MAX_GAP_S)
        if forecast.num_targets and forecast.cycle % self._reader.stride == 0:
            self._begun += self._begin(forecast)

    def finish(self) -> Iterator[Recording]:
        """The log is at its end: the recordings that are left."""
        return self._go_on(np.inf)

    def _go_on(self, known_until_s: float) -> Iterator[Recording]:
        for begun in self._begun:
            begun.go_on(self._pipeline.tracks, known_until_s)
        while self._begun and self._begun[0].is_complete:
            begun = self._begun.popleft()
            if begun.was_seen_again:
                yield begun.recording

    def _begin(self, forecast: ForecastSet) -> list[_Begun]:
        """One for each clock that the targets are on."""
        tracks = self._pipeline.tracks.snapshot(forecast.timestamp_s, NEIGHBOR_AGE_S)
        if (tracks.timestamp_s > forecast.timestamp_s + SAME_TIME_S).any():
            return []  # one message completed two cycles: what was known at the first is gone
        ego = self._pipeline.ego.at(forecast.timestamp_s)
        tile = _tile(self._reader.tile) if self._reader.tile else None
        return [
            self._begin_at(
                anchor_s,
                tracks,
                is_target=np.isin(tracks.track_id, forecast.track_id[forecast.anchor_s == anchor_s])
                & ~np.isin(tracks.object_class, NO_VEHICLES),
                name=f"{self._log_name}#{forecast.cycle}.{clock}",
                tile=tile if ego is not None and ego.has_map_pose else None,
            )
            for clock, anchor_s in enumerate(np.unique(forecast.anchor_s).tolist())
        ]

    def _begin_at(
        self, anchor_s: float, tracks: Tracks, *, is_target: Bool, name: str, tile: Tile | None
    ) -> _Begun:
        contract, sensors = self._reader.contract, self._pipeline.tracks.sensors
        steps = contract.history_steps
        agents = len(tracks.row) + 1  # the ego vehicle comes last
        grid = TrackGrid.empty(agents, steps + contract.horizon_steps)
        known = self._pipeline.tracks.history(anchor_s, steps, contract.dt_s, tracks.row)
        grid.positions[:-1, :steps], grid.valid[:-1, :steps] = known
        grid.heading_rad[:-1, steps - 1] = tracks.heading_rad
        for step in range(steps):
            at_s = anchor_s - (steps - 1 - step) * contract.dt_s
            if (pose := self._pipeline.ego.map_from_ego(at_s)) is not None:
                grid.positions[-1, step] = pose.x_m, pose.y_m
                grid.valid[-1, step] = True
        keys = zip(tracks.sensor, tracks.object_id, tracks.track_id, strict=True)
        recording = Recording(
            name=name,
            group=self._log_name,
            dt_s=contract.dt_s,
            tracks=grid,
            track_ids=(*(f"{sensors[s]}/{i}/{track}" for s, i, track in keys), EGO_ID),
            may_be_target=np.append(is_target, False),
            focal=np.zeros(agents, np.bool_),
            now_steps=(steps - 1,),
            lanes=tile.lane_map if tile else None,
        )
        return _Begun(recording, tracks.track_id, anchor_s, steps)


class _Begun:
    """A recording whose future is being filled in."""

    def __init__(
        self, recording: Recording, track_id: NDArray[np.int64], anchor_s: float, steps: int
    ) -> None:
        self.recording = recording
        self._track_id = track_id
        self._anchor_s = anchor_s
        self._history_steps = steps
        self._num_filled = 0

    @property
    def is_complete(self) -> bool:
        """Nothing that comes now can change it."""
        return self._num_filled == self._horizon_steps

    @property
    def was_seen_again(self) -> bool:
        """Whether there is anything in it to predict."""
        targets = self.recording.may_be_target
        return bool(self.recording.tracks.valid[targets, self._history_steps :].any())

    @property
    def _horizon_steps(self) -> int:
        return self.recording.tracks.num_steps - self._history_steps

    def go_on(self, store: TrackStore, known_until_s: float) -> None:
        """Fill in the steps until then, some at a time."""
        dt_s = self.recording.dt_s
        ahead = (known_until_s - self._anchor_s) / dt_s
        last = int(np.clip(ahead, 0, self._horizon_steps))
        count = last - self._num_filled
        if count < min(_STEPS_AT_ONCE, self._horizon_steps - self._num_filled) or not count:
            return
        there = store.snapshot(self._anchor_s, np.inf)  # all that it keeps
        _, here, row = np.intersect1d(self._track_id, there.track_id, return_indices=True)
        positions, valid = store.history(
            self._anchor_s + last * dt_s, count, dt_s, there.row[row]
        )  # (those still there, count, 2)
        columns = slice(self._history_steps + self._num_filled, self._history_steps + last)
        self.recording.tracks.positions[here, columns] = positions
        self.recording.tracks.valid[here, columns] = valid
        self._num_filled = last
