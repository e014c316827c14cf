"""Our own file for one recording: `NAME.recording.npz`, with its map once beside it as a tile.

The archive holds plain arrays, nothing pickled. What was seen stands without the gaps, row after
row of `valid`, as float32 offsets from a float64 origin: 8 um within 100 m, 8 mm within 100 km.

    texts        JSON: version, name, group, dt_s, now_steps, track_ids, source, tile
    valid        (A, S) bool          origin       (2,) float64, metres, map frame
    offsets      (V, 2) float32       headings     (V,) float32, radians, NaN = not known
    may_be_target, focal  (A,) bool

Recordings on one map name the same tile (`map-ID.tile`, ID = the tile's own), which is stored once
in their folder and loaded once per process.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import LogError, TileError
from eqrt.core.lanes import LaneMap
from eqrt.core.tile import MAX_FILE_BYTES, TileInfo, decode, encode
from eqrt.training.recordings.recording import Part, Recording, Source, TrackGrid

SUFFIX = ".recording.npz"
VERSION = 1
_ARRAYS = {  # name -> (kind, axes)
    "valid": (np.bool_, 2),
    "origin": (np.float64, 1),
    "offsets": (np.float32, 2),
    "headings": (np.float32, 1),
    "may_be_target": (np.bool_, 1),
    "focal": (np.bool_, 1),
}
_TEXTS = ("name", "group", "dt_s", "now_steps", "track_ids", "source", "tile")
UNREADABLE = (  # what numpy, zipfile and json raise for files that are damaged or others'
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError),
    *(RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error, struct.error),
)


def save_recording(path: Path, recording: Recording, source: Source) -> None:
    """Write `path`, and the tile of its map beside it unless it is there; each appears when whole.

    Raises LogError if they cannot be written, or `path` has another suffix.
    """
    if not path.name.endswith(SUFFIX):
        raise LogError(f"{path}: the name of a recording ends with {SUFFIX}; rename it")
    tile = None if recording.lanes is None else _save_tile(path.parent, recording.lanes, source)
    tracks = recording.tracks
    seen = tracks.positions[tracks.valid]  # (V, 2)
    origin = seen.mean(axis=0).round() if len(seen) else np.zeros(2)
    texts = {
        "version": VERSION,
        "name": recording.name,
        "group": recording.group,
        "dt_s": recording.dt_s,
        "now_steps": recording.now_steps,
        "track_ids": recording.track_ids,
        "source": dataclasses.asdict(source),
        "tile": tile,
    }
    with _appearing(path) as stream:
        np.savez_compressed(
            stream,
            texts=np.frombuffer(json.dumps(texts).encode(), np.uint8),
            valid=tracks.valid,
            origin=origin,
            offsets=(seen - origin).astype(np.float32),
            headings=tracks.heading_rad[tracks.valid].astype(np.float32),
            may_be_target=recording.may_be_target,
            focal=recording.focal,
        )


def load_recording(path: Path) -> tuple[Recording, Source]:
    """What `save_recording` wrote; headings and positions of steps not seen are NaN and 0.

    Raises LogError, naming the file, if it is damaged or its tile is missing.
    """
    texts, arrays = _read(path)
    _check(path, texts, arrays)
    source, tile = _source(path, texts), texts["tile"]
    valid = arrays["valid"]
    tracks = TrackGrid.empty(*valid.shape)
    tracks.valid[:] = valid
    tracks.positions[valid] = arrays["offsets"] + arrays["origin"]
    tracks.heading_rad[valid] = arrays["headings"]
    recording = Recording(
        name=texts["name"],
        group=texts["group"],
        dt_s=texts["dt_s"],
        tracks=tracks,
        track_ids=tuple(texts["track_ids"]),
        may_be_target=arrays["may_be_target"],
        focal=arrays["focal"],
        now_steps=None if texts["now_steps"] is None else tuple(texts["now_steps"]),
        lanes=None if tile is None else _load_tile(str(path.parent / tile)),
    )
    return recording, source


@dataclass(frozen=True, slots=True)
class RecordingFileReader:
    """Reads recordings that were saved as files, all of one source."""

    source: Source

    @classmethod
    def open(cls, path: Path) -> RecordingFileReader:
        """The reader of the files at `path`, a folder or one file.

        Raises LogError if there are none, or they come from different sources.
        """
        first, *others = _files(path)
        source = _source(first, _read_texts(first))
        for other in others:
            _same_source(other, _source(other, _read_texts(other)), first, source)
        return cls(source)

    def parts(self, path: Path) -> Sequence[Part]:
        """One part for every file in the folder `path`, by name, or for the file `path`."""
        return [Part(str(file)) for file in _files(path)]

    def read(self, part: Part) -> Iterator[Recording]:
        """The one recording of a file. Raises LogError, naming the file and the reason."""
        recording, source = load_recording(Path(part.path))
        _same_source(Path(part.path), source, Path("the others"), self.source)
        yield recording


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    files = sorted(path.glob(f"*{SUFFIX}"))
    if not files:
        raise LogError(f"{path}: no recordings (*{SUFFIX}) here; make some with `eqrt simulate`")
    return files


def _same_source(path: Path, source: Source, other: Path, expected: Source) -> None:
    if source != expected:
        fields = (field.name for field in dataclasses.fields(Source))
        differ = [name for name in fields if getattr(source, name) != getattr(expected, name)]
        raise LogError(
            f"{path}: its source is not that of {other.name} ({', '.join(differ)}: "
            f"{getattr(source, differ[0])!r} and {getattr(expected, differ[0])!r}); "
            "keep recordings of different sources in different folders"
        )


def _save_tile(folder: Path, lanes: LaneMap, source: Source) -> str:
    """The tile's file name; the tile is written unless it is there."""
    data = encode(lanes, TileInfo(name=source.name, source=source.name, credit=source.credits))
    _, info = decode(data, "the recording's map")
    name = f"map-{info.tile_id}.tile"
    path = folder / name
    if not path.exists():
        with _appearing(path) as stream:
            stream.write(data)
    return name


@lru_cache(maxsize=8)  # maps; prepared data sets use one or a few
def _load_tile(path: str) -> LaneMap:
    """The map of a tile file: the same object for all recordings of one process."""
    try:
        with open(path, "rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise LogError(
            f"{path}: the recording's map cannot be read ({error.strerror}); it belongs beside the "
            "recording"
        ) from error
    try:
        return decode(data, path)[0]
    except TileError as error:
        raise LogError(str(error)) from error


@contextlib.contextmanager
def _appearing(path: Path) -> Iterator[BinaryIO]:
    """A file that appears at `path` when it is whole."""
    written = path.parent / f".{path.name}.{os.getpid()}.part"
    try:
        with written.open("wb") as stream:
            yield stream
        os.replace(written, path)
    except OSError as error:
        raise LogError(f"cannot write {path} ({error.strerror})") from error
    finally:
        with contextlib.suppress(OSError):
            written.unlink(missing_ok=True)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    with _archive(path) as archive:
        arrays = {name: archive[name] for name in _ARRAYS}
        return _parse(archive["texts"]), arrays


def _read_texts(path: Path) -> dict[str, Any]:
    """The texts alone: what a folder of many files is checked by."""
    with _archive(path) as archive:
        return _parse(archive["texts"])


@contextlib.contextmanager
def _archive(path: Path) -> Iterator[Any]:
    """The arrays in a file by their names; what goes wrong while they are read is a LogError."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            yield archive
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such recording") from error
    except UNREADABLE as error:
        raise LogError(
            f"{path}: not a whole recording ({error}); make it again, or copy it again"
        ) from error


def _parse(data: NDArray[Any]) -> dict[str, Any]:
    texts = json.loads(data.tobytes())
    if not isinstance(texts, dict) or "version" not in texts:
        raise ValueError("its texts are not those of a recording")
    if texts["version"] != VERSION:
        raise ValueError(f"version {texts['version']}, this eqrt reads {VERSION}")
    missing = [name for name in _TEXTS if name not in texts]
    if missing:
        raise ValueError(f"its texts lack {', '.join(missing)}")
    return texts


def _source(path: Path, texts: dict[str, Any]) -> Source:
    try:
        return Source(**texts["source"])
    except TypeError as error:
        raise LogError(f"{path}: its source is incomplete ({error}); make it again") from error


def _check(path: Path, texts: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    """Raise LogError unless every part fits the others and can be used."""
    for name, (kind, axes) in _ARRAYS.items():
        if arrays[name].dtype != kind or arrays[name].ndim != axes:
            raise LogError(
                f"{path}: {name} is {arrays[name].dtype} with {arrays[name].ndim} axes, expected "
                f"{np.dtype(kind)} with {axes}; make it again"
            )
    agents, steps = arrays["valid"].shape
    seen = int(arrays["valid"].sum())
    dt_s, now, tile = texts["dt_s"], texts["now_steps"], texts["tile"]
    ids = texts["track_ids"]
    faults = {
        "name and group are not texts": not _are_texts([texts["name"], texts["group"]]),
        "its time step is not above 0 s": not (
            isinstance(dt_s, float) and math.isfinite(dt_s) and dt_s > 0.0
        ),
        "track ids do not match the tracks": not (
            isinstance(ids, list) and _are_texts(ids) and len(ids) == len(set(ids)) == agents
        ),
        "flags do not match the tracks": not (
            len(arrays["may_be_target"]) == len(arrays["focal"]) == agents
        ),
        "positions do not match what was seen": arrays["offsets"].shape != (seen, 2),
        "headings do not match what was seen": len(arrays["headings"]) != seen,
        "its origin is not a place": arrays["origin"].shape != (2,)
        or not np.isfinite(arrays["origin"]).all(),
        "a position is not finite": not np.isfinite(arrays["offsets"]).all(),
        "a heading is infinite": bool(np.isinf(arrays["headings"]).any()),
        "a step called now is outside": now is not None
        and not (isinstance(now, list) and all(isinstance(i, int) and 0 <= i < steps for i in now)),
        "its map is not a file's name": tile is not None
        and not (isinstance(tile, str) and Path(tile).name == tile),
    }
    for fault, found in faults.items():
        if found:
            raise LogError(f"{path}: the recording cannot be used: {fault}; make it again")


def _are_texts(values: Sequence[Any]) -> bool:
    return all(isinstance(value, str) for value in values)
