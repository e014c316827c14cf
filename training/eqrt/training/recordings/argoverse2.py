"""Argoverse 2 motion forecasting: a folder per scenario, with its tracks and its own piece of map.

`scenario_<id>.parquet` has a row per track and step: 110 steps at 10 Hz, 50 in the test split, and
step 49 is now. `log_map_archive_<id>.json` has the lanes. Metres and radians, city frame.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from eqrt.core.errors import LogError
from eqrt.training.recordings.argoverse_maps import read_scenario_map
from eqrt.training.recordings.recording import Part, Recording, Source, TrackGrid

ARGOVERSE2 = Source(
    name="Argoverse 2",
    credits=(
        "Argoverse 2 Motion Forecasting (Argo AI, CC BY-NC-SA 4.0 and the Argoverse terms of use)"
    ),
    license="CC-BY-NC-SA-4.0",
    non_commercial=True,
)
DT_S = 0.1
NUM_STEPS = 110
NOW_STEP = 49
VEHICLES = ("vehicle", "bus", "motorcyclist")
_TEXTS = ("track_id", "object_type", "focal_track_id")
_NUMBERS = ("timestep", "position_x", "position_y", "heading")


@dataclass(frozen=True, slots=True)
class Argoverse2Reader:
    """Reads a folder of scenario folders; a recording is one scenario."""

    @property
    def source(self) -> Source:
        """Argoverse 2's."""
        return ARGOVERSE2

    def parts(self, path: Path) -> Sequence[Part]:
        """The scenario folders in the folder `path`, or the one that `path` is, by name.

        Only the first is looked into. Raises LogError if there are none.
        """
        try:
            if _scenario_files(path):
                return [Part(str(path))]
            with os.scandir(path) as entries:
                folders = sorted(e.path for e in entries if e.is_dir() and e.name[0] != ".")
            if folders and _scenario_files(Path(folders[0])):
                return [Part(folder) for folder in folders]
        except OSError as error:
            raise LogError(f"{path}: cannot be read ({error})") from error
        raise LogError(
            f"{path}: no folders with scenario_*.parquet here; give the folder of a split, such as "
            "train"
        )

    def read(self, part: Part) -> Iterator[Recording]:
        """The one scenario of `part`. Raises LogError, naming the file, if anything is wrong."""
        folder = Path(part.path)
        files = _scenario_files(folder)
        if len(files) != 1:
            raise LogError(f"{folder}: {len(files)} files scenario_*.parquet, expected 1")
        name = files[0].stem.removeprefix("scenario_")
        lanes = read_scenario_map(folder / f"log_map_archive_{name}.json")
        rows = _Rows.of(files[0])
        yield Recording(
            name=name,
            group=name,
            dt_s=DT_S,
            tracks=rows.grid(),
            track_ids=rows.track_ids,
            may_be_target=np.isin(rows.object_types, VEHICLES),
            focal=rows.focal(),
            now_steps=(NOW_STEP,),
            lanes=lanes,
        )


def _scenario_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("scenario_*.parquet"))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rows:
    """The file's rows, one per track and step. Axes: R rows, A tracks."""

    path: Path
    track: NDArray[np.intp]
    """(R,) index of the track."""
    track_ids: tuple[str, ...]
    """(A,) as they come."""
    object_types: tuple[str, ...]
    """(A,)"""
    focal_track: str
    numbers: dict[str, NDArray[np.float64]]
    """Column name -> (R,)"""

    @classmethod
    def of(cls, path: Path) -> _Rows:
        table = _table(path)
        tracks = table["track_id"].combine_chunks().dictionary_encode()
        track = tracks.indices.to_numpy().astype(np.intp)
        _, first = np.unique(track, return_index=True)
        return cls(
            path=path,
            track=track,
            track_ids=tuple(tracks.dictionary.to_pylist()),
            object_types=tuple(table["object_type"].take(first).to_pylist()),
            focal_track=table["focal_track_id"][0].as_py(),
            numbers={name: table[name].to_numpy() for name in _NUMBERS},
        )

    def grid(self) -> TrackGrid:
        """Positions and headings by track and step."""
        step = self._steps()
        grid = TrackGrid.empty(len(self.track_ids), NUM_STEPS)
        position = np.stack([self.numbers["position_x"], self.numbers["position_y"]], axis=-1)
        wrong = np.flatnonzero(~np.isfinite(position).all(axis=-1))
        if len(wrong):
            track = self.track_ids[self.track[wrong[0]]]
            raise LogError(
                f"{self.path}: track {track}, step {step[wrong[0]]}: the position is not a number"
            )
        grid.positions[self.track, step] = position
        grid.heading_rad[self.track, step] = self.numbers["heading"]
        grid.valid[self.track, step] = True
        if np.count_nonzero(grid.valid) != len(step):
            raise LogError(f"{self.path}: a track is seen twice in one step; the file is damaged")
        return grid

    def focal(self) -> NDArray[np.bool_]:
        """(A,) the track that the scenario is about."""
        focal = np.array([track == self.focal_track for track in self.track_ids])
        if not focal.any():
            raise LogError(f"{self.path}: the focal track {self.focal_track} is not in the file")
        return focal

    def _steps(self) -> NDArray[np.intp]:
        stated = self.numbers["timestep"]
        step = np.clip(np.nan_to_num(stated, nan=-1.0), -1, NUM_STEPS).astype(np.intp)
        wrong = np.flatnonzero((step != stated) | (step < 0) | (step >= NUM_STEPS))
        if len(wrong):
            raise LogError(
                f"{self.path}: timestep {stated[wrong[0]]:g}, expected 0 to {NUM_STEPS - 1}"
            )
        return step


def _table(path: Path) -> pa.Table:
    """The columns read, texts as text and numbers as float64; at least one row, none empty."""
    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            missing = [name for name in (*_TEXTS, *_NUMBERS) if name not in names]
            if missing:
                raise LogError(
                    f"{path}: no column {', '.join(missing)}; expected an Argoverse 2 scenario"
                )
            table = file.read([*_TEXTS, *_NUMBERS], use_threads=False)
        types = {name: pa.string() for name in _TEXTS} | {name: pa.float64() for name in _NUMBERS}
        table = table.cast(pa.schema({name: types[name] for name in table.column_names}))
    except (OSError, pa.ArrowException) as error:
        raise LogError(f"{path}: cannot be read ({error}); fetch it again") from error
    if not table.num_rows:
        raise LogError(f"{path}: no rows; the file is damaged")
    empty = [name for name in _TEXTS if table[name].null_count]
    if empty:
        raise LogError(f"{path}: {empty[0]} is empty in a row; the file is damaged")
    return table
