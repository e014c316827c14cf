"""Fuzzed: tiles, as they are and with size and checksum put right; and the lanes found in them."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator

import numpy as np

from drives import TILE
from eqrt.core.errors import TileError
from eqrt.core.lanes import Lane, LaneType, build_lane_map
from eqrt.core.nearest import NearestLanes
from eqrt.core.routes import RouteFinder
from eqrt.core.tile import TileInfo, decode, encode
from eqrt.runtime.prediction.tiles import load_tile
from fuzz.target import Target, assert_one_line, written

_SIZE_AT = 12  # of the file's length in its header
_DIGEST_BYTES = 32


def read(data: bytes) -> None:
    """As it is, then with the checksum that it should have: the checks behind are tried too."""
    _read(data)
    _read(sealed(data))


def sealed(data: bytes) -> bytes:
    """The same tile with the right length and checksum."""
    body = bytearray(data[:-_DIGEST_BYTES])
    if len(body) >= _SIZE_AT + 4:
        struct.pack_into("<I", body, _SIZE_AT, len(body) + _DIGEST_BYTES)
    return bytes(body) + hashlib.sha256(body).digest()


def _read(data: bytes) -> None:
    try:
        tile = load_tile(written("a.tile", data))
    except TileError as error:
        assert_one_line(error)
        return
    again = encode(tile.lane_map, tile.info)
    assert encode(*decode(again, "again")) == again
    points = tile.lane_map.points
    places = np.array([points[0], points[-1], [0.0, 0.0], [1e6, -1e6]], np.float64)
    directions = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, -1.0], [1.0, 1.0]])
    for finder in (RouteFinder(tile.lane_map), NearestLanes(tile.lane_map)):
        lines, valid = finder.centerlines_batch(places, directions, 10, 50)
        assert np.isfinite(lines[valid]).all()


def _tiles() -> Iterator[bytes]:
    info = TileInfo(name="a", source="b.osm", credit="c", origin_latitude_deg=49.0)
    ahead = np.stack([np.arange(0.0, 40.0, 2.0), np.zeros(20)], axis=1)
    one = Lane(lane_id=1, centerline=ahead[:2])
    yield encode(build_lane_map([one], "seed"), info)
    turn = ahead[-1] + ahead @ [[0.0, 1.0], [-1.0, 0.0]]
    lanes = [
        Lane(lane_id=1, centerline=ahead, successors=[3, 2], left=4, speed_limit_mps=13.9),
        Lane(lane_id=2, centerline=ahead + ahead[-1], successors=[1]),
        Lane(lane_id=3, centerline=turn, lane_type=LaneType.HIGHWAY),
        Lane(lane_id=4, centerline=ahead + np.array([0.0, 3.5]), right=1),
    ]
    yield encode(build_lane_map(lanes, "seed"), info)
    yield TILE.read_bytes()[:4096]


TARGETS = [Target(name="tile", run=read, seeds=_tiles, words=("EQRTTILE",))]
