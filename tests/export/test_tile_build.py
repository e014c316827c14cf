"""Tiles from maps: the real ones lie right, hand-made ones to the millimetre, broken ones fail."""

from __future__ import annotations

import functools
import gzip
import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from eqrt.cli import main
from eqrt.core.errors import EqrtError, TileError
from eqrt.core.lanes import NO_LANE, LaneMap, LaneType
from eqrt.core.tile import TileInfo, decode
from eqrt.export.osm import keep_lanelets
from eqrt.export.tile_build import Origin, build_tile
from eqrt.runtime.prediction.tiles import load_tile

DATA = Path(__file__).parents[1] / "data"
KARLSRUHE = DATA / "maps/lanelet2_example/mapping_example.osm.gz"
TOWN10HD = DATA / "maps/town10hd/Town10HD.osm.gz"
US101 = DATA / "ngsim/USA_US101-22_4_T-1.xml.gz"

Write = Callable[[str], Path]
Build = Callable[[], tuple[LaneMap, TileInfo, list[str]]]
PLACES = {1: (0, 4), 2: (20, 4), 3: (0, 0), 4: (20, 0), 5: (40, 4), 6: (40, 0)}
"""Node -> x, y metres: two lanelets, 4 m wide and 20 m long, one after the other."""
WAYS = {11: (1, 2), 12: (3, 4), 13: (2, 5), 14: (4, 6)}
TAGS = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes"}


@functools.cache
def karlsruhe() -> tuple[LaneMap, TileInfo, list[str]]:
    return build(KARLSRUHE)


@functools.cache
def town10hd() -> tuple[LaneMap, TileInfo, list[str]]:
    return build(TOWN10HD)


def build(source: Path, origin: Origin | None = None) -> tuple[LaneMap, TileInfo, list[str]]:
    data, skipped = build_tile(source, origin, None)
    return *decode(data, "built"), skipped


def lanelet(lanelet_id: int, left: int, right: int, **tags: str) -> str:
    return (
        f'<relation id="{lanelet_id}"><member type="way" ref="{left}" role="left"/>'
        f'<member type="way" ref="{right}" role="right"/>{tagged(TAGS | tags)}</relation>'
    )


def tagged(tags: dict[str, str]) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())


def global_nodes(latitude_deg: float, longitude_deg: float, **tags: str) -> str:
    """The nodes of `PLACES` with (0, 0) there: a degree of latitude is about 111 km."""
    nodes = []
    for node, (x_m, y_m) in PLACES.items():
        lat = latitude_deg + y_m / 111e3
        lon = longitude_deg + x_m / (111e3 * math.cos(math.radians(latitude_deg)))
        nodes.append(f'<node id="{node}" lat="{lat}" lon="{lon}">{tagged(tags)}</node>')
    return "".join(nodes)


def local_node(node: int, x_m: float, y_m: float) -> str:
    place = tagged({"local_x": str(x_m), "local_y": str(y_m)})
    return f'<node id="{node}" lat="" lon="">{place}</node>'


def osm(nodes: str, *relations: str) -> str:
    ways = "".join(
        f'<way id="{way}"><nd ref="{first}"/><nd ref="{last}"/></way>'
        for way, (first, last) in WAYS.items()
    )
    return f'<osm version="0.6">{nodes}{ways}{"".join(relations)}</osm>'


LOCAL = "".join(local_node(node, x, y) for node, (x, y) in PLACES.items())
ROAD = (lanelet(21, 11, 12), lanelet(22, 13, 14))


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write(text: str) -> Path:
        path = tmp_path / "road.osm"
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize(
    ("built", "lanes", "two_way", "connections", "length_km"),
    [(karlsruhe, 388, 60, 378, 5.17), (town10hd, 204, 0, 232, 5.93)],
    ids=["Karlsruhe", "Town10HD"],
)
def test_real_lanelet2_maps_are_whole(
    built: Build, lanes: int, two_way: int, connections: int, length_km: float
) -> None:
    lane_map, _, skipped = built()
    assert skipped == []
    assert lane_map.num_lanes == lanes
    assert (lane_map.lane_id < 0).sum() == two_way
    assert len(lane_map.successor) == connections
    lines = [lane_map.lane_points(lane) for lane in range(lanes)]
    total_m = sum(np.hypot(*np.diff(line, axis=0).T).sum() for line in lines)
    assert abs(total_m / 1e3 - length_km) < 0.01


@pytest.mark.parametrize("built", [karlsruhe, town10hd], ids=["Karlsruhe", "Town10HD"])
def test_real_lanes_join_and_lie_beside_each_other(built: Build) -> None:
    lane_map, _, _ = built()
    for lane in range(lane_map.num_lanes):
        line = lane_map.lane_points(lane)
        for successor in lane_map.successors_of(lane):
            np.testing.assert_allclose(lane_map.lane_points(successor)[0], line[-1], atol=1e-3)
        for neighbour, side in ((lane_map.left[lane], 1.0), (lane_map.right[lane], -1.0)):
            if neighbour != NO_LANE:
                other = lane_map.lane_points(neighbour)
                across = other[len(other) // 2] - line[len(line) // 2]
                ahead = line[-1] - line[0]
                assert side * (ahead[0] * across[1] - ahead[1] * across[0]) > 0.0
                assert ahead @ (other[-1] - other[0]) > 0.0


def test_a_lanelet_open_both_ways_gives_a_lane_each_way() -> None:
    lane_map, _, _ = karlsruhe()
    index = {int(lane_id): lane for lane, lane_id in enumerate(lane_map.lane_id)}
    for lane_id in (i for i in index if i < 0):
        there, back = (lane_map.lane_points(index[i]) for i in (-lane_id, lane_id))
        np.testing.assert_allclose(there, back[::-1], atol=1e-4)


def test_the_same_map_gives_the_same_bytes() -> None:
    assert decode(build_tile(KARLSRUHE, None, None)[0], "")[1].tile_id == karlsruhe()[1].tile_id


def test_the_origin_is_where_x_and_y_are_zero(write: Write) -> None:
    """A thousandth of a degree of latitude is 111.2 m at 49 degrees, of longitude 73.1 m."""
    places = {1: (49.001, 8.42), 2: (49.001, 8.421), 3: (48.999, 8.42), 4: (48.999, 8.421)}
    nodes = "".join(f'<node id="{n}" lat="{lat}" lon="{lon}"/>' for n, (lat, lon) in places.items())
    lane_map, info, _ = build(write(osm(nodes, lanelet(21, 11, 12))), (49.0, 8.42))
    assert (info.origin_latitude_deg, info.origin_longitude_deg) == (49.0, 8.42)
    np.testing.assert_allclose(lane_map.points[[0, -1]], np.array([[0, 0], [73.1, 0]]), atol=0.1)
    moved, _, _ = build(write(osm(nodes, lanelet(21, 11, 12))), (48.999, 8.42))
    np.testing.assert_allclose(
        moved.points[[0, -1]], np.array([[0, 111.2], [73.1, 111.2]]), atol=0.1
    )


def test_without_an_origin_the_middle_of_the_map_is_zero() -> None:
    _, info, _ = karlsruhe()
    assert 49.0 < info.origin_latitude_deg < 49.01
    assert 8.41 < info.origin_longitude_deg < 8.46


@pytest.mark.parametrize("west_deg", [179.9999, -180.0001])
def test_a_map_across_the_antimeridian_has_its_origin_there(write: Write, west_deg: float) -> None:
    """20 m west of it to 20 m east of it, where a degree of longitude is 106.5 km."""
    nodes = ""
    for node, (x, y) in PLACES.items():
        longitude_deg = math.remainder(west_deg + x / 106.5e3, 360.0)
        nodes += f'<node id="{node}" lat="{-17.0 + y / 110.7e3}" lon="{longitude_deg}"/>'
    lane_map, info, _ = build(write(osm(nodes, *ROAD)))
    assert abs(info.origin_longitude_deg) == pytest.approx(179.9999122, abs=2e-7)
    np.testing.assert_allclose(lane_map.points[[0, -1]], [[-20, 0], [20, 0]], atol=0.02)


def test_longitudes_beyond_180_degrees_are_those_of_the_other_side(write: Write) -> None:
    west, _, _ = build(write(osm(global_nodes(-17.0, -170.0), *ROAD)))
    east, info, _ = build(write(osm(global_nodes(-17.0, 190.0), *ROAD)))
    assert info.origin_longitude_deg == pytest.approx(-169.9998, abs=1e-4)
    np.testing.assert_allclose(east.points, west.points, atol=0.01)


def test_heights_do_not_move_the_map(write: Write) -> None:
    """5 km from the origin, 2,240 m (Mexico City) would move it outwards by 1.76 m."""
    flat, _, _ = build(write(osm(global_nodes(19.4, -99.1), *ROAD)), (19.4, -99.15))
    high = osm(global_nodes(19.4, -99.1, ele="2240"), *ROAD)
    np.testing.assert_array_equal(build(write(high), (19.4, -99.15))[0].points, flat.points)


def test_a_map_around_latitude_and_longitude_zero_keeps_its_plane() -> None:
    """Town10HD spans 225 by 210 m around CARLA's own origin."""
    lane_map, info, _ = town10hd()
    assert np.isnan(info.origin_latitude_deg)
    np.testing.assert_allclose(lane_map.points.min(axis=0), [-114.6, -141.2], atol=0.1)
    np.testing.assert_allclose(lane_map.points.max(axis=0), [110.0, 68.7], atol=0.1)
    placed, info, _ = build(TOWN10HD, (48.0, 11.0))
    assert info.origin_latitude_deg == 48.0
    np.testing.assert_array_equal(placed.points, lane_map.points)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (-300.5, 20.25), (81655.0, 50137.0)])
def test_local_x_and_y_are_kept(write: Write, offset: tuple[float, float]) -> None:
    nodes = "".join(
        local_node(node, x + offset[0], y + offset[1]) for node, (x, y) in PLACES.items()
    )
    lane_map, info, _ = build(write(osm(nodes, *ROAD)))
    np.testing.assert_allclose(lane_map.lane_points(0)[0] - offset, [0.0, 2.0], atol=0.01)
    np.testing.assert_allclose(lane_map.lane_points(1)[-1] - offset, [40.0, 2.0], atol=0.01)
    assert lane_map.successors_of(0).tolist() == [1]
    assert np.isnan(info.origin_latitude_deg)


def with_local(nodes: str, turn_rad: float) -> str:
    """`local_x` and `local_y` beside `nodes`' latitude and longitude, in a grid that is turned."""
    for node, (x, y) in PLACES.items():
        grid = (x + 1j * y) * complex(math.cos(turn_rad), math.sin(turn_rad))
        local = tagged({"local_x": str(grid.real), "local_y": str(grid.imag)})
        head, tail = nodes.split(f'<node id="{node}"')
        nodes = f'{head}<node id="{node}"' + tail.replace("</node>", f"{local}</node>", 1)
    return nodes


def test_an_origin_that_local_x_and_y_do_not_have_is_refused(write: Write) -> None:
    """A grid turned by 2 degrees is 1.4 m off at 40 m; latitude and longitude tell."""
    nodes, turn_rad = global_nodes(49.0, 8.4), math.radians(2.0)
    lane_map, info, _ = build(write(osm(with_local(nodes, 0.0), *ROAD)), (49.0, 8.4))
    assert info.origin_latitude_deg == 49.0
    np.testing.assert_allclose(lane_map.points[[0, -1]], [[0, 2], [40, 2]], atol=1e-4)
    turned = write(osm(with_local(nodes, turn_rad), *ROAD))
    with pytest.raises(TileError, match=r"local_y of node 5 lie 1\.\d m from its latitude"):
        build_tile(turned, (49.0, 8.4), None)
    with pytest.raises(TileError, match=r"local_y of node 1 lie 1\d+\.\d m from its latitude"):
        build_tile(write(osm(with_local(nodes, 0.0), *ROAD)), (49.001, 8.4), None)
    _, info, _ = build(turned)  # nothing is claimed
    assert info.origin_deg is None


def test_a_way_back_whose_id_is_taken_is_refused(write: Write) -> None:
    path = write(osm(LOCAL, lanelet(21, 11, 12, one_way="no"), lanelet(-21, 13, 14)))
    with pytest.raises(TileError, match="lanelet 21 is open both ways, and -21, the id of its way"):
        build_tile(path, None, None)


def test_speed_limits_are_the_maps_own(write: Write) -> None:
    stated = lanelet(21, 11, 12, speed_limit="36 km/h", subtype="highway")
    lane_map, _, _ = build(write(osm(LOCAL, stated, lanelet(22, 13, 14))))
    np.testing.assert_allclose(lane_map.speed_limit_mps, [10.0, np.nan])
    assert lane_map.lane_type.tolist() == [LaneType.HIGHWAY, LaneType.URBAN]


SIGN = (
    '<relation id="31"><tag k="type" v="regulatory_element"/>'
    '<tag k="subtype" v="speed_limit"/><tag k="sign_type" v="{}"/></relation>'
)
SIGNED = ROAD[0].replace(
    "</relation>", '<member type="relation" ref="31" role="regulatory_element"/></relation>'
)


@pytest.mark.parametrize("said", ["none", "walk", "-30", "0", "5000", "nan"])
def test_a_speed_limit_that_is_none_is_not_known(write: Write, said: str) -> None:
    odd = lanelet(21, 11, 12, speed_limit=said)
    lane_map, _, skipped = build(write(osm(LOCAL, odd, lanelet(22, 13, 14, speed_limit="36"))))
    np.testing.assert_allclose(lane_map.speed_limit_mps, [np.nan, 10.0])
    assert lane_map.successors_of(0).tolist() == [1]
    assert skipped == [f"speed limit of lanelet 21: {said} is not a known speed"]


def test_a_sign_that_is_not_known_costs_its_speed_limit_only(write: Write) -> None:
    lane_map, _, skipped = build(write(osm(LOCAL, SIGNED, ROAD[1], SIGN.format("36 km/h"))))
    np.testing.assert_allclose(lane_map.speed_limit_mps, [10.0, np.nan])
    assert skipped == []
    lane_map, _, skipped = build(write(osm(LOCAL, SIGNED, ROAD[1], SIGN.format("R2-1"))))
    np.testing.assert_allclose(lane_map.speed_limit_mps, [np.nan, np.nan])
    assert lane_map.successors_of(0).tolist() == [1]
    assert skipped == ["speed limit of lanelet 21: what its sign says is not a known speed"]


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ('<relation id="22"', '<relation id="21"', "relation 21 comes again"),
        ('<way id="14"', '<way id="12"', "way 12 comes again"),
        ('<relation id="22"', "<relation", "relation '': its id is not a whole number"),
        ('"13"', '"left side"', "way 'left side': its id is not a whole number"),
        ('id="22"', 'id="9223372036854775808"', "'9223372036854775808': its id is not"),
        ('"way" ref="13"', '"node" ref="1"', "lanelet 22 has a left bound that is not there"),
        ('<way id="14"', '<way action="delete" id="14"', "not whole (way 14)"),
        ('<node id="6"', '<node action="delete" id="6"', "not whole (way 14)"),
    ],
)
def test_what_would_crash_the_library_is_left_out_and_named(
    write: Write, before: str, after: str, said: str
) -> None:
    """In a process of its own, that a crash does not end the tests."""
    source = write(osm(LOCAL, *ROAD).replace(before, after))
    out = source.with_suffix(".tile")
    command = [sys.executable, "-m", "eqrt", "tile", "build", str(source), "--out", str(out)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0
    assert said in done.stderr
    assert load_tile(out).lane_map.lane_id.tolist() == [21]


def test_a_deleted_lanelet_is_no_lane_and_no_loss(write: Write) -> None:
    gone = ROAD[1].replace("<relation", "<relation action='delete'")
    lane_map, _, skipped = build(write(osm(LOCAL, ROAD[0], gone)))
    assert lane_map.lane_id.tolist() == [21]
    assert skipped == []


def test_what_a_city_has_besides_lanelets_is_left_out_in_no_time() -> None:
    """40,000 nodes and 20,000 traffic lights: removed one by one, they took half a minute."""
    nodes = "".join(local_node(node, 0.0, 0.0) for node in range(1, 40_001))
    lights = "".join(f'<relation id="{light}"/>' for light in range(100, 20_100))
    root = ElementTree.fromstring(osm(nodes, *ROAD, lights))
    begin_s = time.perf_counter()
    assert keep_lanelets(root) == []
    assert time.perf_counter() - begin_s < 10.0
    assert [lane.get("id") for lane in root.findall("relation")] == ["21", "22"]


def test_broken_lanelets_are_left_out_and_named(write: Write) -> None:
    dangling = lanelet(23, 11, 99)
    shapeless = '<relation id="24"><tag k="type" v="lanelet"/></relation>'
    sign = '<relation id="31"><member type="way" ref="77" role="refers"/></relation>'
    lane_map, _, skipped = build(write(osm(LOCAL, *ROAD, dangling, shapeless, sign)))
    assert lane_map.lane_id.tolist() == [21, 22]
    assert skipped == [
        "lanelet 23 has a right bound that is not there or not whole (way 99)",
        "lanelet 24 has 0 left bounds, expected one",
    ]


def test_a_lanelet_without_length_is_left_out_and_named(write: Write) -> None:
    """Both of its bounds lead back to where they begin."""
    ways = (
        '<way id="15"><nd ref="1"/><nd ref="1"/></way><way id="16"><nd ref="3"/><nd ref="3"/></way>'
    )
    text = osm(LOCAL, *ROAD, lanelet(23, 15, 16)).replace("<relation", ways + "<relation", 1)
    lane_map, _, skipped = build(write(text))
    assert lane_map.lane_id.tolist() == [21, 22]
    assert skipped == ["lane 23 is shorter than a centimetre"]


def test_a_commonroad_scenario_becomes_a_tile_with_its_credit() -> None:
    lane_map, info, _ = build(US101, (34.138, -118.364))
    assert lane_map.num_lanes == 18
    assert info.name == "USA_US101-22_4_T-1"
    assert info.credit == "Next Generation Simulation (NGSIM) and OpenStreetMaps (OSM)"
    assert info.origin_longitude_deg == -118.364


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not XML"),
        ("<osm", "not XML"),
        ("<commonRoad/>", "the root is <commonRoad>, expected <osm> with nodes"),
        ("<osm version='0.6'/>", "expected <osm> with nodes"),
        (osm('<node id="1" lat="" lon=""/>'), "a node's place is ('', ''), expected two numbers"),
        ('<?xml version="1.0" encoding="klingon"?><osm/>', "not XML (unknown encoding: klingon)"),
        ('<?xml version="1.0" encoding="shift_jis"?><osm/>', "not XML (multi-byte encodings"),
        (osm(LOCAL.replace("</node>", "<a>" * 9999 + "</a>" * 9999 + "</node>")), "recursion"),
        (osm(global_nodes(139.7, 35.7), *ROAD), "are latitude and longitude swapped?"),
        (osm(LOCAL.replace('v="20"', 'v="nan"'), *ROAD), "a node's place is ('nan', '4')"),
        (osm(LOCAL), "no lanes for vehicles"),
        (osm(LOCAL, lanelet(21, 11, 12, subtype="walkway")), "no lanes for vehicles"),
        (osm(local_node(1, 4e5, 0) + LOCAL[LOCAL.index('<node id="2"') :], *ROAD), "131 km"),
        (osm(local_node(1, 1e15, 0) + LOCAL[LOCAL.index('<node id="2"') :], *ROAD), "131 km"),
        (osm(LOCAL.replace('v="20"', 'v="twenty"'), *ROAD), "a node's place is ('twenty', '4')"),
    ],
)
def test_a_broken_map_is_one_line_that_names_the_file(
    write: Write, text: str, message: str
) -> None:
    path = write(text)
    with pytest.raises(TileError) as caught:
        build_tile(path, None, None)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_formats_that_are_not_read_are_said(tmp_path: Path) -> None:
    for name in ("e6mini.xodr", "map.json", "noname"):
        with pytest.raises(EqrtError, match=r"supported are Lanelet2 .* and CommonRoad"):
            build_tile(tmp_path / name, None, None)
    with pytest.raises(EqrtError, match="no such map file"):
        build_tile(tmp_path / "none.osm", None, None)


def test_the_command_builds_a_tile_that_loads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "karlsruhe.tile"
    command = ["tile", "build", str(KARLSRUHE), "--out", str(out), "--origin", "49,8.42"]
    assert main([*command, "--credit", "FZI, BSD-3"]) == 0
    printed = capsys.readouterr().out
    assert main(["tile", "info", str(out)]) == 0
    assert capsys.readouterr().out == printed
    assert "388, 5.17 km" in printed
    assert "latitude 49.0000000, longitude 8.4200000" in printed
    assert "FZI, BSD-3" in printed
    assert load_tile(out).info.tile_id in printed


def test_the_command_names_what_it_left_out(
    write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shapeless = [
        f'<relation id="{n}"><tag k="type" v="lanelet"/></relation>' for n in range(51, 76)
    ]
    path = write(osm(LOCAL, *ROAD, *shapeless))
    assert main(["tile", "build", str(path), "--out", str(tmp_path / "a.tile")]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "note: 25 parts of the map were left out:"
    assert said[1] == "  lanelet 51 has 0 left bounds, expected one"
    assert said[20:] == ["  lanelet 70 has 0 left bounds, expected one", "  and 5 more"]


def test_a_map_is_not_overwritten_by_its_tile(
    write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(osm(LOCAL, *ROAD))
    assert main(["tile", "build", str(path), "--out", str(path)]) == 2
    assert f"--out {path} is the map itself" in capsys.readouterr().err
    assert path.read_text() == osm(LOCAL, *ROAD)


def test_a_failed_build_leaves_the_old_tile(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.tile"
    assert main(["tile", "build", str(US101), "--out", str(out)]) == 0
    before = out.read_bytes()
    broken = tmp_path / "broken.xml.gz"
    broken.write_bytes(US101.read_bytes()[:5000])
    capsys.readouterr()
    assert main(["tile", "build", str(broken), "--out", str(out)]) == 1
    assert capsys.readouterr().err.startswith(f"eqrt: {broken}: cannot be read")
    assert out.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.tile", "broken.xml.gz"]


def test_a_tile_that_cannot_be_written_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "no" / "such" / "folder.tile"
    assert main(["tile", "build", str(US101), "--out", str(out)]) == 1
    assert capsys.readouterr().err.startswith(f"eqrt: {out}: the tile cannot be written")


@pytest.mark.parametrize("origin", ["49", "49,8,1", "north,8", "91,8", "49,181", "nan,8"])
def test_an_origin_that_is_no_place_is_wrong_usage(
    origin: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tile", "build", str(US101), "--out", "x", "--origin", origin]) == 2
    assert "LAT,LON in degrees" in capsys.readouterr().err


def test_without_lanelet2_the_command_says_what_to_install(tmp_path: Path) -> None:
    source = tmp_path / "map.osm"
    source.write_bytes(gzip.decompress(KARLSRUHE.read_bytes()))
    program = (
        "import sys; sys.modules['lanelet2'] = None; from eqrt.cli import main; "
        f"sys.exit(main(['tile', 'build', {str(source)!r}, '--out', 'x']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], check=False, capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "eqrt: reading Lanelet2 maps needs the package 'lanelet2', which is not installed; "
        "install it with: pip install 'eqrt[maps]'"
    ]


@pytest.mark.parametrize("name", ["Town.OSM.GZ", "Town.Osm.gz"])
def test_a_file_may_be_named_in_capitals(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(TOWN10HD.read_bytes())
    data, _ = build_tile(path, None, None)
    _, info = decode(data, name)
    assert (info.name, info.source) == ("Town", name)
