"""Traffic simulated by SUMO itself on a small town: how it moves, what is seen, what is written."""

from __future__ import annotations

import dataclasses
import gzip
import importlib.resources
import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eqrt.cli import main
from eqrt.core.errors import LogError, TileError
from eqrt.core.lanes import NO_LANE, LaneMap, LaneType
from eqrt.training.recordings.recording import Recording
from eqrt.training.recordings.recording_file import RecordingFileReader
from eqrt.training.simulation.bends import bend_speeds
from eqrt.training.simulation.drivers import Driver
from eqrt.training.simulation.motion import plausible_motion
from eqrt.training.simulation.scenario import read_scenario
from eqrt.training.simulation.sensor import SENSORS, Sensor, observe
from eqrt.training.simulation.sumo_lanes import read_sumo_lanes
from eqrt.training.simulation.traffic import Traffic

FLOWS = [  # from, to: straight on, left, right, and back through the town
    ("left0A0", "C0right0"),
    ("left1A1", "B2top1"),
    ("right1C1", "B2top1"),
    ("bottom1B0", "A1left1"),
    ("top0A2", "C1right1"),
]
ROUTES = (
    '<routes><vType id="lorry" vClass="truck" length="9"/>'
    + "".join(
        f'<flow id="f{i}" from="{start}" to="{end}" begin="0" end="600" period="6"/>'
        for i, (start, end) in enumerate(FLOWS)
    )
    + "</routes>"
)
DETECTORS = (
    '<additional><e1Detector id="d" lane="left0A0_0" pos="20" freq="10" file="seen.xml"/>'
    "</additional>"
)
CONFIG = """<configuration>
  <input><net-file value="town.net.xml"/><route-files value="town.rou.xml"/>
    <additional-files value="town.add.xml"/></input>
  <output><tripinfo-output value="trips.xml"/></output>
  <time><begin value="0"/><end value="10"/></time>
</configuration>"""
SMALL = [
    "--recordings",
    "4",
    "--seconds",
    "12",
    "--warmup",
    "40",
    "--scale",
    "1.0",
    "--radius",
    "60",
]


def sumo_tool(name: str, *options: str | Path) -> None:
    program = Path(str(importlib.resources.files("sumo")), "bin", name)
    subprocess.run([program, *options], check=True, capture_output=True)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario of nine crossings, two lanes each way."""
    folder = tmp_path_factory.mktemp("town")
    grid = "--grid --grid.number 3 --grid.length 120 --grid.attach-length 80 -L 2"
    sumo_tool("netgenerate", *grid.split(), "-o", folder / "town.net.xml")
    for name, text in (("rou", ROUTES), ("add", DETECTORS)):
        (folder / f"town.{name}.xml").write_text(text)
    (folder / "town.sumocfg").write_text(CONFIG)
    return folder / "town.sumocfg"


@pytest.fixture(scope="module")
def recordings(town: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Recording]:
    out = tmp_path_factory.mktemp("recorded") / "perfect"
    assert main(["simulate", str(town), "--out", str(out), "--sensor", "perfect", *SMALL]) == 0
    return read_all(out)


def read_all(folder: Path) -> list[Recording]:
    reader = RecordingFileReader.open(folder)
    return [each for part in reader.parts(folder) for each in reader.read(part)]


# The lanes of a network


@pytest.fixture
def net(tmp_path: Path) -> Callable[..., Path]:
    """Build a network: nodes as (id, x, y), edges as attributes."""

    def build(nodes: list[tuple[str, float, float]], edges: list[str], *options: str) -> Path:
        drawn = "".join(f'<node id="{i}" x="{x}" y="{y}"/>' for i, x, y in nodes)
        (tmp_path / "n.nod.xml").write_text(f"<nodes>{drawn}</nodes>")
        drawn = "".join(f"<edge {edge}/>" for edge in edges)
        (tmp_path / "n.edg.xml").write_text(f"<edges>{drawn}</edges>")
        out = tmp_path / "n.net.xml"
        files = ("-n", tmp_path / "n.nod.xml", "-e", tmp_path / "n.edg.xml", "-o", out)
        sumo_tool("netconvert", *files, "--offset.disable-normalization", *options)
        return out

    return build


CORNER = [("a", 0.0, 0.0), ("b", 100.0, 0.0), ("c", 100.0, 100.0)]
WAYS = [
    'id="ab" from="a" to="b" numLanes="2" speed="13"',
    'id="bc" from="b" to="c" numLanes="1" speed="9"',
]


def named(lanes: LaneMap, point: tuple[float, float]) -> int:
    """The lane that begins nearest to a point."""
    starts = lanes.points[lanes.lane_start[:-1]]
    return int(np.hypot(*(starts - point).T).argmin())


def test_routes_lead_through_junctions(net: Callable[..., Path]) -> None:
    lanes = read_sumo_lanes(net(CORNER, WAYS))
    middle = named(lanes, (0.0, -1.6))  # of two lanes of 3.2 m, right of the line, the left one
    [inside] = lanes.successors_of(middle)
    [after] = lanes.successors_of(inside)
    np.testing.assert_allclose(lanes.lane_points(after)[-1], (101.6, 100.0), atol=0.01)
    ends, begins = lanes.lane_points(inside)[-1], lanes.lane_points(after)[0]
    np.testing.assert_allclose(ends, begins, atol=0.05)
    assert not len(lanes.successors_of(after))
    assert lanes.speed_limit_mps[[middle, after]].tolist() == [13.0, 9.0]
    assert np.hypot(*np.diff(lanes.lane_points(middle), axis=0).T).max() < 2.5


@pytest.mark.parametrize(("options", "side"), [([], "left"), (["--lefthand"], "right")])
def test_neighbours_are_left_and_right_wherever_people_drive(
    net: Callable[..., Path], options: list[str], side: str
) -> None:
    lanes = read_sumo_lanes(net(CORNER[:2], WAYS[:1], *options))
    sign = -1.0 if side == "left" else 1.0
    kerb, middle = named(lanes, (0.0, sign * 4.8)), named(lanes, (0.0, sign * 1.6))
    other = {"left": "right", "right": "left"}[side]
    assert getattr(lanes, side)[kerb] == middle
    assert getattr(lanes, other)[middle] == kerb
    assert getattr(lanes, side)[middle] == getattr(lanes, other)[kerb] == NO_LANE


def test_footpaths_are_left_out_and_bus_lanes_are_told(net: Callable[..., Path]) -> None:
    ways = [
        'id="ab" from="a" to="b" numLanes="1" speed="13" sidewalkWidth="2"',
        'id="bc" from="b" to="c" numLanes="1" speed="9" allow="bus"',
    ]
    lanes = read_sumo_lanes(net(CORNER, ways, "--crossings.guess"))
    kinds = {lanes.lane_type[named(lanes, point)] for point in ((0.0, -1.6), (101.6, 5.0))}
    assert kinds == {LaneType.URBAN, LaneType.BUS}
    assert lanes.num_lanes == 3  # and the one in the junction


def test_a_network_that_is_none_is_refused(net: Callable[..., Path], tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"gone\.net\.xml: no such network"):
        read_sumo_lanes(tmp_path / "gone.net.xml")
    (tmp_path / "n.xml").write_text("town")
    with pytest.raises(LogError, match="not a SUMO network"):
        read_sumo_lanes(tmp_path / "n.xml")
    whole = net(CORNER, WAYS).read_bytes()
    damaged = {
        "encoding": whole.replace(b"UTF-8", b"klingon"),
        "shape": re.sub(rb'shape="[^"]*"', b'shape=""', whole),
        "cut": gzip.compress(whole)[:-20],
    }
    for what, data in damaged.items():
        (tmp_path / f"{what}.net.xml").write_bytes(data)
        with pytest.raises(LogError, match=rf"{what}\.net\.xml: not a SUMO network"):
            read_sumo_lanes(tmp_path / f"{what}.net.xml")
    with pytest.raises(TileError, match="no lanes for vehicles"):
        read_sumo_lanes(net(CORNER[:2], ['id="ab" from="a" to="b" allow="pedestrian"']))


def test_sharp_bends_are_slow_and_straight_lanes_are_not(net: Callable[..., Path]) -> None:
    ways = [*WAYS, 'id="s" from="c" to="d" speed="20" shape="100,100 150,100 150,150 200,150"']
    speeds = bend_speeds(net([*CORNER, ("d", 200.0, 150.0)], ways), 2.8)
    assert speeds.keys() == {":b_0_0", ":c_0_0", "s_0"}
    assert 3.0 <= speeds[":b_0_0"] < 7.0
    assert speeds["s_0"] == 10.0  # half the limit at least: it is not all bend


# How vehicles move


def move(front: np.ndarray, heading_rad: float, length_m: float = 4.5) -> tuple[np.ndarray, ...]:
    lives = np.array([[0, len(front)]])
    start, size = np.array([heading_rad]), np.array([length_m])
    centers, heading = plausible_motion(front[None], start, size, lives)
    return centers[0], heading[0]


def lateral_mps2(centers: np.ndarray) -> np.ndarray:
    velocity = np.diff(centers) / 0.1
    acceleration = np.diff(velocity) / 0.1
    along = velocity[1:] / np.maximum(np.abs(velocity[1:]), 0.1)
    return np.abs((acceleration * along.conj()).imag)


def test_straight_on_the_center_is_half_a_length_behind_the_front() -> None:
    front = np.arange(60) * (0.6 + 0.8j)
    centers, heading = move(front, np.arctan2(0.8, 0.6))
    np.testing.assert_allclose(centers, front - 2.25 * (0.6 + 0.8j), atol=1e-9)
    np.testing.assert_allclose(heading, np.arctan2(0.8, 0.6), atol=1e-9)


def test_on_a_circle_the_body_leans_in_as_wheels_make_it() -> None:
    """The rear axle, 0.8 lengths behind, runs on the circle that its own direction touches."""
    radius, turn = 12.0, 0.05
    front = radius * np.exp(1j * turn * np.arange(400))
    _, heading = move(front, np.pi / 2.0)
    lean = np.angle(np.exp(1j * (turn * np.arange(400) + np.pi / 2.0 - heading)))
    np.testing.assert_allclose(lean[200:-20], np.arcsin(0.8 * 4.5 / radius), rtol=0.03)


def test_a_corner_in_a_drawn_lane_becomes_a_turn() -> None:
    along = np.arange(-40, 41) * 0.6  # 6 m/s, a right angle in the middle
    front = np.where(along < 0.0, along + 0j, 1j * along)
    assert lateral_mps2(front).max() > 50.0
    centers, heading = move(front, 0.0)
    assert lateral_mps2(centers).max() < 5.5
    assert np.abs(np.diff(heading)).max() < 0.12  # 1.2 rad/s
    np.testing.assert_allclose(heading[-1], np.pi / 2.0, atol=0.01)


def test_a_car_that_brakes_to_a_stop_neither_overshoots_nor_rolls_back() -> None:
    time_s = np.arange(80) * 0.1
    braking = np.minimum(time_s, 3.0)
    front = 12.0 * braking - 2.0 * braking**2 + 0j
    centers, _ = move(front, 0.0)
    assert (np.diff(centers.real) >= -1e-9).all()
    assert centers.real.max() <= front.real.max() - 2.25 + 1e-9


def test_a_standing_car_keeps_its_heading() -> None:
    centers, heading = move(np.full(30, 5.0 + 5.0j), 1.0)
    np.testing.assert_allclose(heading, 1.0)
    np.testing.assert_allclose(centers, 5.0 + 5.0j - 2.25 * np.exp(1j))


def test_drivers_differ_and_keep_their_own_laws() -> None:
    rng = np.random.default_rng(0)
    drivers = [Driver.draw(rng, 1.0, big=False) for _ in range(200)]
    assert all(each.headway_s >= each.reaction_s for each in drivers)
    assert np.std([each.speed_factor for each in drivers]) > 0.1
    assert np.mean([each.accel_mps2 for each in drivers]) > 1.8
    assert np.mean([Driver.draw(rng, 1.0, big=True).accel_mps2 for _ in range(200)]) < 1.5


# What is seen


def queue(*places: complex, steps: int = 400) -> Traffic:
    """Cars that stand at places, facing east."""
    count = len(places)
    return Traffic(
        names=tuple(map(str, range(count))),
        centers=np.repeat(np.array(places)[:, None], steps, axis=1),
        heading_rad=np.zeros((count, steps)),
        present=np.ones((count, steps), np.bool_),
        length_m=np.full(count, 4.5),
        width_m=np.full(count, 1.8),
        is_car=np.ones(count, np.bool_),
    )


def look(traffic: Traffic, sensor: Sensor) -> dict[str, float]:
    """From the first car: name -> share of steps seen."""
    sightings = observe(traffic, 0, slice(0, 400), sensor, np.random.default_rng(0))
    names = [traffic.names[row] for row in sightings.rows]
    return dict(zip(names, sightings.seen.mean(axis=1), strict=True))


def test_a_car_in_front_hides_the_one_before_it() -> None:
    traffic = queue(0j, 10 + 0j, 30 + 0j, 30 + 12j, 150 + 0j)
    assert look(traffic, SENSORS["perfect"]) == {"0": 1.0, "1": 1.0, "2": 1.0, "3": 1.0}
    seen = look(traffic, SENSORS["good"])
    assert seen["2"] == 0.0
    assert min(seen["1"], seen["3"]) > 0.98


def test_a_glimpse_between_two_cars_is_no_track() -> None:
    traffic = queue(0j, 10 + 0j, 30 + 0j)
    traffic.centers[1, 100:103] = traffic.centers[1, 200:220] = 10 + 20j
    seen = observe(traffic, 0, slice(0, 400), SENSORS["good"], np.random.default_rng(0)).seen
    assert not seen[2, :200].any()
    assert seen[2, 200:220].mean() > 0.9


def test_cars_all_round_are_seen() -> None:
    """Bearings wrap behind the observer."""
    behind = queue(0j, -20 + 0.1j, 20j, -20j)
    assert min(look(behind, SENSORS["good"]).values()) > 0.98


def test_noise_is_as_large_as_said_and_drifts() -> None:
    traffic = queue(*(20.0 * np.exp(0.3j * np.arange(21))))
    sensor = dataclasses.replace(SENSORS["poor"], least_visible=0.0)
    sightings = observe(traffic, 0, slice(0, 400), sensor, np.random.default_rng(0))
    error = sightings.centers - traffic.centers[sightings.rows]
    assert not error[0].any()
    expected = np.hypot(sensor.jitter_m, sensor.drift_m)
    np.testing.assert_allclose(error[1:].real.std(), expected, rtol=0.15)
    slow = (error[1:, 1:] * error[1:, :-1].conj()).real.mean() / 2.0
    np.testing.assert_allclose(slow, sensor.drift_m**2, rtol=0.3)
    assert 0.02 < 1.0 - sightings.seen[1:].mean() < 0.04


# Scenarios


def test_a_scenario_names_its_files_and_drops_its_outputs(town: Path, tmp_path: Path) -> None:
    scenario = read_scenario(town)
    assert scenario.name == "town"
    assert scenario.net == town.parent / "town.net.xml"
    assert dict(scenario.options).keys() == {"net-file", "route-files", "additional-files"}
    quiet = scenario.write_quiet(tmp_path).read_text()
    assert "trips.xml" not in quiet
    [copy] = tmp_path.glob("*town.add.xml")
    assert str(copy) in quiet
    assert "seen.xml" not in copy.read_text()


def test_a_scenario_called_run_is_named_by_its_folder(town: Path) -> None:
    other = town.with_name("run.sumocfg")
    other.write_text(CONFIG.replace("net-file", "n").replace("route-files", "routes"))
    assert read_scenario(other).name == town.parent.name
    other.unlink()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (None, "no such scenario"),
        ("town", "not a SUMO configuration"),
        ("<configuration/>", "0 networks"),
        ('<configuration><net-file value="gone.net.xml"/></configuration>', "gone.net.xml"),
    ],
)
def test_a_scenario_that_is_none_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, reason: str
) -> None:
    path = tmp_path / "x.sumocfg"
    if text is not None:
        path.write_text(text)
    assert main(["simulate", str(path), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert said.startswith("eqrt: ")
    assert said.count("\n") == 1
    assert reason in said
    assert not (tmp_path / "out").exists()


# The command


def test_cars_drive_on_lanes_at_the_speeds_of_a_town(recordings: list[Recording]) -> None:
    assert len(recordings) == 4
    lanes = recordings[0].lanes
    assert lanes is not None
    assert all(each.lanes is lanes for each in recordings)
    speeds = []
    for each in recordings:
        assert each.may_be_target.all()
        assert each.tracks.valid[0].all()  # the observer
        seen = each.tracks.valid
        places = each.tracks.positions[seen]
        nearest = [np.hypot(*(lanes.points - place).T).min() for place in places[::7]]
        assert max(nearest) < 4.0
        both = seen[:, 1:] & seen[:, :-1]
        step = np.diff(each.tracks.positions, axis=1)
        speed = np.hypot(step[..., 0], step[..., 1]) / 0.1
        speeds.append(speed[both])
        moving = both & (speed > 2.0)
        course = np.arctan2(step[..., 1], step[..., 0])[moving]
        slip = np.angle(np.exp(1j * (course - each.tracks.heading_rad[:, 1:][moving])))
        assert np.abs(slip).max() < 0.5
    speed = np.concatenate(speeds)
    assert 3.0 < speed.mean() < 15.0
    assert speed.max() < 25.0


def test_turns_and_brakes_are_such_as_cars_can_do(recordings: list[Recording]) -> None:
    lateral, along = [], []
    for each in recordings:
        for places, seen in zip(each.tracks.positions, each.tracks.valid, strict=True):
            path = (places[:, 0] + 1j * places[:, 1])[seen]
            if np.diff(np.flatnonzero(seen)).max(initial=1) == 1:
                lateral.append(lateral_mps2(path))
                along.append(np.diff(np.abs(np.diff(path))) / 0.01)
    assert max(map(len, lateral)) > 60
    assert np.quantile(np.concatenate(lateral), 0.99) < 4.0
    assert np.abs(np.concatenate(along)).max() < 9.0


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_processes(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    amount = ["--recordings", "13", *SMALL[2:]]  # two runs
    for jobs, name in (("1", "one"), ("2", "two")):
        out = str(tmp_path / name)
        assert main(["simulate", str(town), "--out", out, "--jobs", jobs, *amount]) == 0
    said = capsys.readouterr()
    assert "2 of 2 runs" in said.err
    assert "tracks" in said.out
    one, two = (sorted((tmp_path / name).iterdir()) for name in ("one", "two"))
    assert [path.name for path in one] == [path.name for path in two]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(one, two, strict=True))
    groups = {each.group for each in read_all(tmp_path / "one")}
    assert groups == {"town-1-0000", "town-1-0001"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]
    inputs = {"town.net.xml", "town.rou.xml", "town.add.xml", "town.sumocfg"}
    assert {path.name for path in town.parent.iterdir()} == inputs


def test_what_sumo_refuses_is_said_in_its_own_words(
    town: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    routes = '<routes><flow id="f" from="left0A0" to="nowhere" begin="0" end="9" number="3"/>'
    (tmp_path / "bad.rou.xml").write_text(f"{routes}</routes>")
    bad = CONFIG.replace("town.rou.xml", str(tmp_path / "bad.rou.xml"))
    path = tmp_path / "bad.sumocfg"
    path.write_text(bad.replace("town.", f"{town.parent}/town."))
    assert main(["simulate", str(path), "--out", str(tmp_path / "out"), *SMALL]) == 1
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("eqrt: bad: SUMO stopped: ")
    assert "nowhere" in said
    assert {item.name for item in tmp_path.iterdir()} == {"bad.rou.xml", "bad.sumocfg"}


def test_a_road_without_cars_records_nothing(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = ["simulate", str(town), "--out", str(tmp_path / "out"), "--begin", "5000", *SMALL]
    assert main(late) == 1
    assert "no car drives for 12 s on end" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_left_alone(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["simulate", str(town), "--out", str(tmp_path)]) == 2
    assert "is there already; give --out a new folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    "option",
    [
        ["--minutes", "0"],
        ["--minutes", "1e300"],
        ["--jobs", "0"],
        ["--scale", "nan"],
        ["--seconds", "soon"],
    ],
)
def test_a_wrong_option_is_a_usage_error(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str]
) -> None:
    assert main(["simulate", str(town), "--out", str(tmp_path / "out"), *option]) == 2
    assert option[0] in capsys.readouterr().err


@pytest.mark.parametrize(("license_", "sold"), [("CC-BY-4.0", True), ("CC BY-NC 4.0", False)])
def test_the_source_says_whose_it_is_and_whether_it_may_be_sold(
    town: Path, tmp_path: Path, license_: str, sold: bool
) -> None:
    out = tmp_path / "out"
    terms = ["--credit", "The town is ours.", "--license", license_]
    few = ["--recordings", "1", "--seconds", "5", "--warmup", "40", "--scale", "1.0"]
    assert main(["simulate", str(town), "--out", str(out), *terms, *few]) == 0
    source = RecordingFileReader.open(out).source
    assert source.name == "SUMO town"
    assert source.license == license_
    assert source.credits.endswith("on the scenarios: town. The town is ours.")
    assert source.non_commercial == (not sold)
    with np.load(next(out.glob("*.npz"))) as archive:
        assert json.loads(archive["texts"].tobytes())["track_ids"]
