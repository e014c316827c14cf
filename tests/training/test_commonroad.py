"""CommonRoad scenarios: the recorded ones are read as they are, and broken ones refused."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eqrt.core.errors import LogError, TileError
from eqrt.core.lanes import NO_LANE, LaneType
from eqrt.training.recordings.commonroad import lane_map, read_scenario

NGSIM = Path(__file__).parents[1] / "data/ngsim"

LANELETS = """
<lanelet id="1">
  <leftBound><point><x>0</x><y>4</y></point><point><x>10</x><y>4</y></point></leftBound>
  <rightBound><point><x>0</x><y>0</y></point><point><x>10</x><y>0</y></point></rightBound>
  <adjacentLeft ref="3" drivingDir="opposite"/><adjacentRight ref="4" drivingDir="same"/>
  <speedLimit>13.5</speedLimit>
</lanelet>
<lanelet id="2">
  <leftBound><point><x>10</x><y>4</y></point><point><x>20</x><y>4</y></point></leftBound>
  <rightBound><point><x>10</x><y>0</y></point><point><x>20</x><y>0</y></point></rightBound>
  <predecessor ref="1"/><successor ref="99"/><laneletType>interstate</laneletType>
</lanelet>
<lanelet id="3">
  <leftBound><point><x>10</x><y>4</y></point><point><x>0</x><y>4</y></point></leftBound>
  <rightBound><point><x>10</x><y>8</y></point><point><x>0</x><y>8</y></point></rightBound>
</lanelet>
<lanelet id="4">
  <leftBound><point><x>0</x><y>0</y></point><point><x>10</x><y>0</y></point></leftBound>
  <rightBound><point><x>0</x><y>-4</y></point><point><x>10</x><y>-4</y></point></rightBound>
  <adjacentLeft ref="1" drivingDir="same"/>
</lanelet>
"""
STATE = """
<position><point><x>{x}</x><y>2</y></point></position><orientation><exact>0.1</exact></orientation>
<time><exact>{step}</exact></time><velocity><exact>10</exact></velocity>
"""
OBSTACLE = (
    '<dynamicObstacle id="5"><type>truck</type>'
    "<shape><rectangle><length>9</length><width>2.5</width></rectangle></shape>"
    f"<initialState>{STATE.format(x=1, step=3)}</initialState>"
    f"<trajectory><state>{STATE.format(x=2, step=4)}</state></trajectory></dynamicObstacle>"
)
SCENARIO = (
    '<commonRoad benchmarkID="TEST" commonRoadVersion="2020a" timeStepSize="0.1" source="drawn">'
    f"{LANELETS}{OBSTACLE}</commonRoad>"
)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str | bytes], Path]:
    def write(content: str | bytes) -> Path:
        path = tmp_path / "scenario.xml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.mark.parametrize(
    ("name", "num_tracks", "num_lanelets"),
    [
        ("USA_Lanker-1_1", 24, 91),  # 2018b
        ("USA_Lanker-1_2", 42, 91),  # 2018b
        ("USA_Lanker-2_23", 53, 116),
        ("USA_Peach-2_1", 16, 75),
        ("USA_Peach-4_8", 9, 79),
        ("USA_US101-15_1", 37, 12),
        ("USA_US101-21_2", 30, 12),
        ("USA_US101-22_4", 52, 18),
        ("USA_US101-5_1", 25, 5),
    ],
)
def test_recorded_scenarios_are_read_whole(name: str, num_tracks: int, num_lanelets: int) -> None:
    scenario = read_scenario(NGSIM / f"{name}_T-1.xml.gz")
    assert scenario.name == f"{name}_T-1"
    assert scenario.dt_s == 0.1
    assert len(scenario.tracks) == num_tracks
    assert len(scenario.lanelets) == num_lanelets
    assert lane_map(scenario).num_lanes == num_lanelets
    assert "NGSIM" in scenario.source
    assert "OpenStreetMaps" in scenario.source


def test_the_first_recorded_car_is_where_the_file_says() -> None:
    track = read_scenario(NGSIM / "USA_Lanker-1_1_T-1.xml.gz").tracks[0]
    assert (track.track_id, track.object_type) == (1213, "car")
    assert (track.length_m, track.width_m) == (3.1699, 2.0726)
    assert track.step[:3].tolist() == [0, 1, 2]
    assert track.position[:2].tolist() == [[6.6928, 14.2381], [7.1255, 15.1052]]
    assert track.heading_rad[1] == 1.0983
    assert track.speed_mps[1] == 9.6774


@pytest.mark.parametrize("name", ["USA_US101-22_4", "USA_Lanker-1_1"])
def test_recorded_cars_move_as_fast_as_they_say(name: str) -> None:
    """Positions, steps and speeds agree: the time step is right."""
    scenario = read_scenario(NGSIM / f"{name}_T-1.xml.gz")
    moved = [np.hypot(*np.diff(track.position, axis=0).T) for track in scenario.tracks]
    said = [track.speed_mps[1:] for track in scenario.tracks]
    difference = np.concatenate(moved) / scenario.dt_s - np.concatenate(said)
    assert abs(np.median(difference)) < 0.05


@pytest.mark.parametrize("path", sorted(NGSIM.glob("*.gz")), ids=lambda path: str(path.name))
def test_recorded_lanes_join_and_lie_beside_each_other(path: Path) -> None:
    lanes = lane_map(read_scenario(path))
    for lane in range(lanes.num_lanes):
        line = lanes.lane_points(lane)
        for successor in lanes.successors_of(lane):
            np.testing.assert_allclose(lanes.lane_points(successor)[0], line[-1], atol=0.01)
        for neighbour, side in ((lanes.left[lane], 1.0), (lanes.right[lane], -1.0)):
            if neighbour != NO_LANE:
                other = lanes.lane_points(neighbour)
                # At half way: neighbours may part from one point, and come together in one.
                across = other[len(other) // 2] - line[len(line) // 2]
                ahead = line[len(line) // 2] - line[len(line) // 2 - 1]
                assert side * (ahead[0] * across[1] - ahead[1] * across[0]) > 0.0
                assert ahead @ (other[-1] - other[0]) > 0.0


def test_a_drawn_scenario_is_read_value_by_value(write: Callable[[str], Path]) -> None:
    scenario = read_scenario(write(SCENARIO))
    (track,) = scenario.tracks
    assert (track.track_id, track.object_type, track.length_m, track.width_m) == (
        5,
        "truck",
        9.0,
        2.5,
    )
    assert track.step.tolist() == [3, 4]
    assert track.position.tolist() == [[1.0, 2.0], [2.0, 2.0]]
    first = scenario.lanelets[0]
    assert first.adjacent_left is not None
    assert (first.adjacent_left.lanelet_id, first.adjacent_left.same_direction) == (3, False)
    assert first.speed_limit_mps == 13.5
    assert math.isnan(scenario.lanelets[1].speed_limit_mps)


def test_the_centerline_runs_halfway_between_the_bounds(write: Callable[[str], Path]) -> None:
    lanes = lane_map(read_scenario(write(SCENARIO)))
    assert lanes.lane_points(0).tolist() == [[x, 2.0] for x in (0.0, 2.0, 4.0, 6.0, 8.0, 10.0)]
    assert lanes.lane_points(2)[0].tolist() == [10.0, 6.0]  # oncoming


def test_connections_are_mended_and_unknown_ones_dropped(write: Callable[[str], Path]) -> None:
    lanes = lane_map(read_scenario(write(SCENARIO)))
    assert lanes.successors_of(0).tolist() == [1]  # said by its successor only
    assert lanes.successors_of(1).tolist() == []  # lanelet 99 is not there
    assert lanes.left.tolist() == [-1, -1, -1, 0]  # the oncoming lane is no neighbour
    assert lanes.right.tolist() == [3, -1, -1, -1]
    assert lanes.lane_type[1] == LaneType.HIGHWAY


@pytest.mark.parametrize("word", ["sidewalk", "crosswalk", "bicycleLane"])
def test_lanelets_that_no_vehicle_drives_on_are_no_lanes(
    write: Callable[[str], Path], word: str
) -> None:
    words = f"<laneletType>intersection</laneletType><laneletType>{word}</laneletType>"
    drawn = SCENARIO.replace('<adjacentLeft ref="1" drivingDir="same"/>', words)
    lanes = lane_map(read_scenario(write(drawn)))
    assert lanes.lane_id.tolist() == [1, 2, 3]
    assert lanes.right.tolist() == [NO_LANE, NO_LANE, NO_LANE]


def test_of_several_types_the_one_for_vehicles_counts(write: Callable[[str], Path]) -> None:
    words = "".join(
        f"<laneletType>{word}</laneletType>" for word in ("intersection", "bicycleLane", "urban")
    )
    drawn = SCENARIO.replace("<laneletType>interstate</laneletType>", words)
    lanes = lane_map(read_scenario(write(drawn)))
    assert lanes.num_lanes == 4
    assert lanes.lane_type[1] == LaneType.URBAN


def test_a_lanelet_that_comes_twice_counts_once(write: Callable[[str], Path]) -> None:
    twice = SCENARIO.replace("</commonRoad>", f"{LANELETS}</commonRoad>")
    assert lane_map(read_scenario(write(twice))).num_lanes == 4


def test_a_gzipped_scenario_is_told_by_its_bytes(write: Callable[[bytes], Path]) -> None:
    assert read_scenario(write(gzip.compress(SCENARIO.encode()))).name == "TEST"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ((NGSIM / "USA_Peach-4_8_T-1.xml.gz").read_bytes()[:9000], "cannot be read"),
        (b"\x1f\x8b" + b"rubbish" * 9, "cannot be read"),
        (b"", "not XML"),
        (b"\x00\xff\xfe no text", "not XML"),
        (SCENARIO[:-30], "not XML"),
        ('<?xml version="1.0" encoding="klingon"?><commonRoad/>', "not XML (unknown encoding"),
        ("<osm/>", "the root is <osm>"),
        (SCENARIO.replace("2020a", "2017a"), "CommonRoad 2017a is not supported"),
        (SCENARIO.replace(LANELETS, ""), "no lanelets"),
        (SCENARIO.replace('timeStepSize="0.1"', ""), "timeStepSize: expected a number"),
        (SCENARIO.replace('"0.1"', '"-0.1"'), "expected above 0 s"),
        (SCENARIO.replace('lanelet id="2"', 'lanelet id="two"'), "lanelet two: expected a whole"),
        (SCENARIO.replace("<point><x>0</x><y>4</y></point>", ""), "leftBound has 1 points"),
        (SCENARIO.replace("<y>-4</y>", ""), "lanelet 4 rightBound: expected a number"),
        (SCENARIO.replace("<y>-4</y>", "<y>nan</y>"), "lanelet 4 rightBound: expected a number"),
        (SCENARIO.replace("<exact>4</exact>", "<exact>3</exact>"), "do not rise"),
        (SCENARIO.replace("<exact>4</exact>", "<exact>4.5</exact>"), "in whole steps"),
        (SCENARIO.replace("<exact>0.1</exact>", ""), "obstacle 5: orientation: expected a number"),
        (SCENARIO.replace("<x>2</x>", ""), "obstacle 5: expected a number, found None"),
        (SCENARIO.replace("<length>9</length>", ""), "obstacle 5: expected a number"),
    ],
)
def test_a_broken_scenario_is_one_line_that_names_the_file(
    write: Callable[[str | bytes], Path], content: str | bytes, message: str
) -> None:
    path = write(content)
    with pytest.raises(LogError) as caught:
        read_scenario(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("<x>20</x>", "<x>5e5</x>", "lane 2 lies more than 131 km"),
        ("<x>20</x>", "<x>1e30</x>", "lane 2 lies more than 131 km"),
        ("<x>20</x>", "<x>10</x>", "lane 2 is shorter than 1 cm"),
        ("13.5", "-13.5", "lane 1 has a speed limit of -13.5 m/s, expected 0 to 1000"),
        ('id="2"', 'id="9223372036854775808"', "lane id 9223372036854775808 has more than 64 bits"),
    ],
)
def test_lanes_that_cannot_be_are_one_line_that_names_the_file(
    write: Callable[[str], Path], before: str, after: str, message: str
) -> None:
    scenario = read_scenario(write(SCENARIO.replace(before, after)))
    with pytest.raises(TileError) as caught:
        lane_map(scenario)
    assert str(caught.value).startswith(f"{scenario.path}: {message}")
    assert "\n" not in str(caught.value)


def test_a_missing_scenario_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none\.xml: no such scenario file"):
        read_scenario(tmp_path / "none.xml")
