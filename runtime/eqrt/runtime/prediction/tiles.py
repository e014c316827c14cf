"""Tile files: a lane map, from disk and to disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from eqrt.core.errors import TileError
from eqrt.core.files import write_whole
from eqrt.core.lanes import LaneMap
from eqrt.core.tile import MAX_FILE_BYTES, TileInfo, decode


@dataclass(frozen=True, slots=True)
class Tile:
    """One loaded tile."""

    lane_map: LaneMap
    info: TileInfo
    path: Path
    """The file that it was read from."""


def load_tile(path: Path) -> Tile:
    """Read a tile file. Raises TileError, naming the file, if it cannot be used."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise TileError(f"{path}: too large for a tile; build one with `eqrt tile build`")
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise TileError(
            f"{path}: no such tile file; build one with `eqrt tile build`, or leave --tile out"
        ) from error
    except OSError as error:
        raise TileError(f"{path}: the tile cannot be read ({error.strerror})") from error
    lane_map, info = decode(data, str(path))
    return Tile(lane_map, info, path)


def save_tile(path: Path, data: bytes) -> None:
    """Write a tile file in one step, so that a reader sees the old one or the whole new one.

    Raises TileError, naming the file, if it cannot be written.
    """
    try:
        write_whole(path, data)
    except OSError as error:
        raise TileError(f"{path}: the tile cannot be written ({error.strerror})") from error
