"""Argoverse 2: official scenarios and their maps are read as they are, and broken ones refused."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from eqrt.core.errors import LogError
from eqrt.core.lanes import NO_LANE, LaneType
from eqrt.training.recordings.argoverse2 import Argoverse2Reader
from eqrt.training.recordings.argoverse_maps import read_scenario_map
from eqrt.training.recordings.recording import Part, Recording

NAME = "0a1e6f0a-1817-4a98-b02e-db8c9327d151"
TYPES = {"AV": "vehicle", "7": "bus", "8": "motorcyclist", "9": "pedestrian", "10": "cyclist"}
FOCAL = "7"
Columns = dict[str, list[Any]]


def columns(steps: int = 110) -> Columns:
    """Every track drives 0.5 m east per step, 10 m apart; the motorcyclist is seen from 60 on."""
    seen = [
        (track, step)
        for track in TYPES
        for step in range(60 if TYPES[track] == "motorcyclist" else 0, steps)
    ]
    rows = list(TYPES)
    return {
        "observed": [step < 50 for _, step in seen],
        "track_id": [track for track, _ in seen],
        "object_type": [TYPES[track] for track, _ in seen],
        "object_category": [3 if track == FOCAL else 1 for track, _ in seen],
        "timestep": [step for _, step in seen],
        "position_x": [-400.0 + 0.5 * step for _, step in seen],
        "position_y": [1300.0 + 10.0 * rows.index(track) for track, _ in seen],
        "heading": [0.001 * step for _, step in seen],
        "velocity_x": [5.0] * len(seen),
        "velocity_y": [0.0] * len(seen),
        "scenario_id": [NAME] * len(seen),
        "start_timestamp": [315968440959909000] * len(seen),
        "end_timestamp": [315968451859909000] * len(seen),
        "num_timestamps": [110] * len(seen),
        "focal_track_id": [FOCAL] * len(seen),
        "city": ["austin"] * len(seen),
    }


def line(*points: tuple[float, float]) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": 22.5} for x, y in points]


def segment(lane_id: int, *points: tuple[float, float], **changes: Any) -> dict[str, Any]:
    """A lane segment along `points`, its bounds 2 m above and below."""
    lane = {
        "centerline": line(*points),
        "id": lane_id,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": line(*((x, y + 2.0) for x, y in points)),
        "left_lane_mark_type": "NONE",
        "left_neighbor_id": None,
        "predecessors": [],
        "right_lane_boundary": line(*((x, y - 2.0) for x, y in points)),
        "right_lane_mark_type": "NONE",
        "right_neighbor_id": None,
        "successors": [],
    }
    return lane | changes


def log_map(*lanes: dict[str, Any]) -> dict[str, Any]:
    by_id = {str(lane["id"]): lane for lane in lanes}
    return {"drivable_areas": {}, "lane_segments": by_id, "pedestrian_crossings": {}}


LANES = (
    segment(11, (0, 0), (20, 0), left_neighbor_id=13, right_neighbor_id=14, successors=[12, 99]),
    segment(12, (20, 0), (30, 0)),
    segment(13, (20, 4), (0, 4), left_neighbor_id=11),
    segment(14, (0, -4), (20, -4), left_neighbor_id=11, lane_type="BUS"),
    segment(15, (20, 0), (25, 5), predecessors=[11, 14]),
    segment(16, (0, -6), (20, -6), left_neighbor_id=14, lane_type="BIKE"),
)


def write(folder: Path, table: Columns | None = None, lanes: Any = None, name: str = NAME) -> Path:
    """A scenario's folder."""
    scenario = folder / name
    scenario.mkdir(parents=True)
    pq.write_table(pa.table(table or columns()), scenario / f"scenario_{name}.parquet")
    text = json.dumps(log_map(*LANES) if lanes is None else lanes)
    (scenario / f"log_map_archive_{name}.json").write_text(text)
    return scenario


def read(folder: Path) -> Recording:
    """The one recording of one scenario."""
    (recording,) = Argoverse2Reader().read(Part(str(folder)))
    return recording


def test_a_scenario_is_read_as_it_stands(tmp_path: Path) -> None:
    recording = read(write(tmp_path))
    assert (recording.name, recording.group, recording.dt_s) == (NAME, NAME, 0.1)
    assert recording.now_steps == (49,)
    assert recording.track_ids == tuple(TYPES)
    assert recording.focal.tolist() == [False, True, False, False, False]
    assert recording.may_be_target.tolist() == [True, True, True, False, False]
    tracks = recording.tracks
    assert tracks.valid.shape == (5, 110)
    np.testing.assert_array_equal(np.flatnonzero(tracks.valid[2]), np.arange(60, 110))
    np.testing.assert_array_equal(tracks.positions[1, 100], [-350.0, 1310.0])
    np.testing.assert_allclose(tracks.heading_rad[0], 0.001 * np.arange(110))
    assert np.isnan(tracks.heading_rad[2, :60]).all()
    assert recording.lanes is not None
    assert recording.lanes.num_lanes == 5


def test_the_order_of_rows_does_not_matter(tmp_path: Path) -> None:
    backward = read(write(tmp_path, {name: rows[::-1] for name, rows in columns().items()}))
    forward = read(write(tmp_path, name="forward"))
    assert backward.track_ids == forward.track_ids[::-1]
    np.testing.assert_array_equal(backward.tracks.positions[::-1], forward.tracks.positions)
    np.testing.assert_array_equal(backward.tracks.valid[::-1], forward.tracks.valid)
    np.testing.assert_array_equal(backward.focal[::-1], forward.focal)
    np.testing.assert_array_equal(backward.may_be_target[::-1], forward.may_be_target)


def test_a_test_scenario_has_the_past_only(tmp_path: Path) -> None:
    tracks = read(write(tmp_path, columns(steps=50))).tracks
    assert tracks.valid[0, :50].all()
    assert not tracks.valid[:, 50:].any()


def test_a_heading_may_be_missing(tmp_path: Path) -> None:
    table = columns()
    table["heading"][0] = None
    tracks = read(write(tmp_path, table)).tracks
    assert tracks.valid[0, 0]
    assert np.isnan(tracks.heading_rad[0, 0])


def test_parts_are_the_scenario_folders_by_name(tmp_path: Path) -> None:
    for name in ("b", "a"):
        write(tmp_path / "train", name=name)
    (tmp_path / "train/.cache").mkdir()
    (tmp_path / "train/notes.txt").touch()
    reader = Argoverse2Reader()
    assert [Path(part.path).name for part in reader.parts(tmp_path / "train")] == ["a", "b"]
    alone = tmp_path / "train/a"
    assert reader.parts(alone) == [Part(str(alone))]
    assert reader.source.non_commercial
    assert pickle.loads(pickle.dumps(reader)) == reader


def test_a_map_is_lanes_for_vehicles_with_their_links(tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text(json.dumps(log_map(*LANES)))
    lanes = read_scenario_map(tmp_path / "map.json")
    assert lanes.lane_id.tolist() == [11, 12, 13, 14, 15]
    np.testing.assert_allclose(lanes.lane_points(0), [(2.0 * i, 0.0) for i in range(11)], atol=1e-6)
    assert lanes.successors_of(0).tolist() == [1, 4]  # its own word, and that of lane 15
    assert lanes.left.tolist() == [NO_LANE, NO_LANE, NO_LANE, 0, NO_LANE]  # oncoming is no left
    assert lanes.right.tolist() == [3, NO_LANE, NO_LANE, NO_LANE, NO_LANE]
    assert lanes.lane_type[3] == LaneType.BUS


def test_without_a_centerline_the_middle_of_the_bounds_is_taken(tmp_path: Path) -> None:
    """As in the maps of Argoverse 2's sensor dataset."""
    bare = segment(1, (0, 0), (6, 0), right_lane_boundary=line((0, -4), (6, -4)))
    del bare["centerline"]
    (tmp_path / "map.json").write_text(json.dumps(log_map(bare)))
    points = read_scenario_map(tmp_path / "map.json").lane_points(0)
    np.testing.assert_allclose(points, [(2.0 * i, -1.0) for i in range(4)], atol=1e-6)


def changed(column: str, row: int, value: Any) -> Columns:
    table = columns()
    table[column][row] = value
    return table


def without(*names: str) -> Columns:
    return {name: rows for name, rows in columns().items() if name not in names}


BROKEN = {
    "columns": (without("heading", "track_id"), "no column track_id, heading"),
    "rows": ({name: rows[:0] for name, rows in columns().items()}, "cannot be read|no rows"),
    "words": (columns() | {"position_x": ["far"] * len(columns()["city"])}, "cannot be read"),
    "NaN": (changed("position_x", 3, np.nan), "track AV, step 3: the position is not a number"),
    "missing": (changed("position_y", 3, None), "track AV, step 3: the position is not a number"),
    "infinite": (changed("position_y", 3, np.inf), "track AV, step 3: the position is not"),
    "late step": (changed("timestep", 109, 110), "timestep 110, expected 0 to 109"),
    "early step": (changed("timestep", 0, -1), "timestep -1, expected 0 to 109"),
    "no step": (changed("timestep", 0, None), "timestep nan"),
    "no track": (changed("track_id", 5, None), "track_id is empty"),
    "seen twice": (changed("timestep", 1, 0), "seen twice in one step"),
    "no focal track": (
        columns() | {"focal_track_id": ["77"] * len(columns()["city"])},
        "the focal track 77 is not in the file",
    ),
}


@pytest.mark.parametrize("what", BROKEN)
def test_broken_tracks_are_refused_by_name_and_reason(tmp_path: Path, what: str) -> None:
    table, reason = BROKEN[what]
    with pytest.raises(LogError, match=rf"scenario_{NAME}\.parquet: .*({reason})"):
        read(write(tmp_path, table))


def test_truncated_parquet_is_refused(tmp_path: Path) -> None:
    folder = write(tmp_path)
    path = folder / f"scenario_{NAME}.parquet"
    whole = path.read_bytes()
    for size in (0, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(LogError, match=r"scenario_.*\.parquet: cannot be read"):
            read(folder)


BROKEN_MAPS = {
    "another form": ([], "Expected `object`, got `array`"),
    "another file": ({"drivable_areas": {}}, "missing required field `lane_segments`"),
    "no lanes": (log_map(), "no lanes for vehicles"),
    "bicycle lanes only": (log_map(LANES[-1]), "no lanes for vehicles"),
    "no id": ({"lane_segments": {"1": {"lane_type": "BUS"}}}, "missing required field `id`"),
    "link": (log_map(segment(1, (0, 0), (9, 0), successors=["next"])), "Expected `int`, got `str`"),
    "links": (log_map(segment(1, (0, 0), (9, 0), successors=None)), "Expected `array`, got `null`"),
    "NaN": (log_map(segment(1, (0, 0), (np.nan, 0))), "JSON is malformed"),
    "point": (log_map(segment(1, centerline=[{"x": 1.0}])), "missing required field `y`"),
    "far away": (log_map(segment(1, (0, 0), (5e6, 0))), "lane 1 lies more than"),
    "farther": (log_map(segment(1, (0, 0), (1e30, 0))), "lane 1 lies more than"),
}


@pytest.mark.parametrize("what", BROKEN_MAPS)
def test_a_broken_map_is_refused_by_name_and_reason(tmp_path: Path, what: str) -> None:
    lanes, reason = BROKEN_MAPS[what]
    with pytest.raises(LogError, match=rf"log_map_archive_{NAME}\.json: .*{reason}"):
        read(write(tmp_path, lanes=lanes))


def test_a_map_that_is_cut_or_gone_is_refused(tmp_path: Path) -> None:
    folder = write(tmp_path)
    path = folder / f"log_map_archive_{NAME}.json"
    path.write_text(path.read_text()[:-20])
    with pytest.raises(LogError, match=r"log_map_archive_.*: Input data was truncated"):
        read(folder)
    path.unlink()
    with pytest.raises(LogError, match=r"log_map_archive_.*: cannot be read"):
        read(folder)


def test_folders_without_scenarios_are_refused(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    with pytest.raises(LogError, match="no folders with scenario_"):
        Argoverse2Reader().parts(tmp_path)
    with pytest.raises(LogError, match="nowhere: cannot be read"):
        Argoverse2Reader().parts(tmp_path / "nowhere")
    with pytest.raises(LogError, match="train: 0 files scenario_"):
        read(tmp_path / "train")
