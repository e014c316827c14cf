"""Files that can be watched: recordings of the service, and what `eqrt replay` writes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import LogError, in_one_line
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.json_lines import Line
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.prediction.tiles import Tile
from eqrt.runtime.recording.folder import SUFFIX
from eqrt.runtime.recording.reader import Exchanged, Recording, read_recordings
from eqrt.runtime.recording.replaying import recorded_tile
from eqrt.runtime.recording.topics import Topic


@dataclass(frozen=True, slots=True)
class TileUsed:
    """From here on, this map is predicted with."""

    tile: Tile | None
    """None = none."""


Record = ForecastSet | ServiceStatus | TileUsed
Records = Iterator[Record]

HISTORY_S = 2.0
_MAX_GAP_S = 0.3  # between two measurements of a track; a longer way is not drawn


def read_records(path: Path) -> Records:
    """What is recorded in a file, in its order; in a folder, what the service recorded there.

    A format is a suffix and a function that reads it. Raises LogError, also later, if it is
    unreadable.
    """
    if path.is_dir():
        return read_recording(path)
    read = READERS.get(path.suffix)
    if read is None:
        known = " or ".join(READERS)
        raise LogError(
            f"{path}: not a file that can be watched ({known}); make one with "
            "`eqrt replay LOG --profile P --out predictions.jsonl`"
        )
    if not path.is_file():
        raise LogError(f"{path}: no such file; `eqrt replay` makes one of a CAN log")
    return read(path)


def read_recording(path: Path) -> Records:
    """Cycles and status from what `eqrt serve --record` wrote: a file, or a folder of them.

    Raises LogError at once if there is none.
    """
    return _records(read_recordings(path))


def _records(recordings: list[Recording]) -> Records:
    for recording in recordings:
        yield TileUsed(recorded_tile(recording, recording.attached))
        for recorded in recording.entries(frozenset({Topic.FORECASTS, Topic.STATUS})):
            if isinstance(recorded.entry, Exchanged):
                yield TileUsed(recorded_tile(recording, recorded.entry.attached))
            elif isinstance(recorded.entry, (ForecastSet, ServiceStatus)):
                yield recorded.entry


def read_json_lines(path: Path) -> Records:
    """Cycles from JSON lines (docs/output.md). They say nothing of the ego vehicle and of sizes;
    a track's history is where the lines before put it.
    """
    past = _Past()
    for _, lines in groupby(_lines(path), key=lambda line: line.cycle):
        cycle = list(lines)
        yield _forecast(cycle, path, past.histories(cycle))


READERS: dict[str, Callable[[Path], Records]] = {
    SUFFIX: read_recording,
    ".jsonl": read_json_lines,
}


def _lines(path: Path) -> Iterator[Line]:
    decoder = msgspec.json.Decoder(Line)
    try:
        with path.open("rb") as stream:
            for number, text in enumerate(stream, 1):
                try:
                    yield decoder.decode(text)
                except (msgspec.MsgspecError, UnicodeDecodeError) as error:
                    raise LogError(
                        f"{path}:{number}: not a line of `eqrt replay` ({in_one_line(error)}); "
                        "what comes before it can be watched"
                    ) from error
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror}") from error


def _forecast(
    lines: list[Line], path: Path, histories: tuple[NDArray[np.float64], NDArray[np.bool_]]
) -> ForecastSet:
    """One cycle. Raises LogError if its lines do not fit together."""
    first, count = lines[0], len(lines)
    unknown = np.full(count, math.nan)
    try:
        trajectories = np.array([line.trajectories for line in lines], np.float64)
        if trajectories.ndim != 4 or trajectories.shape[3] != 2:
            raise ValueError(f"trajectories of the shape {trajectories.shape}")
        return ForecastSet(
            cycle=first.cycle,
            timestamp_s=first.time_s,
            received_s=math.nan,
            made_s=first.time_s,
            compute_s=0.0,
            mode=Mode[first.cycle_mode],
            model_id=first.model_id,
            tile_id=first.tile_id,
            map_from_ego=None,
            ego_speed_mps=math.nan,
            dt_s=first.dt_s,
            track_id=np.array([line.track_id for line in lines]),
            object_id=np.array([line.object_id for line in lines]),
            anchor_s=np.array([line.anchor_s for line in lines]),
            agent_mode=np.array([Mode[line.mode] for line in lines], np.uint8),
            position=np.array([line.position for line in lines], np.float64).reshape(count, 2),
            velocity=np.array([line.velocity for line in lines], np.float64).reshape(count, 2),
            heading_rad=unknown,
            object_class=np.full(count, ObjectClass.UNKNOWN, np.uint8),
            length_m=unknown,
            width_m=unknown,
            history=histories[0],
            history_valid=histories[1],
            trajectories=trajectories,
            probabilities=np.array([line.probabilities for line in lines]).reshape(count, -1),
            covariances=_covariances(lines, trajectories.shape),
        )
    except (ValueError, KeyError) as error:
        raise LogError(
            f"{path}: cycle {first.cycle} cannot be used ({error}); make the file again with "
            "`eqrt replay`"
        ) from error


def _covariances(lines: list[Line], shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """Of trajectories of this shape; NaN where not known, None of a model that predicts none."""
    if all(line.covariances is msgspec.UNSET for line in lines):
        return None
    covariances = np.full((*shape, 2), math.nan)
    for row, line in enumerate(lines):
        if line.covariances:
            whole = np.array(line.covariances)[..., [0, 1, 1, 2]]  # xx, xy, yx, yy
            covariances[row] = whole.reshape(covariances.shape[1:])
    return covariances


class _Past:
    """Where tracks were measured in the last `HISTORY_S`."""

    def __init__(self) -> None:
        self._tracks: dict[int, deque[tuple[float, list[float]]]] = {}

    def histories(self, lines: list[Line]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(A, T, 2) and (A, T): steps of `dt_s` up to each anchor, between measurements."""
        dt_s, now_s = lines[0].dt_s, lines[0].time_s
        steps = round(HISTORY_S / dt_s)
        back_s = dt_s * np.arange(1 - steps, 1, dtype=np.float64)
        rows = [self._row(line, line.anchor_s + back_s) for line in lines]
        self._forget(now_s - HISTORY_S - 1.0)
        return np.array([row[0] for row in rows]), np.array([row[1] for row in rows])

    def _row(
        self, line: Line, times_s: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        track = self._tracks.setdefault(line.track_id, deque())
        if not track or line.anchor_s > track[-1][0]:
            track.append((line.anchor_s, line.position))
        known_s = np.array([time_s for time_s, _ in track])
        places = np.array([place for _, place in track])
        after = np.searchsorted(known_s, times_s - 1e-4).clip(0, len(known_s) - 1)
        gap_s = known_s[after] - known_s[np.maximum(after - 1, 0)]
        valid = (times_s >= known_s[0] - 1e-4) & (gap_s <= _MAX_GAP_S)
        row = np.stack([np.interp(times_s, known_s, places[:, axis]) for axis in (0, 1)], axis=-1)
        return row, valid

    def _forget(self, before_s: float) -> None:
        for track_id, track in list(self._tracks.items()):
            while track and track[0][0] < before_s:
                track.popleft()
            if not track:
                del self._tracks[track_id]
