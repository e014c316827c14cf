"""Argoverse 1 motion forecasting in its official form: one CSV file per sequence, one map per city.

A file's rows are sightings (TIMESTAMP, TRACK_ID, OBJECT_TYPE, X, Y, CITY_NAME) in metres, city
frame, at 50 time stamps, or 20 in the test split. A time stamp's rank is its step of 0.1 s: the
sequences jitter, and some were sampled more slowly (a quarter of a second apart was seen), but the
benchmark, and every number published on it, counts steps and not time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import LogError
from eqrt.core.lanes import LaneMap
from eqrt.training.recordings.argoverse1_packed import ARGOVERSE1, DT_S, NOW_STEP, NUM_STEPS
from eqrt.training.recordings.argoverse_maps import read_city_map
from eqrt.training.recordings.recording import Part, Recording, Source, TrackGrid

Float64 = NDArray[np.float64]
Columns = dict[str, tuple[str, ...]]

COLUMNS = ("TIMESTAMP", "TRACK_ID", "OBJECT_TYPE", "X", "Y", "CITY_NAME")
CITIES = ("MIA", "PIT")
_STEP_COUNTS = (NUM_STEPS, NOW_STEP + 1)
_SPACING_S = (0.05, 0.5)  # between time stamps, the median; 0.099 to 0.281 s were seen
_MAP_FILE = "pruned_argoverse_{}_*_vector_map.xml"
_MAP_FOLDERS = ("map_files", "hd_maps/map_files")
_FOLDERS_ABOVE = 4
"""The official archives unpack to `forecasting_train_v1.1/train/data/`."""
_ORDER = {"AGENT": 0, "AV": 1}
_NUMBERED_ANEW = ("val", "test", "test_obs")
"""The official splits whose sequences have numbers that others have in `train`."""


@dataclass(frozen=True, slots=True)
class Argoverse1Reader:
    """Reads a folder of sequences; a recording is one file, named by its number."""

    maps: Path | None = None
    """The folder of the cities' maps. None = `map_files` (or `hd_maps/map_files`) beside the data
    or in a folder above it; if there is none, recordings have no lanes."""

    @property
    def source(self) -> Source:
        """Argoverse 1's."""
        return ARGOVERSE1

    def parts(self, path: Path) -> Sequence[Part]:
        """The CSV files in the folder `path`, or the one file `path`, by name.

        Raises LogError if there are none, or `maps` holds no maps.
        """
        parts = [Part(name) for name in _csv_files(path)]
        _map_folder(self.maps, Path(parts[0].path).parent)
        return parts

    def read(self, part: Part) -> Iterator[Recording]:
        """The one recording of `part`. Raises LogError, naming the file, if anything is wrong."""
        path = Path(part.path)
        columns = _columns(path)
        folder = _map_folder(self.maps, path.parent)
        city = _city(path, columns)
        yield _recording(path, columns, None if folder is None else _city_lanes(folder, city))


def _group(path: Path) -> str:
    """A sequence's number, with its split before it, as the folder has it (`val/data/7.csv`)."""
    folder = path.absolute().parent
    split = folder.parent.name if folder.name == "data" else folder.name
    return f"{split}/{path.stem}" if split in _NUMBERED_ANEW else path.stem


def _csv_files(path: Path) -> list[str]:
    if path.is_file():
        return [str(path)]
    try:
        names = sorted(n for n in os.listdir(path) if n.endswith(".csv") and n[0] != ".")
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error})") from error
    if not names:
        raise LogError(f"{path}: no *.csv here; give the folder of a split, such as train/data")
    return [os.path.join(path, name) for name in names]


@cache
def _map_folder(maps: Path | None, data: Path) -> Path | None:
    """The folder that holds the maps for the files in `data`, None if there is none."""
    if maps is not None:
        candidates = [maps, *(maps / name for name in _MAP_FOLDERS)]
    else:
        data = data.absolute()
        above = (data, *data.parents[:_FOLDERS_ABOVE])
        candidates = [data, *(folder / name for folder in above for name in _MAP_FOLDERS)]
    found = next((folder for folder in candidates if any(folder.glob(_MAP_FILE.format("*")))), None)
    if found is None and maps is not None:
        raise LogError(f"{maps}: no {_MAP_FILE.format('*')} here; give the folder map_files")
    return found


def _city_lanes(folder: Path, city: str) -> LaneMap:
    lanes = _read_city(folder, city)
    if isinstance(lanes, LogError):
        raise LogError(str(lanes))
    return lanes


@cache
def _read_city(folder: Path, city: str) -> LaneMap | LogError:
    """One city's lanes, or what is wrong with its map: a broken one is not read again either."""
    files = sorted(folder.glob(_MAP_FILE.format(city)))
    if not files:
        return LogError(f"{folder}: no {_MAP_FILE.format(city)} here; fetch the city's map")
    try:
        return read_city_map(files[0])
    except LogError as error:
        return error


def _columns(path: Path) -> Columns:
    """Column name -> its fields, one per row."""
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: cannot be read ({error}); fetch it again") from error
    # No field is quoted, and the csv module takes 2.7 times as long.
    header, *rows = (line.split(",") for line in text.splitlines() or [""])
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise LogError(
            f"{path}: no column {', '.join(missing)}; expected an Argoverse 1 forecasting CSV"
        )
    if not rows:
        raise LogError(f"{path}: no rows below the header; the file is cut short")
    for line, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise LogError(
                f"{path}: line {line} has {len(row)} fields, expected {len(header)}; the file is "
                "cut short or damaged"
            )
    return dict(zip(header, zip(*rows, strict=True), strict=True))


def _city(path: Path, columns: Columns) -> str:
    cities = sorted(set(columns["CITY_NAME"]))
    if len(cities) != 1 or cities[0] not in CITIES:
        raise LogError(f"{path}: the city is {', '.join(cities)}, expected {' or '.join(CITIES)}")
    return cities[0]


def _recording(path: Path, columns: Columns, lanes: LaneMap | None) -> Recording:
    """Rows of its tracks: the target (AGENT), the recording car (AV), the others as they come."""
    ids = columns["TRACK_ID"]
    kind_of = dict(zip(ids, columns["OBJECT_TYPE"], strict=True))
    order = sorted(kind_of, key=lambda track: _ORDER.get(kind_of[track], len(_ORDER)))
    focal = np.array([kind_of[track] == "AGENT" for track in order])
    if focal.sum() != 1:
        raise LogError(f"{path}: {focal.sum()} tracks of type AGENT, expected 1")
    return Recording(
        name=path.stem,
        group=_group(path),
        dt_s=DT_S,
        tracks=_grid(path, columns, order),
        track_ids=tuple(order),
        may_be_target=np.ones(len(order), np.bool_),  # OTHERS are of any type, vehicles mostly
        focal=focal,
        now_steps=(NOW_STEP,),
        lanes=lanes,
    )


def _grid(path: Path, columns: Columns, order: Sequence[str]) -> TrackGrid:
    row_of = {track: row for row, track in enumerate(order)}
    row = np.array([row_of[track] for track in columns["TRACK_ID"]])
    step, num_steps = _steps(path, _numbers(path, columns, "TIMESTAMP"))
    grid = TrackGrid.empty(len(order), num_steps)
    grid.positions[row, step, 0] = _numbers(path, columns, "X")
    grid.positions[row, step, 1] = _numbers(path, columns, "Y")
    grid.valid[row, step] = True
    if np.count_nonzero(grid.valid) != len(row):
        raise LogError(f"{path}: a track is seen twice at one time; the file is damaged")
    return grid


def _steps(path: Path, stamp_s: Float64) -> tuple[NDArray[np.intp], int]:
    """The step of each row, and how many steps there are."""
    times, step = np.unique(stamp_s, return_inverse=True)
    if len(times) not in _STEP_COUNTS:
        raise LogError(
            f"{path}: {len(times)} time stamps, expected {' or '.join(map(str, _STEP_COUNTS))}; "
            "the file is cut short, or no Argoverse 1 sequence"
        )
    spacing = float(np.median(np.diff(times)))
    if not _SPACING_S[0] <= spacing <= _SPACING_S[1]:
        raise LogError(f"{path}: time stamps are {spacing:.3g} s apart, expected about {DT_S} s")
    return step.reshape(-1), len(times)


def _numbers(path: Path, columns: Columns, name: str) -> Float64:
    try:
        values = np.array(columns[name], np.float64)
    except ValueError as error:
        raise LogError(f"{path}: {name}: {error}; the file is damaged") from error
    wrong = np.flatnonzero(~np.isfinite(values))
    if len(wrong):
        text = columns[name][wrong[0]]
        raise LogError(f"{path}: line {wrong[0] + 2}: {name} is {text}, expected a number")
    return values
