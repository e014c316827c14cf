"""The tile file: one lane map as flat little-endian arrays, with its origin, credits and checksum.

    header | points | lane_start | lane_id | ... | speed_limit_mps | texts | SHA-256 of all before

Sections stand in the order of `LaneMap`'s fields, each at a multiple of 8 bytes, and reading makes
views of the file's bytes, no copies. docs/tiles.md has the table.
"""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import TileError
from eqrt.core.lanes import MAX_COORDINATE_M, MAX_SPEED_LIMIT_MPS, NO_LANE, LaneMap, LaneType

MAGIC = b"EQRTTILE"
VERSION = 1
MAX_POINTS = 1 << 22  # 8,000 km of lanes, 32 MiB; a bad file cannot exhaust memory
MAX_TEXT_BYTES = 1 << 16

_HEADER = struct.Struct("<8s6I2d")  # magic, version, file bytes, P, M, S, text bytes, origin
_DIGEST_BYTES = hashlib.sha256().digest_size
MAX_FILE_BYTES = _HEADER.size + MAX_POINTS * 64 + MAX_TEXT_BYTES + _DIGEST_BYTES


@dataclass(frozen=True, slots=True, kw_only=True)
class TileInfo:
    """What a tile says about itself."""

    name: str
    source: str
    """The file that it was built from."""
    credit: str
    """Whose data it is and under which licence."""
    origin_latitude_deg: float = math.nan
    """Of the map frame's origin (WGS 84); the axes are east and north there. NaN = not known."""
    origin_longitude_deg: float = math.nan
    tile_id: str = ""
    """Eight hex digits that change with any byte of the file; `decode` fills it in."""

    @property
    def origin_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude of the map frame's origin, None = not known."""
        origin = (self.origin_latitude_deg, self.origin_longitude_deg)
        return None if any(math.isnan(degrees) for degrees in origin) else origin


@dataclass(frozen=True, slots=True)
class _Counts:
    points: int
    lanes: int
    successors: int
    text_bytes: int

    @property
    def sections(self) -> list[tuple[str, str, tuple[int, ...]]]:
        """(field of `LaneMap`, element type, shape) in file order."""
        return [
            ("points", "<f4", (self.points, 2)),
            ("lane_start", "<i4", (self.lanes + 1,)),
            ("lane_id", "<i8", (self.lanes,)),
            ("successor_start", "<i4", (self.lanes + 1,)),
            ("successor", "<i4", (self.successors,)),
            ("left", "<i4", (self.lanes,)),
            ("right", "<i4", (self.lanes,)),
            ("lane_type", "u1", (self.lanes,)),
            ("speed_limit_mps", "<f4", (self.lanes,)),
        ]

    @property
    def file_bytes(self) -> int:
        sizes = (math.prod(shape) * np.dtype(kind).itemsize for _, kind, shape in self.sections)
        return _HEADER.size + sum(map(_padded, sizes)) + _padded(self.text_bytes) + _DIGEST_BYTES

    @property
    def sensible(self) -> bool:
        """Whether a tile of this size can be; every lane has two points or more."""
        return (
            1 <= self.lanes <= self.points // 2
            and self.points <= MAX_POINTS
            and self.successors <= MAX_POINTS
            and self.text_bytes <= MAX_TEXT_BYTES
        )


def encode(lane_map: LaneMap, info: TileInfo) -> bytes:
    """The bytes of a tile file; equal input gives equal bytes.

    Raises TileError if the map is larger than a tile may be, or not one that `decode` would take.
    """
    texts = b"\0".join(
        text.replace("\0", " ").encode(errors="replace")
        for text in (info.name, info.source, info.credit)
    )
    counts = _Counts(len(lane_map.points), lane_map.num_lanes, len(lane_map.successor), len(texts))
    _check(lane_map, counts, info.name)
    header = _HEADER.pack(
        MAGIC,
        VERSION,
        counts.file_bytes,
        counts.points,
        counts.lanes,
        counts.successors,
        counts.text_bytes,
        info.origin_latitude_deg,
        info.origin_longitude_deg,
    )
    arrays = (
        np.ascontiguousarray(getattr(lane_map, name), kind).tobytes()
        for name, kind, _ in counts.sections
    )
    body = b"".join([header, *(_pad(part) for part in (*arrays, texts))])
    return body + hashlib.sha256(body).digest()


def decode(data: bytes, where: str) -> tuple[LaneMap, TileInfo]:
    """Read a tile; `where` names the file in errors. The arrays are read-only views of `data`.

    Raises TileError if it is no tile, another version, cut short, damaged, or refers to lanes or
    points that it does not have.
    """
    counts, latitude_deg, longitude_deg = _read_header(data, where)
    body, digest = data[:-_DIGEST_BYTES], data[-_DIGEST_BYTES:]
    if hashlib.sha256(body).digest() != digest:
        raise TileError(f"{where}: the tile is damaged (its checksum is wrong); copy it again")
    arrays: dict[str, NDArray[np.generic]] = {}
    offset = _HEADER.size
    for name, kind, shape in counts.sections:
        size = math.prod(shape)
        arrays[name] = np.frombuffer(data, kind, size, offset).reshape(shape)
        offset += _padded(arrays[name].nbytes)
    lane_map = LaneMap(**arrays)  # type: ignore[arg-type]  # the kinds are those of the fields
    _check(lane_map, counts, where)
    if abs(latitude_deg) > 90.0 or abs(longitude_deg) > 180.0:
        raise TileError(f"{where}: the tile's origin is not on Earth; build it again")
    try:
        name, source, credit = data[offset : offset + counts.text_bytes].decode().split("\0")
    except ValueError as error:
        raise TileError(f"{where}: the tile's texts cannot be read; build it again") from error
    return lane_map, TileInfo(
        name=name,
        source=source,
        credit=credit,
        origin_latitude_deg=latitude_deg,
        origin_longitude_deg=longitude_deg,
        tile_id=digest[:4].hex(),
    )


def _read_header(data: bytes, where: str) -> tuple[_Counts, float, float]:
    if not data.startswith(MAGIC):
        raise TileError(
            f"{where}: not a tile (it does not begin with {MAGIC.decode()}); "
            "build one from a map with `eqrt tile build`"
        )
    if len(data) < _HEADER.size + _DIGEST_BYTES:
        raise TileError(f"{where}: the tile is cut short ({len(data)} bytes); copy it again")
    _, version, file_bytes, *sizes, latitude_deg, longitude_deg = _HEADER.unpack_from(data)
    if version != VERSION:
        raise TileError(
            f"{where}: tile version {version} is not supported (this runtime reads {VERSION}); "
            "build the tile again with this version of eqrt"
        )
    if len(data) != file_bytes:
        raise TileError(
            f"{where}: the tile is cut short or has grown ({len(data)} bytes, {file_bytes} were "
            "written); copy it again"
        )
    counts = _Counts(*sizes)
    if not counts.sensible or counts.file_bytes != file_bytes:
        raise TileError(f"{where}: the tile is damaged (its sizes disagree); copy it again")
    return counts, latitude_deg, longitude_deg


def _check(lane_map: LaneMap, counts: _Counts, where: str) -> None:
    """Raise TileError unless every index and value is in range."""
    lanes, speed = counts.lanes, lane_map.speed_limit_mps
    faults = {
        f"its size is beyond what a tile may be ({MAX_POINTS:,} points, {MAX_TEXT_BYTES:,} bytes "
        "of text)": not counts.sensible,
        "lanes do not cover its points": not _splits(lane_map.lane_start, counts.points, 2),
        "successors are not in order": not _splits(lane_map.successor_start, counts.successors, 0),
        "a successor does not exist": not _within(lane_map.successor, 0, lanes),
        "a left neighbour does not exist": not _within(lane_map.left, NO_LANE, lanes),
        "a right neighbour does not exist": not _within(lane_map.right, NO_LANE, lanes),
        "a lane type is not known": not _within(lane_map.lane_type, 0, len(LaneType)),
        "lane ids come twice": len(np.unique(lane_map.lane_id)) != lanes,
        "points lie too far out": not (np.abs(lane_map.points) <= MAX_COORDINATE_M).all(),
        "a speed limit is not sensible": bool(((speed < 0) | (speed > MAX_SPEED_LIMIT_MPS)).any()),
    }
    for fault, found in faults.items():
        if found:
            raise TileError(f"{where}: the tile cannot be used: {fault}; build it again")


def _splits(start: NDArray[np.int32], total: int, at_least: int) -> bool:
    """Whether `start` cuts `total` things into consecutive groups of some size at least."""
    in_order = bool((np.diff(start.astype(np.int64)) >= at_least).all())
    return in_order and bool(start[0] == 0) and bool(start[-1] == total)


def _within(values: NDArray[np.integer], low: int, high: int) -> bool:
    return bool(((values >= low) & (values < high)).all())


def _padded(size: int) -> int:
    return -(-size // 8) * 8


def _pad(part: bytes) -> bytes:
    return part.ljust(_padded(len(part)), b"\0")
