"""Argoverse 1: official sequences and city maps are read as they are, and broken ones refused."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from eqrt.core.errors import LogError
from eqrt.core.lanes import NO_LANE
from eqrt.training.recordings.argoverse1 import Argoverse1Reader
from eqrt.training.recordings.argoverse_maps import read_city_map
from eqrt.training.recordings.recording import Part, Recording

HEADER = "TIMESTAMP,TRACK_ID,OBJECT_TYPE,X,Y,CITY_NAME"
FIRST_STAMP_S = 315971499.0250085
MAP_NAMES = {
    "MIA": "pruned_argoverse_MIA_10316_vector_map.xml",
    "PIT": "pruned_argoverse_PIT_10314_vector_map.xml",
}
EASTWARD = [(0.0, 0.0), (5.0, 0.0), (20.0, 0.0)]
LANES = [  # id, points, tags
    (9601, EASTWARD, {"successor": [9602], "l_neighbor_id": [9603], "r_neighbor_id": [9604]}),
    (9602, [(20.0, 0.0), (30.0, 0.0)], {}),
    (9603, [(20.0, 4.0), (0.0, 4.0)], {"l_neighbor_id": [9601]}),
    (9604, [(0.0, -4.0), (20.0, -4.0)], {"l_neighbor_id": [9601], "successor": [9699]}),
    (9605, [(20.0, 0.0), (25.0, 5.0)], {"predecessor": [9601, 9604]}),
]

Lanes = Iterable[tuple[int, Sequence[tuple[float, float]], dict[str, list[int]]]]


def stamps(count: int = 50, spacing_s: float = 0.1) -> list[float]:
    """Time stamps that jitter as the sensors' do."""
    jitter = np.random.default_rng(7).uniform(-0.02, 0.02, count)
    return [float(t) for t in FIRST_STAMP_S + np.arange(count) * spacing_s + jitter]


def sequence(times: Sequence[float], city: str = "PIT", agent_x: str = "") -> str:
    """The recording car, the target and two others, the first of which is seen late."""
    lines = [HEADER]
    for step, time in enumerate(times):
        lines += [
            f"{time!r},000-0,AV,{1000 + step}.25,2000.5,{city}",
            f"{time!r},000-7,AGENT,{agent_x or 1010 + 2 * step},2004.0,{city}",
        ]
        if step >= 10:
            lines.append(f"{time!r},000-3,OTHERS,1020.0,{2000 - step}.0,{city}")
        if step < 5:
            lines.append(f"{time!r},000-9,OTHERS,1030.0,2000.0,{city}")
    return "\n".join(lines) + "\n"


def city_map(lanes: Lanes = LANES) -> str:
    """A map in the official form, nodes first."""
    nodes: list[str] = []
    ways: list[str] = []
    for lane_id, points, tags in lanes:
        ways.append(f'<way lane_id="{lane_id}"><tag k="is_intersection" v="False" />')
        for key in ("l_neighbor_id", "r_neighbor_id"):
            ways.append(f'<tag k="{key}" v="{tags.get(key, ["None"])[0]}" />')
        for x, y in points:
            ways.append(f'<nd ref="{len(nodes)}" />')
            nodes.append(f'<node id="{len(nodes)}" x="{x}" y="{y}" />')
        for key in ("predecessor", "successor"):
            ways += [f'<tag k="{key}" v="{other}" />' for other in tags.get(key, [])]
        ways.append("</way>")
    body = "\n".join(["<ArgoverseVectorMap>", *nodes, *ways, "</ArgoverseVectorMap>"])
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{body}"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """The folder of a split, as the official archive unpacks."""
    folder = tmp_path / "forecasting_train_v1.1/train/data"
    folder.mkdir(parents=True)
    return folder


def write_maps(folder: Path, cities: Iterable[str] = MAP_NAMES, text: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for city in cities:
        (folder / MAP_NAMES[city]).write_text(text or city_map())
    return folder


def read(path: Path, maps: Path | None = None) -> Recording:
    """The one recording of one file."""
    (recording,) = Argoverse1Reader(maps).read(Part(str(path)))
    return recording


def test_a_sequence_is_read_as_it_stands(data: Path) -> None:
    (data / "4711.csv").write_text(sequence(stamps()))
    recording = read(data / "4711.csv")
    assert (recording.name, recording.group, recording.dt_s) == ("4711", "4711", 0.1)
    assert recording.now_steps == (19,)
    assert recording.lanes is None
    assert recording.track_ids == ("000-7", "000-0", "000-9", "000-3")  # target, car, others
    np.testing.assert_array_equal(recording.focal, [True, False, False, False])
    assert recording.may_be_target.all()
    tracks = recording.tracks
    assert tracks.valid.shape == (4, 50)
    assert tracks.valid[:2].all()
    np.testing.assert_array_equal(np.flatnonzero(tracks.valid[2]), np.arange(5))
    np.testing.assert_array_equal(np.flatnonzero(tracks.valid[3]), np.arange(10, 50))
    np.testing.assert_array_equal(tracks.positions[0, 49], [1108.0, 2004.0])
    np.testing.assert_array_equal(tracks.positions[1, 3], [1003.25, 2000.5])
    assert np.isnan(tracks.heading_rad).all()


def test_steps_are_ranks_of_time_whatever_the_order_of_rows(data: Path) -> None:
    header, *rows = sequence(stamps()).splitlines()
    (data / "1.csv").write_text("\n".join([header, *rows]))
    (data / "2.csv").write_text("\r\n".join([header, *reversed(rows)]))
    forward, backward = read(data / "1.csv"), read(data / "2.csv")
    rows_of = [backward.track_ids.index(track) for track in forward.track_ids]
    np.testing.assert_array_equal(backward.tracks.valid[rows_of], forward.tracks.valid)
    np.testing.assert_array_equal(backward.tracks.positions[rows_of], forward.tracks.positions)


def test_columns_may_come_in_any_order(data: Path) -> None:
    rows = [line.split(",") for line in sequence(stamps()).splitlines()]
    (data / "1.csv").write_text("\n".join(",".join(reversed(row)) for row in rows))
    np.testing.assert_array_equal(read(data / "1.csv").tracks.positions[0, 0], [1010.0, 2004.0])


def test_a_test_sequence_has_the_past_only(data: Path) -> None:
    (data / "1.csv").write_text(sequence(stamps(20)))
    assert read(data / "1.csv").tracks.num_steps == 20


def test_a_slowly_sampled_sequence_counts_steps_as_the_benchmark_does(data: Path) -> None:
    (data / "1.csv").write_text(sequence(stamps(spacing_s=0.27)))
    recording = read(data / "1.csv")
    assert (recording.dt_s, recording.tracks.num_steps) == (0.1, 50)


def test_parts_are_the_files_by_name(data: Path) -> None:
    for name in ("10.csv", "2.csv", "._2.csv", "notes.txt"):
        (data / name).write_text(sequence(stamps()))
    reader = Argoverse1Reader()
    assert [Path(part.path).name for part in reader.parts(data)] == ["10.csv", "2.csv"]
    assert [part.path for part in reader.parts(data / "2.csv")] == [str(data / "2.csv")]
    assert reader.source.non_commercial
    assert pickle.loads(pickle.dumps(reader)) == reader


def test_one_map_serves_every_recording_of_its_city(data: Path, tmp_path: Path) -> None:
    maps = write_maps(tmp_path / "elsewhere")
    for name, city in (("1", "PIT"), ("2", "PIT"), ("3", "MIA")):
        (data / f"{name}.csv").write_text(sequence(stamps(), city))
    one, two, three = (read(data / f"{name}.csv", maps).lanes for name in (1, 2, 3))
    assert one is not None
    assert one is two
    assert three is not None
    assert three is not one


@pytest.mark.parametrize(
    "place", [".", "map_files", "../../map_files", "../../../hd_maps/map_files"]
)
def test_maps_near_the_data_are_found(data: Path, place: str) -> None:
    write_maps(data / place)
    (data / "1.csv").write_text(sequence(stamps()))
    assert read(data / "1.csv").lanes is not None


def test_a_map_is_lanes_in_driving_direction_with_their_links(tmp_path: Path) -> None:
    (tmp_path / "map.xml").write_text(city_map())
    lanes = read_city_map(tmp_path / "map.xml")
    assert lanes.lane_id.tolist() == [9601, 9602, 9603, 9604, 9605]
    first = lanes.lane_points(0)
    np.testing.assert_allclose(first, [(2.0 * i, 0.0) for i in range(11)], atol=1e-6)
    assert lanes.successors_of(0).tolist() == [1, 4]  # its own word, and that of lane 9605
    assert lanes.successors_of(3).tolist() == [4]  # lane 9699 is not in the map
    assert lanes.left.tolist() == [NO_LANE, NO_LANE, NO_LANE, 0, NO_LANE]  # oncoming is no left
    assert lanes.right.tolist() == [3, NO_LANE, NO_LANE, NO_LANE, NO_LANE]


def test_neighbours_in_a_bend_run_the_same_way(tmp_path: Path) -> None:
    """Half a turn: the lanes' ends point apart, but both lead from one side to the other."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    inner, outer = [[(x, y) for x, y in (radius_m * arc).tolist()] for radius_m in (10.0, 14.0)]
    bend: Lanes = [
        (1, inner, {"r_neighbor_id": [2]}),
        (2, outer, {"l_neighbor_id": [1], "r_neighbor_id": [3]}),
        (3, [(1.3 * x, 1.3 * y) for x, y in reversed(outer)], {"l_neighbor_id": [2]}),
    ]
    (tmp_path / "map.xml").write_text(city_map(bend))
    lanes = read_city_map(tmp_path / "map.xml")
    assert (lanes.left.tolist(), lanes.right.tolist()) == ([-1, 0, -1], [1, -1, -1])


def test_a_lane_without_length_is_left_out(tmp_path: Path) -> None:
    dots: Lanes = [*LANES, (1, [(3.0, 3.0)], {}), (2, [(3.0, 3.0), (3.0, 3.0)], {}), (3, [], {})]
    (tmp_path / "map.xml").write_text(city_map(dots))
    assert read_city_map(tmp_path / "map.xml").num_lanes == len(LANES)


GOOD = sequence(stamps())
BROKEN = {
    "header": ("", "no column TIMESTAMP, TRACK_ID"),
    "rows": (HEADER, "no rows"),
    "column": (GOOD.replace("CITY_NAME", "TOWN"), "no column CITY_NAME"),
    "cut in a row": (GOOD[:-9], r"line \d+ has 5 fields, expected 6"),
    "cut in time": ("\n".join(GOOD.splitlines()[:100]), r"\d+ time stamps, expected 50 or 20"),
    "number": (sequence(stamps(), agent_x="here"), "X: could not convert"),
    "NaN": (sequence(stamps(), agent_x="nan"), "line 3: X is nan, expected a number"),
    "infinite": (GOOD.replace("2004.0", "inf", 1), "line 3: Y is inf"),
    "city": (sequence(stamps(), "LON"), "the city is LON, expected MIA or PIT"),
    "two cities": (GOOD.replace(",PIT", ",MIA", 1), "the city is MIA, PIT"),
    "no target": (GOOD.replace("AGENT", "OTHERS"), "0 tracks of type AGENT"),
    "two targets": (GOOD.replace("OTHERS", "AGENT"), "3 tracks of type AGENT"),
    "seen twice": (GOOD.replace("000-9", "000-7"), "seen twice"),
    "milliseconds": (sequence(stamps(spacing_s=100.0)), "100 s apart, expected about 0.1 s"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_sequence_is_refused_by_name_and_reason(data: Path, what: str) -> None:
    text, reason = BROKEN[what]
    (data / "13.csv").write_text(text)
    with pytest.raises(LogError, match=rf"13\.csv: .*{reason}"):
        read(data / "13.csv")


def test_what_is_not_text_is_refused(data: Path) -> None:
    (data / "13.csv").write_bytes(b"\x93NUMPY\xff\xfe")
    with pytest.raises(LogError, match=r"13\.csv: cannot be read"):
        read(data / "13.csv")
    with pytest.raises(LogError, match=r"14\.csv: cannot be read"):
        read(data / "14.csv")


def test_reading_goes_on_after_a_bad_file(data: Path) -> None:
    for name in (1, 2, 3):
        (data / f"{name}.csv").write_text(HEADER if name == 2 else sequence(stamps()))
    reader, read_names, refused = Argoverse1Reader(), [], []
    for part in reader.parts(data):
        try:
            read_names += [recording.name for recording in reader.read(part)]
        except LogError as error:
            refused.append(str(error))
    assert read_names == ["1", "3"]
    assert len(refused) == 1


def test_a_folder_without_sequences_is_refused(data: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"no \*\.csv here"):
        Argoverse1Reader().parts(data)
    with pytest.raises(LogError, match="nowhere: cannot be read"):
        Argoverse1Reader().parts(tmp_path / "nowhere")


def test_maps_that_are_asked_for_must_be_there(data: Path, tmp_path: Path) -> None:
    (data / "1.csv").write_text(sequence(stamps(), "MIA"))
    with pytest.raises(LogError, match="train: no pruned_argoverse_"):
        Argoverse1Reader(data.parent).parts(data)
    pittsburgh = write_maps(tmp_path / "half", ["PIT"])
    with pytest.raises(LogError, match="half: no pruned_argoverse_MIA_"):
        read(data / "1.csv", pittsburgh)


MAP = city_map()
BROKEN_MAPS = {
    "cut": (MAP[:-40], "not XML"),
    "empty": (" ", "not XML"),
    "encoding": ("<?xml version='1.0' encoding='klingon'?>" + MAP, "not XML .unknown encoding"),
    "another format": ("<commonRoad><lanelet id='1' /></commonRoad>", "no lanes for vehicles"),
    "plain OpenStreetMap": ("<osm><way id='1'><nd ref='1'/></way></osm>", "lane_id of a way"),
    "node": (MAP.replace('<node id="0"', '<node id="99"'), "lane 9601: node 0 is missing"),
    "coordinate": (MAP.replace('x="5.0"', 'x="east"'), "node 1: expected numbers, found 'east'"),
    "NaN": (MAP.replace('x="5.0"', 'x="nan"'), "node 1: expected numbers, found 'nan'"),
    "link": (MAP.replace('v="9602"', 'v="next"'), "lane 9601: successor: expected a whole number"),
    "far away": (MAP.replace('x="5.0"', 'x="1e300"'), "lane 9601 lies more than"),
}


@pytest.mark.parametrize("what", BROKEN_MAPS)
def test_a_broken_map_is_refused_by_name_and_reason(tmp_path: Path, what: str) -> None:
    text, reason = BROKEN_MAPS[what]
    (tmp_path / "map.xml").write_text(text)
    with pytest.raises(LogError, match=rf"map\.xml: .*{reason}"):
        read_city_map(tmp_path / "map.xml")


def test_every_recording_on_a_broken_map_says_so(data: Path, tmp_path: Path) -> None:
    maps = write_maps(tmp_path / "broken", text="<osm />")
    (data / "1.csv").write_text(sequence(stamps()))
    for _ in range(2):
        with pytest.raises(LogError, match=r"10314_vector_map\.xml: no lanes"):
            read(data / "1.csv", maps)


@pytest.mark.parametrize(
    ("folder", "group"),
    [
        ("train/data", "7"),
        ("val/data", "val/7"),
        ("test_obs/data", "test_obs/7"),
        ("val", "val/7"),
        ("mine", "7"),
    ],
)
def test_numbers_of_other_splits_are_other_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, group: str
) -> None:
    """Each split counts its sequences anew."""
    data = tmp_path / folder
    data.mkdir(parents=True)
    (data / "7.csv").write_text(sequence(stamps()))
    monkeypatch.chdir(data)
    for path in (data / "7.csv", Path("7.csv")):
        recording = read(path)
        assert (recording.name, recording.group) == ("7", group)
