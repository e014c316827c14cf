"""The tile's limits to the last one: what just may be, and what is just too much."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import replace

import numpy as np
import pytest

from eqrt.core import tile
from eqrt.core.errors import TileError
from eqrt.core.lanes import MAX_COORDINATE_M, NO_LANE, LaneMap
from eqrt.core.tile import MAX_POINTS, MAX_TEXT_BYTES, TileInfo, decode, encode

INFO = TileInfo(
    name="here", source="b", credit="c", origin_latitude_deg=49.0, origin_longitude_deg=8.0
)
HEADER = struct.Struct("<8s6I2d")
LATITUDE_AT, LONGITUDE_AT = 32, 40


def lane_map(lanes: int = 2, *, points: int = 4, successors: int = 0) -> LaneMap:
    """Lanes of two points each, the last one of all that are left, all successors of lane 0."""
    ends = [*range(0, 2 * lanes, 2), points]
    return LaneMap(
        points=np.arange(2 * points, dtype=np.float32).reshape(points, 2) % 100,
        lane_start=np.array(ends, np.int32),
        lane_id=np.arange(lanes, dtype=np.int64),
        successor_start=np.array([0] + [successors] * lanes, np.int32),
        successor=np.zeros(successors, np.int32),
        left=np.full(lanes, NO_LANE, np.int32),
        right=np.full(lanes, NO_LANE, np.int32),
        lane_type=np.zeros(lanes, np.uint8),
        speed_limit_mps=np.full(lanes, 10.0, np.float32),
    )


def signed(body: bytes) -> bytes:
    return body + hashlib.sha256(body).digest()


def refused(data: bytes) -> str:
    with pytest.raises(TileError) as refusal:
        decode(data, "a.tile")
    return str(refusal.value)


def test_the_header_is_laid_out_as_the_page_about_tiles_says() -> None:
    data = encode(lane_map(successors=3), INFO)
    assert HEADER.unpack_from(data) == (
        b"EQRTTILE", 1, len(data), 4, 2, 3, len("here") + len("b") + len("c") + 2, 49.0, 8.0,
    )  # fmt: skip
    assert tile.MAX_FILE_BYTES == 48 + 64 * MAX_POINTS + MAX_TEXT_BYTES + 32


def test_every_section_begins_at_a_multiple_of_eight_bytes() -> None:
    """Three lanes on six points, no successors: what is no multiple is padded with zeros."""
    data = encode(lane_map(3, points=6), INFO)
    # points, lane_start, lane_id, successor_start, successor, left, right, type, speed, texts
    sections = [48, 16, 24, 16, 0, 16, 16, 8, 16, 8]
    assert len(data) == HEADER.size + sum(sections) + 32
    assert data[-40:-32] == b"here\0b\0c"
    types_at = HEADER.size + sum(sections[:7])
    assert data[types_at : types_at + 8] == bytes(8)
    assert data[types_at - 4 : types_at] == bytes(4)
    assert data[types_at - 16 : types_at - 4] == b"\xff" * 12


def test_lanes_of_two_points_and_successors_of_the_first_lane_come_back() -> None:
    lanes, info = decode(encode(lane_map(successors=2), INFO), "a.tile")
    assert lanes.lane_points(1).tolist() == [[4.0, 5.0], [6.0, 7.0]]
    assert lanes.successors_of(0).tolist() == [0, 0]
    assert (info.name, info.source, info.credit) == ("here", "b", "c")


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"successor_start": [0, 2, 1]}, "successors are not in order"),
        ({"successor_start": [0, 1, 3]}, "successors are not in order"),
        ({"lane_start": [0, 1, 4]}, "lanes do not cover its points"),
        ({"lane_start": [0, 2, 5]}, "lanes do not cover its points"),
        ({"lane_start": [0, 2, 3]}, "lanes do not cover its points"),
        ({"successor": [0, 2]}, "a successor does not exist"),
        ({"left": [2, 0]}, "a left neighbour does not exist"),
        ({"right": [0, -2]}, "a right neighbour does not exist"),
        ({"lane_type": [0, 7]}, "a lane type is not known"),
        ({"lane_id": [5, 5]}, "lane ids come twice"),
        ({"speed_limit_mps": [1000.5, 1.0]}, "a speed limit is not sensible"),
        ({"speed_limit_mps": [1.0, -0.5]}, "a speed limit is not sensible"),
    ],
)
def test_what_is_wrong_is_said_in_these_words(changes: dict[str, list[float]], fault: str) -> None:
    good = lane_map(successors=2)
    arrays = {name: np.array(values, getattr(good, name).dtype) for name, values in changes.items()}
    with pytest.raises(TileError) as refusal:
        encode(replace(good, **arrays), INFO)
    assert str(refusal.value) == f"here: the tile cannot be used: {fault}; build it again"


@pytest.mark.parametrize(
    "changes",
    [
        {"speed_limit_mps": [1000.0, 0.0]},
        {"left": [1, 0], "right": [NO_LANE, 0]},
        {"lane_type": [6, 0]},
        {"points": [[MAX_COORDINATE_M, -MAX_COORDINATE_M]] * 4},
    ],
)
def test_the_last_value_that_may_be_is_taken(changes: dict[str, list[float]]) -> None:
    good = lane_map()
    arrays = {name: np.array(values, getattr(good, name).dtype) for name, values in changes.items()}
    lanes, _ = decode(encode(replace(good, **arrays), INFO), "a.tile")
    for name, values in arrays.items():
        np.testing.assert_array_equal(getattr(lanes, name), values)


@pytest.mark.parametrize(
    ("most", "more"),
    [
        (lane_map(1, points=MAX_POINTS), lane_map(1, points=MAX_POINTS + 1)),
        (lane_map(1, successors=MAX_POINTS), lane_map(1, successors=MAX_POINTS + 1)),
    ],
)
def test_a_tile_may_have_so_many_points_and_successors(most: LaneMap, more: LaneMap) -> None:
    decode(encode(most, INFO), "a.tile")
    fault = r"its size is beyond what a tile may be \(4,194,304 points, 65,536 bytes of text\);"
    with pytest.raises(TileError, match=rf"^here: .* {fault}"):
        encode(more, INFO)


def test_texts_may_have_64_kib_together() -> None:
    room = MAX_TEXT_BYTES - len("here") - len("b") - 2
    decode(encode(lane_map(), replace(INFO, credit="x" * room)), "a.tile")
    with pytest.raises(TileError, match="its size is beyond"):
        encode(lane_map(), replace(INFO, credit="x" * (room + 1)))


def test_a_tile_has_at_least_one_lane_and_may_have_only_one() -> None:
    decode(encode(lane_map(1, points=2), INFO), "a.tile")
    with pytest.raises(TileError, match="its size is beyond"):
        encode(lane_map(0, points=0), INFO)
    crowded = bytearray(encode(lane_map(), INFO)[:-32])
    struct.pack_into("<I", crowded, 20, 3)  # three lanes on four points
    assert "its sizes disagree" in refused(signed(bytes(crowded)))


@pytest.mark.parametrize(
    ("at", "value", "is_good"),
    [
        (LATITUDE_AT, 90.0, True),
        (LATITUDE_AT, -90.0, True),
        (LATITUDE_AT, 90.5, False),
        (LATITUDE_AT, -90.5, False),
        (LONGITUDE_AT, 180.0, True),
        (LONGITUDE_AT, -180.0, True),
        (LONGITUDE_AT, 180.5, False),
        (LONGITUDE_AT, -180.5, False),
    ],
)
def test_an_origin_is_on_earth(at: int, value: float, is_good: bool) -> None:
    body = bytearray(encode(lane_map(), INFO)[:-32])
    struct.pack_into("<d", body, at, value)
    data = signed(bytes(body))
    if is_good:
        decode(data, "a.tile")
    else:
        assert refused(data) == "a.tile: the tile's origin is not on Earth; build it again"


@pytest.mark.parametrize("texts", [b"here\0b c", b"h\0r\0\0b\0c", b"\xffere\0b\0c"])
def test_texts_that_are_not_three_are_refused(texts: bytes) -> None:
    body = encode(lane_map(), INFO)[:-40]
    assert len(texts) == 8
    said = refused(signed(body + texts))
    assert said == "a.tile: the tile's texts cannot be read; build it again"


def test_a_null_in_a_text_does_not_split_it() -> None:
    _, info = decode(encode(lane_map(), replace(INFO, source="b\0b")), "a.tile")
    assert info.source == "b b"


@pytest.mark.parametrize("length", [8, 48 + 32 - 1])
def test_less_than_a_header_and_a_checksum_is_cut_short(length: int) -> None:
    said = refused(encode(lane_map(), INFO)[:length])
    assert said == f"a.tile: the tile is cut short ({length} bytes); copy it again"


def test_every_refusal_says_what_to_do() -> None:
    good = encode(lane_map(), INFO)
    size = len(good)
    assert refused(b"") == (
        "a.tile: not a tile (it does not begin with EQRTTILE); build one from a map with "
        "`eqrt tile build`"
    )
    assert refused(good[:8] + struct.pack("<I", 2) + good[12:]) == (
        "a.tile: tile version 2 is not supported (this runtime reads 1); build the tile again "
        "with this version of eqrt"
    )
    assert refused(good + b"\0") == (
        f"a.tile: the tile is cut short or has grown ({size + 1} bytes, {size} were written); "
        "copy it again"
    )
    assert refused(good[:80]).startswith("a.tile: the tile is cut short or has grown (80 bytes, ")
    assert refused(good[:-1] + bytes([good[-1] ^ 1])) == (
        "a.tile: the tile is damaged (its checksum is wrong); copy it again"
    )
    assert refused(good[:16] + struct.pack("<I", 5) + good[20:]) == (
        "a.tile: the tile is damaged (its sizes disagree); copy it again"
    )


def test_points_beyond_the_map_are_refused_in_these_words() -> None:
    good = lane_map()
    far = np.full((4, 2), np.nextafter(np.float32(MAX_COORDINATE_M), np.float32(np.inf)))
    with pytest.raises(TileError) as refusal:
        encode(replace(good, points=far), INFO)
    fault = "points lie too far out"
    assert str(refusal.value) == f"here: the tile cannot be used: {fault}; build it again"


def test_a_tile_that_makes_no_sense_is_refused_by_the_name_of_its_file() -> None:
    body = bytearray(encode(lane_map(), INFO)[:-32])
    lane_start_at = HEADER.size + 32
    struct.pack_into("<3i", body, lane_start_at, 0, 3, 4)
    fault = "lanes do not cover its points"
    said = refused(signed(bytes(body)))
    assert said == f"a.tile: the tile cannot be used: {fault}; build it again"


def test_arrays_of_other_types_are_written_as_the_files() -> None:
    good = lane_map(successors=2)
    wide = {"points": np.float64, "lane_start": np.int64, "successor": np.int64, "left": np.int64}
    other = replace(good, **{name: getattr(good, name).astype(kind) for name, kind in wide.items()})
    assert encode(other, INFO) == encode(good, INFO)
