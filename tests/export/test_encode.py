"""A scenario as a CAN log: the model must see the same scene either way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eqrt.cli import main
from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.core.routes import RouteFinder
from eqrt.core.scene import Scene, build_scene, concatenate
from eqrt.core.tile import TileInfo, decode, encode
from eqrt.export.encode import (
    MAX_RANGE_M,
    ObjectIds,
    choose_ego,
    drive_messages,
    joined,
    moved,
    write_candump,
)
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Prediction, Predictor
from eqrt.runtime.prediction.tiles import Tile
from eqrt.runtime.prediction.watched import Model
from eqrt.runtime.replay import replay
from eqrt.training.recordings.commonroad import Scenario, lane_map, read_scenario
from eqrt.training.recordings.commonroad_recordings import track_grid
from eqrt.training.recordings.recording import TrackGrid
from processes import files_of_at_most

NGSIM = Path(__file__).parent.parent / "data" / "ngsim"
RANGE_M = 80.0
RESOLUTION_M = 0.01  # of a position in the object list
YAW_M = 1e-4 * RANGE_M  # of the ego's heading, at the end of the range


class Listening:
    """The real predictor; remembers the scenes that it was given last."""

    def __init__(self, predictor: Predictor) -> None:
        self.contract: ModelContract = predictor.contract
        self.model_id = predictor.model_id
        self.scenes: list[Scene] = []
        self._predictor = predictor

    def predict(self, scene: Scene) -> Prediction:
        self.scenes.append(scene)
        return self._predictor.predict(scene)

    def again(self) -> Model:
        return self


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return read_scenario(NGSIM / "USA_Lanker-1_2_T-1.xml.gz")


@pytest.fixture(scope="module")
def scenes_from_can(scenario: Scenario) -> list[Scene]:
    lanes = lane_map(scenario)
    _, info = decode(encode(lanes, TileInfo(name="t", source="t", credit="")), "t")
    predictor = Listening(Predictor.load(DEFAULT_ARTIFACT))
    pipeline = Pipeline(load_profile("generic"), predictor, Tile(lanes, info, Path("encoded.tile")))
    scenes, cycles = [], 0
    for forecast in replay(pipeline, drive_messages([scenario], RANGE_M)):
        cycles += 1
        assert forecast.num_targets or cycles == 1
        if predictor.scenes:  # one per batch
            scenes.append(concatenate(predictor.scenes))
            predictor.scenes.clear()
    assert cycles == len(choose_ego(scenario).step)
    return scenes


def scene_directly(scenario: Scenario, step: int, contract: ModelContract, origin: np.ndarray):  # type: ignore[no-untyped-def]
    """What the ego could have seen, straight from the recording."""
    grid = track_grid(scenario, "test")
    ego = scenario.tracks.index(choose_ego(scenario))
    distance = np.linalg.norm(grid.positions - grid.positions[ego], axis=-1)
    visible = grid.valid & (distance <= RANGE_M) & grid.valid[ego]
    agents = TrackGrid(grid.positions, grid.heading_rad, visible).histories(
        step, contract.history_steps
    )
    agents.heading[ego] = 0.0  # the service does not predict the ego, and gives it no heading
    targets = np.flatnonzero(visible[:, step] & (np.arange(len(visible)) != ego))
    return build_scene(agents, targets, contract, RouteFinder(lane_map(scenario)), origin)


def test_a_scene_is_the_same_from_the_recording_and_over_can(
    scenario: Scenario, scenes_from_can: list[Scene]
) -> None:
    """Every step, every target, every array, within what the object list's DBC resolves."""
    contract = Predictor.load(DEFAULT_ARTIFACT).contract
    first = int(choose_ego(scenario).step[-1]) + 1 - len(scenes_from_can)
    compared = same_agents = same_lanes = 0
    for index, over_can in enumerate(scenes_from_can):
        direct = scene_directly(scenario, first + index, contract, over_can.origin)
        rows = matched(direct, over_can)
        history, valid, found = in_the_order_of(direct, over_can, rows)
        np.testing.assert_array_equal(valid[found], direct.history_valid[found])
        np.testing.assert_allclose(history[found], direct.history[found], atol=RESOLUTION_M + YAW_M)
        np.testing.assert_allclose(over_can.heading[rows], direct.heading, atol=0.003)
        on_lane = direct.centerlines_valid & over_can.centerlines_valid[rows]
        apart = np.linalg.norm(over_can.centerlines[rows] - direct.centerlines, axis=-1)
        same = (np.where(on_lane, apart, 0.0) < 0.1).all(axis=(1, 2))
        same &= (direct.centerlines_valid == over_can.centerlines_valid[rows]).mean((1, 2)) > 0.98
        compared += len(rows)
        same_agents += int(found.sum())
        same_lanes += int(same.sum())
    assert compared > 500
    assert same_agents / compared > 0.99  # a centimetre may decide which of two is the nearer,
    assert same_lanes / compared > 0.97  # be it the last neighbour or the last lane


def matched(direct: Scene, over_can: Scene) -> np.ndarray:
    """For every target of `direct`, its row in `over_can`: the one at the same place.

    Over CAN there may be more: a car that has just left is predicted from where it was last seen.
    """
    here = direct.history[:, None, 0, -1] - over_can.history[None, :, 0, -1]
    distance = np.linalg.norm(here, axis=-1)
    assert distance.min(axis=1).max() < 0.05
    rows = np.asarray(distance.argmin(axis=1))
    assert len(set(rows.tolist())) == len(rows)
    return rows


def in_the_order_of(
    direct: Scene, over_can: Scene, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Histories and masks over CAN with neighbours as in `direct`; where they are the same ones.

    Neighbours are told apart by the sum of where they were; the target stays first.
    """
    history, valid = over_can.history[rows], over_can.history_valid[rows]
    apart = direct.history.sum(2)[:, :, None] - history.sum(2)[:, None]  # (B, N, N, 2)
    order = np.linalg.norm(apart, axis=-1).argmin(axis=2)
    np.testing.assert_array_equal(order[:, 0], 0)
    empty = ~direct.history_valid.any(axis=2)  # rows without an agent are all alike
    order[empty] = np.broadcast_to(np.arange(order.shape[1]), order.shape)[empty]
    found = (np.sort(order, axis=1) == np.arange(order.shape[1])).all(axis=1)
    each = np.arange(len(rows))[:, None]
    return history[each, order], valid[each, order], found


def test_object_ids_are_reused_late_and_flagged_as_new() -> None:
    ids = ObjectIds()
    assert ids.assign([70, 80]) == ([0, 1], [True, True])
    assert ids.assign([80, 90]) == ([1, 2], [False, True])
    assert ids.assign([70]) == ([3], [True])


def test_scenarios_of_one_drive_lie_apart_and_keep_their_lanes(scenario: Scenario) -> None:
    lanes = lane_map(scenario)
    both = joined([lanes, lane_map(moved(scenario, 3000.0))])
    count = lanes.num_lanes
    assert both.num_lanes == 2 * count
    for lane in range(count):
        shifted = both.lane_points(lane) + np.array([3000.0, 0.0], np.float32)
        np.testing.assert_allclose(both.lane_points(lane + count), shifted, atol=2e-3)
        np.testing.assert_array_equal(
            both.successors_of(lane + count), both.successors_of(lane) + count
        )
    decode(encode(both, TileInfo(name="t", source="t", credit="")), "both")


def test_a_moved_scenario_is_the_same_relative_to_itself(scenario: Scenario) -> None:
    far = moved(scenario, 3000.0)
    track, same = scenario.tracks[0], far.tracks[0]
    np.testing.assert_allclose(same.position - [3000.0, 0.0], track.position)
    assert replace(same, position=track.position) == track


def test_the_same_drive_gives_the_same_bytes(scenario: Scenario, tmp_path: Path) -> None:
    for name in ("one.log.gz", "two.log.gz"):
        write_candump(tmp_path / name, list(drive_messages([scenario], RANGE_M)))
    assert (tmp_path / "one.log.gz").read_bytes() == (tmp_path / "two.log.gz").read_bytes()


@pytest.mark.parametrize("range_m", ["0", "-3", "nan", "inf", "328"])
def test_a_range_that_the_object_list_cannot_say_is_refused(
    range_m: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, tile = tmp_path / "drive.log", tmp_path / "drive.tile"
    files = [str(NGSIM / "USA_Lanker-1_2_T-1.xml.gz"), "--out", str(out), "--tile", str(tile)]
    assert main(["encode", *files, "--range", range_m]) == 2
    assert "--range is " in capsys.readouterr().err
    assert not out.exists()


def test_a_log_that_cannot_be_written_is_not_begun(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, tile = tmp_path / "drive.log", tmp_path / "drive.tile"
    files = [str(NGSIM / "USA_Lanker-1_2_T-1.xml.gz"), "--out", str(out), "--tile", str(tile)]
    with files_of_at_most(1 << 12):
        assert main(["encode", *files]) == 1
    assert capsys.readouterr().err.startswith(f"eqrt: cannot write {out} (")
    assert list(tmp_path.iterdir()) == []


def test_one_file_for_log_and_tile_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "drive.log")
    files = [str(NGSIM / "USA_Lanker-1_2_T-1.xml.gz"), "--out", out, "--tile", out]
    assert main(["encode", *files]) == 2
    assert "give the tile a name of its own" in capsys.readouterr().err


def test_more_objects_than_the_list_takes_are_refused(scenario: Scenario) -> None:
    tracks = scenario.tracks * (256 // len(scenario.tracks) + 2)
    crowd = replace(
        scenario,
        tracks=tuple(replace(track, track_id=i) for i, track in enumerate(tracks)),
    )
    with pytest.raises(EqrtError, match=r"within 327 m of the ego, .* takes 255; give a smaller"):
        list(drive_messages([crowd], MAX_RANGE_M))
