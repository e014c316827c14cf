"""The tile's bytes: what goes in comes out, and nothing damaged comes in."""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eqrt.core.errors import TileError
from eqrt.core.lanes import NO_LANE, Lane, LaneMap, LaneType, build_lane_map, middle_line
from eqrt.core.routes import RouteFinder
from eqrt.core.tile import TileInfo, decode, encode
from eqrt.training.recordings.commonroad import lane_map, read_scenario

NGSIM = Path(__file__).parents[1] / "data/ngsim"
INFO = TileInfo(
    name="Kreuzung",
    source="kreuzung.osm",
    credit="© Anna Müller, CC BY 4.0",
    origin_latitude_deg=49.0,
    origin_longitude_deg=8.4,
)


def two_lanes() -> LaneMap:
    straight, turn = np.array([[0.0, 0.0], [4.0, 0.0]]), np.array([[4.0, 0.0], [8.0, 4.0]])
    return build_lane_map(
        [
            Lane(
                lane_id=7,
                centerline=middle_line(straight, straight),
                successors=[9],
                lane_type=LaneType.HIGHWAY,
                speed_limit_mps=30.0,
            ),
            Lane(lane_id=9, centerline=middle_line(turn, turn), right=7),
        ],
        "test",
    )


TILE = encode(two_lanes(), INFO)


def signed(body: bytes) -> bytes:
    """A tile with a right checksum, whatever it holds."""
    return body + hashlib.sha256(body).digest()


@pytest.mark.parametrize("name", ["USA_Lanker-2_23", "USA_US101-22_4"])
def test_a_map_comes_back_as_it_was(name: str) -> None:
    lanes = lane_map(read_scenario(NGSIM / f"{name}_T-1.xml.gz"))
    decoded, info = decode(encode(lanes, INFO), "test")
    for field in fields(LaneMap):
        before, after = getattr(lanes, field.name), getattr(decoded, field.name)
        np.testing.assert_array_equal(before, after)
        assert before.dtype == after.dtype
    assert replace(info, tile_id="") == INFO


def test_names_that_are_no_text_do_not_keep_a_tile_from_being_written() -> None:
    """As Linux gives a file name that is not UTF-8, such as a Latin-1 Zürich."""
    odd = replace(INFO, source="Z\udcfcrich.osm", credit="Z\udcfcrich")
    _, info = decode(encode(two_lanes(), odd), "test")
    assert (info.source, info.credit) == ("Z?rich.osm", "Z?rich")


def test_values_that_can_be_checked_by_hand_come_back() -> None:
    lanes, _ = decode(TILE, "test")
    assert lanes.lane_id.tolist() == [7, 9]
    assert lanes.lane_points(0).tolist() == [[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]]
    assert lanes.successors_of(0).tolist() == [1]
    assert lanes.successors_of(1).tolist() == []
    assert lanes.left.tolist() == [NO_LANE, NO_LANE]
    assert lanes.right.tolist() == [NO_LANE, 0]
    assert lanes.lane_type.tolist() == [LaneType.HIGHWAY, LaneType.UNKNOWN]
    assert lanes.speed_limit_mps[0] == 30.0
    assert math.isnan(lanes.speed_limit_mps[1])


def test_an_unknown_origin_comes_back_unknown() -> None:
    _, info = decode(encode(two_lanes(), TileInfo(name="a", source="b", credit="")), "test")
    assert math.isnan(info.origin_latitude_deg)
    assert math.isnan(info.origin_longitude_deg)
    assert info.origin_deg is None
    assert replace(info, origin_latitude_deg=49.0).origin_deg is None


def test_a_known_origin_is_latitude_and_longitude() -> None:
    assert INFO.origin_deg == (49.0, 8.4)


def test_the_arrays_are_views_of_the_file_and_aligned() -> None:
    lanes, _ = decode(TILE, "test")
    for field in fields(LaneMap):
        array = getattr(lanes, field.name)
        assert not array.flags.owndata
        assert not array.flags.writeable
        assert array.flags.aligned


def test_equal_maps_are_equal_bytes_and_the_id_tells_others_apart() -> None:
    assert encode(two_lanes(), INFO) == TILE
    other = encode(two_lanes(), replace(INFO, credit=""))
    ids = {decode(data, "test")[1].tile_id for data in (TILE, other)}
    assert len(ids) == 2
    assert all(len(tile_id) == 8 for tile_id in ids)


@given(st.integers(0, 8 * len(TILE) - 1))
def test_a_flipped_bit_is_always_found(bit: int) -> None:
    damaged = bytearray(TILE)
    damaged[bit // 8] ^= 1 << bit % 8
    with pytest.raises(TileError, match=r"^here\.tile: "):
        decode(bytes(damaged), "here.tile")


@given(st.integers(0, len(TILE) - 1), st.binary(max_size=64))
def test_a_cut_or_grown_tile_is_always_found(cut: int, tail: bytes) -> None:
    for damaged in (TILE[:cut] + tail, TILE + tail + b"\0"):
        if damaged != TILE:
            with pytest.raises(TileError):
                decode(damaged, "here.tile")


@given(st.data())
def test_a_wrong_tile_with_a_right_checksum_loads_sound_or_not_at_all(data: st.DataObject) -> None:
    """Whatever the bytes say, what gets through can be searched."""
    body = bytearray(TILE[:-32])
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(8, len(body) - 1))] = data.draw(st.integers(0, 255))
    try:
        lanes, _ = decode(signed(bytes(body)), "here.tile")
    except TileError:
        return
    RouteFinder(lanes).centerlines(np.array([3.0, 0.0]), None, 8, 20)


@pytest.mark.parametrize(
    ("field", "value", "fault"),
    [
        ("successor", [2], "a successor does not exist"),
        ("successor", [-1], "a successor does not exist"),
        ("left", [2, -1], "a left neighbour does not exist"),
        ("right", [-2, 0], "a right neighbour does not exist"),
        ("lane_start", [0, 1, 7], "lanes do not cover its points"),
        ("lane_start", [0, 4, 6], "lanes do not cover its points"),
        ("lane_start", [1, 3, 7], "lanes do not cover its points"),
        ("successor_start", [0, 2, 1], "successors are not in order"),
        ("lane_type", [7, 0], "a lane type is not known"),
        ("lane_id", [9, 9], "lane ids come twice"),
        ("speed_limit_mps", [-1.0, 1.0], "a speed limit is not sensible"),
    ],
)
def test_a_map_that_makes_no_sense_is_not_written(
    field: str, value: list[float], fault: str
) -> None:
    lanes = two_lanes()
    wrong = replace(lanes, **{field: np.array(value, getattr(lanes, field).dtype)})
    with pytest.raises(TileError, match=fault):
        encode(wrong, INFO)


@pytest.mark.parametrize("value", [math.nan, math.inf, 2e5])
def test_points_that_are_no_place_are_not_written(value: float) -> None:
    lanes = two_lanes()
    points = lanes.points.copy()
    points[1, 1] = value
    with pytest.raises(TileError, match="points lie too far out"):
        encode(replace(lanes, points=points), INFO)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a tile"),
        (b"<osm version='0.6'>", "not a tile"),
        (TILE[:40], "cut short"),
        (TILE[:-1], "cut short or has grown"),
        (TILE[:8] + struct.pack("<I", 2) + TILE[12:], "tile version 2 is not supported"),
        (TILE[:-1] + bytes([TILE[-1] ^ 1]), "checksum is wrong"),
        (signed(TILE[:32] + struct.pack("<d", 91.0) + TILE[40:-32]), "origin is not on Earth"),
        (signed(TILE[:24] + b"\xff\xff\xff\x7f" + TILE[28:-32]), "its sizes disagree"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line_that_names_it(data: bytes, message: str) -> None:
    with pytest.raises(TileError, match=rf"^here\.tile: .*{message}") as caught:
        decode(data, "here.tile")
    assert "\n" not in str(caught.value)
