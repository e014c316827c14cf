"""Recordings from CAN logs: the past is what the service predicts from, the future what it sees."""

from __future__ import annotations

import gzip
import pickle
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import can
import numpy as np
import pytest

from drives import DRIVES, Car, Drive, cycle, first_seconds, object_list, shipped_predictor
from eqrt.core.contract import ModelContract
from eqrt.core.errors import LogError
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene, concatenate
from eqrt.core.tile import TileInfo, encode
from eqrt.export.can_recordings import EGO_ID, RECORDERS_OWN, CanLogReader
from eqrt.export.encode import choose_ego, drive_messages, write_candump
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import Prediction, Predictor
from eqrt.runtime.prediction.tiles import load_tile, save_tile
from eqrt.runtime.replay import replay
from eqrt.training.dataset.windows import (
    MIN_FUTURE_STEPS,
    MIN_HISTORY_STEPS,
    WindowCutter,
    WindowOptions,
)
from eqrt.training.recordings.commonroad import Scenario, lane_map, read_scenario
from eqrt.training.recordings.recording import Recording

SCENARIO = Path(__file__).parents[1] / "data/ngsim/USA_Lanker-1_2_T-1.xml.gz"
SECONDS = 8.0
FLOAT32_M = 5e-5  # of a place some hundred metres from a tile's origin: twice half a step
RANGE_M = 80.0
DBC_M = 0.01 + 1e-4 * RANGE_M  # resolution of a position, and of the ego's yaw at the range's end


def contract() -> ModelContract:
    return shipped_predictor().contract


def reader(**options: object) -> CanLogReader:
    return CanLogReader(contract=contract(), **options)  # type: ignore[arg-type]


def read(reader_: CanLogReader, path: Path) -> list[Recording]:
    return [recording for part in reader_.parts(path) for recording in reader_.read(part)]


def now() -> int:
    """The step at which targets were measured."""
    return contract().history_steps - 1


def past() -> slice:
    return slice(0, now() + 1)


def future() -> slice:
    return slice(now() + 1, None)


def cycle_of(recording: Recording) -> int:
    """Of the service, as its JSON lines count them."""
    return int(recording.name.rpartition("#")[2].partition(".")[0])


class Listening:
    """The real predictor; remembers the scenes it was given."""

    def __init__(self, predictor: Predictor) -> None:
        self.contract = predictor.contract
        self.model_id = predictor.model_id
        self.scenes: list[Scene] = []
        self._predictor = predictor

    def predict(self, scene: Scene) -> Prediction:
        self.scenes.append(scene)
        return self._predictor.predict(scene)


def served(drive: Drive, text: str) -> dict[int, tuple[ForecastSet, Scene]]:
    """What the service predicted, and the model's input, by cycle."""
    listening = Listening(shipped_predictor())
    pipeline = Pipeline(
        load_profile(drive.profile),
        listening,  # type: ignore[arg-type]  # listens, else the same
        load_tile(drive.tile) if drive.tile else None,
    )
    found = {}
    for forecast in replay(pipeline, [candump_message(line) for line in text.splitlines()]):
        if listening.scenes:  # one per batch
            found[forecast.cycle] = forecast, concatenate(listening.scenes)
            listening.scenes.clear()
    return found


@cache
def log_text(name: str) -> str:
    return first_seconds(DRIVES[name].log, SECONDS)


@cache
def recorded(name: str, *, stride: int = 5, channels: tuple[str, ...] = ()) -> list[Recording]:
    """A drive's first seconds."""
    drive = DRIVES[name]
    options = {"profile": drive.profile, "tile": drive.tile, "channels": channels}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.log"
        log.write_text(log_text(name))
        return read(reader(stride=stride, **options), log)


@pytest.mark.parametrize("name", DRIVES)
def test_windows_are_the_scenes_that_the_service_built(name: str) -> None:
    """Masks and headings to the bit, places within float32: only the tile's origin differs.

    And every target of the service is there, except those too new or not seen long enough after.
    """
    service = served(DRIVES[name], log_text(name))
    cutter = WindowCutter(contract(), WindowOptions(targets="all"))
    compared = targets = 0
    known_pasts: list[bool] = []
    for recording in recorded(name):
        forecast, scene = service[cycle_of(recording)]
        windows = cutter.cut(recording, 0)
        track = [int(recording.track_ids[agent].split("/")[2]) for agent in windows.agent]
        rows = [int(np.flatnonzero(forecast.track_id == one)[0]) for one in track]
        np.testing.assert_array_equal(windows.history_valid, scene.history_valid[rows])
        np.testing.assert_array_equal(windows.heading, scene.heading[rows])
        np.testing.assert_array_equal(windows.centerlines_valid, scene.centerlines_valid[rows])
        for found, expected, valid in (
            (windows.history, scene.history, windows.history_valid),
            (windows.centerlines, scene.centerlines, windows.centerlines_valid),
        ):
            place = found + windows.origin[:, None, None]
            away = np.abs(place - (expected[rows] + scene.origin))[valid]
            assert away.max(initial=0.0) < FLOAT32_M
        compared += len(windows)
        known_pasts += [bool(seen.all()) for seen in windows.history_valid[:, 0]]
        grid, may = recording.tracks, recording.may_be_target
        long_enough = (grid.valid[:, past()].sum(axis=1) >= MIN_HISTORY_STEPS) & (
            grid.valid[:, future()].sum(axis=1) >= MIN_FUTURE_STEPS
        )
        targets += int((may & long_enough).sum())
    assert compared == targets > 30
    assert any(known_pasts)
    assert not all(known_pasts)


def test_every_prediction_is_recorded_once_with_its_targets() -> None:
    """Stride 1: each target of each prediction that is seen again is a target of one recording."""
    service = served(DRIVES["ars408"], log_text("ars408"))
    recordings = recorded("ars408", stride=1)
    assert len({recording.name for recording in recordings}) == len(recordings)
    by_cycle: dict[int, list[int]] = {}
    for recording in recordings:
        targets = np.flatnonzero(recording.may_be_target)
        tracks = [int(recording.track_ids[agent].split("/")[2]) for agent in targets]
        by_cycle.setdefault(cycle_of(recording), []).extend(tracks)
    for number, (forecast, _) in service.items():
        tracks = by_cycle.get(number, [])
        assert len(set(tracks)) == len(tracks)
        assert set(tracks) <= set(forecast.track_id.tolist())
    assert sum(map(len, by_cycle.values())) > 0.9 * sum(f.num_targets for f, _ in service.values())
    fifth = {r.name for r in recordings if cycle_of(r) % 5 == 0}
    assert {r.name for r in recorded("ars408")} == fifth


def test_what_comes_later_changes_nothing_of_the_past(tmp_path: Path) -> None:
    """A log that ends half a second after now gives the same history, to the bit."""
    whole = {r.name: r for r in recorded("rav4", stride=1)}
    lines = log_text("rav4").splitlines(keepends=True)
    (tmp_path / "drive.log").write_text("".join(lines[: len(lines) // 2]))
    half = read(reader(profile="toyota-rav4", stride=1), tmp_path / "drive.log")
    assert 30 < len(half) < len(whole)
    for recording in half:
        same = whole[recording.name]
        assert recording.track_ids == same.track_ids
        np.testing.assert_array_equal(recording.may_be_target, same.may_be_target)
        steps = past()
        np.testing.assert_array_equal(recording.tracks.valid[:, steps], same.tracks.valid[:, steps])
        np.testing.assert_array_equal(
            recording.tracks.positions[:, steps], same.tracks.positions[:, steps]
        )


def write_log(path: Path, messages: Sequence[can.Message]) -> Path:
    for message in messages:
        message.channel = "can0"
    write_candump(path, messages)
    return path


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return read_scenario(SCENARIO)


def test_a_scenario_through_can_is_the_scenario(scenario: Scenario, tmp_path: Path) -> None:
    """Past and future of every car in range, within what the object list resolves."""
    log = write_log(tmp_path / "drive.log", list(drive_messages([scenario], RANGE_M)))
    lanes = lane_map(scenario)
    save_tile(tmp_path / "drive.tile", encode(lanes, TileInfo(name="t", source="t", credit="")))
    recordings = read(reader(profile="generic", tile=tmp_path / "drive.tile", stride=1), log)
    ego = choose_ego(scenario)
    compared = 0
    assert len({cycle_of(recording) for recording in recordings}) == len(recordings) > 20
    for recording in recordings:
        assert recording.lanes is not None
        np.testing.assert_array_equal(recording.lanes.points, lanes.points)
        expected = _as_seen(scenario, int(ego.step[cycle_of(recording)]), recording)
        assert len(expected) == recording.may_be_target.sum()
        grid = recording.tracks
        for agent in np.flatnonzero(recording.may_be_target):
            here = grid.positions[agent, now()]
            away = [np.linalg.norm(positions[now()] - here) for positions, _ in expected]
            positions, valid = expected[int(np.argmin(away))]
            np.testing.assert_array_equal(grid.valid[agent], valid)
            away_m = np.linalg.norm(grid.positions[agent] - positions, axis=-1)[valid]
            assert away_m.max() < DBC_M
            compared += int(valid[future()].any())
    assert compared > 100


def _as_seen(
    scenario: Scenario, step: int, recording: Recording
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions (S, 2) and valid (S,) of every other car seen now and again, from the scenario.

    The steps around now in which it was in range without a break: after one it has another id.
    """
    ego = choose_ego(scenario)
    first = step - now()
    found = []
    for track in scenario.tracks:
        positions = np.full((recording.tracks.num_steps, 2), np.nan)
        own = positions.copy()
        for one, into in ((track, positions), (ego, own)):
            inside = (one.step >= first) & (one.step < first + len(into))
            into[one.step[inside] - first] = one.position[inside]
        near = np.linalg.norm(positions - own, axis=-1) <= RANGE_M  # NaN is not near
        if track is not ego and near[now()]:
            after = np.cumprod(near[now() :])[1:]
            before = np.cumprod(near[now() :: -1])[::-1]
            found.append((positions, np.concatenate([before, after]).astype(np.bool_)))
    return found


CARS = [
    Car(object_id=3, x_m=20.0, y_m=0.0),
    Car(object_id=7, x_m=30.0, y_m=3.5, speed_mps=12.0),
    Car(object_id=9, x_m=40.0, y_m=-3.5, speed_mps=0.0),
]


def drive_log(path: Path, seconds: float, *, rate_hz: int = 10) -> Path:
    steps = range(round(rate_hz * seconds) + 1)
    return write_log(path, [m for i in steps for m in cycle(CARS, i / rate_hz, start_s=1000.0)])


@pytest.mark.parametrize("rate_hz", [10, 20, 50])
def test_the_future_is_where_the_cars_then_were(rate_hz: int, tmp_path: Path) -> None:
    """At every rate, also where the tracker forgets measurements before the horizon is over."""
    log = drive_log(tmp_path / "drive.log", 8.0, rate_hz=rate_hz)
    recordings = read(reader(profile="generic"), log)
    whole = [r for r in recordings if r.tracks.valid[:-1, future()].all()]
    assert len(whole) >= 10  # a prediction every half second at least, until 3 s before the end
    for recording in whole:
        grid = recording.tracks
        elapsed_s = recording.dt_s * (np.arange(grid.num_steps) - now())
        for agent, car in enumerate(CARS):
            expected = grid.positions[agent, now()] + np.outer(elapsed_s, (car.speed_mps, 0.0))
            away_m = np.linalg.norm(grid.positions[agent] - expected, axis=-1)
            assert away_m[grid.valid[agent]].max() < 0.011  # the object list resolves 0.01 m


def test_a_future_ends_with_its_track_and_with_the_log(tmp_path: Path) -> None:
    """Steps after the last measurement are not valid; a clock with nothing after it is left out."""
    messages = [m for i in range(41) for m in cycle(CARS if i <= 30 else CARS[:1], i / 10)]
    log = write_log(tmp_path / "drive.log", messages)
    recordings = {cycle_of(r): r for r in read(reader(profile="generic"), log)}
    assert sorted(recordings) == [0, 5, 10, 15, 20, 25, 30, 35]
    for number, recording in recordings.items():
        seen = recording.tracks.valid[:, future()].sum(axis=1)
        left = [max(end - number, 0) for end in (40, 30, 30)][: len(seen) - 1]
        np.testing.assert_array_equal(seen[:-1], np.minimum(left, contract().horizon_steps))


def test_no_track_goes_through_a_jump_of_the_map_frame(tmp_path: Path) -> None:
    """The INS finds itself 50 m away after 4 s: what came before is not continued after it."""
    messages = []
    for i in range(81):
        pose = Pose2(0.0 if i < 40 else 50.0, 0.0, 0.0)
        messages += cycle(CARS, i / 10, pose=pose)
    recordings = read(reader(profile="generic"), write_log(tmp_path / "drive.log", messages))
    assert {cycle_of(r) < 40 for r in recordings} == {True, False}
    for recording in recordings:
        grid, number = recording.tracks, cycle_of(recording)
        steps = np.diff(grid.positions[:-1], axis=1)[grid.valid[:-1, 1:] & grid.valid[:-1, :-1]]
        assert np.abs(steps).max() < 1.3
        if number < 40:
            assert grid.valid[:-1, future()].sum(axis=1).max() < 40 - number
        else:
            assert grid.valid[:-1, past()].sum(axis=1).max() <= number - 40 + 1


def test_the_ego_vehicle_is_a_neighbour_and_never_a_target() -> None:
    """Its past is known, and where it goes is not what we predict."""
    for recording in recorded("rav4"):
        assert recording.track_ids[-1] == EGO_ID
        assert not recording.may_be_target[-1]
        assert recording.tracks.valid[-1, now()]
        assert not recording.tracks.valid[-1, future()].any()


def test_without_a_map_pose_there_are_no_lanes(tmp_path: Path) -> None:
    """The RAV4's log has none: its recordings are in the frame of dead reckoning."""
    log = tmp_path / "drive.log"
    log.write_text(log_text("rav4"))
    tile = DRIVES["ngsim"].tile
    for found in (recorded("rav4"), read(reader(profile="toyota-rav4", tile=tile), log)):
        assert found
        assert all(recording.lanes is None for recording in found)
    lanes = {id(recording.lanes) for recording in recorded("ngsim")}
    assert len(lanes) == 1  # one object, whose index is built once
    assert id(None) not in lanes


def test_what_is_no_vehicle_is_no_target(tmp_path: Path) -> None:
    """It stands in the scenes of the others all the same."""
    kinds = np.array([ObjectClass.PEDESTRIAN, ObjectClass.UNKNOWN, ObjectClass.TRUCK], np.uint8)
    messages = []
    for i in range(31):
        messages += encode_cycle(
            replace(object_list(CARS, i / 10), object_class=kinds),
            timestamp_s=i / 10,
            counter=i,
            speed_mps=0.0,
            yaw_rate_rad_s=0.0,
        )
    found = read(reader(profile="generic"), write_log(tmp_path / "drive.log", messages))
    assert len(found) == 6
    for recording in found:
        np.testing.assert_array_equal(recording.may_be_target, [False, True, True, False])
        assert recording.tracks.valid[0, now()]


def test_a_folder_of_logs_is_a_part_and_a_group_each(tmp_path: Path) -> None:
    """Packed or not, in folders of it too; other files are let be."""
    text = drive_log(tmp_path / "b.log", 3.0).read_bytes()
    (tmp_path / "car 2").mkdir()
    (tmp_path / "car 2" / "a.log.gz").write_bytes(gzip.compress(text))
    (tmp_path / "readme.txt").write_text("no log")
    parts = reader(profile="generic").parts(tmp_path)
    assert [Path(part.path).name for part in parts] == ["a.log.gz", "b.log"]
    copied = pickle.loads(pickle.dumps(reader(profile="generic")))
    found = [list(copied.read(part)) for part in parts]
    assert [{r.group for r in of_log} for of_log in found] == [{"a.log.gz"}, {"b.log"}]
    for packed, plain in zip(*found, strict=True):
        np.testing.assert_array_equal(packed.tracks.positions, plain.tracks.positions)


def test_two_logs_of_one_name_are_refused(tmp_path: Path) -> None:
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        drive_log(tmp_path / folder / "drive.log", 1.0)
    with pytest.raises(LogError, match=r"monday/drive\.log and .* have the same name; rename"):
        reader(profile="generic").parts(tmp_path)


@pytest.mark.parametrize(("there", "what"), [(True, "no CAN log"), (False, "no such folder")])
def test_nothing_to_read_is_an_error(there: bool, what: str, tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    if there:
        folder.mkdir()
    with pytest.raises(LogError, match=rf"logs: {what}.*\.log \.asc \.blf \.trc"):
        reader(profile="generic").parts(folder)


def test_a_log_of_another_sensor_is_an_error(tmp_path: Path) -> None:
    """It would be an empty dataset otherwise, and nobody would know why."""
    log = drive_log(tmp_path / "drive.log", 1.0)
    with pytest.raises(LogError, match=r"drive\.log: no object list of the profile 'ars408' in"):
        read(reader(profile="ars408"), log)


def test_only_the_named_channels_are_read() -> None:
    """The RAV4's radar is on can1, its wheels are on can0."""
    right = recorded("rav4", channels=("radar=can1", "car=can0"))
    assert [r.name for r in right] == [r.name for r in recorded("rav4")]
    with pytest.raises(LogError, match="no object list"):
        recorded("rav4", channels=("radar=can0", "car=can1"))


def test_the_license_is_the_recorders_own_until_they_say() -> None:
    own = reader(profile="generic").source
    assert (own.license, own.credits, own.non_commercial) == (RECORDERS_OWN, RECORDERS_OWN, False)
    said = reader(profile="generic", license="CC-BY-NC-4.0", credits="(c) Somebody").source
    assert (said.credits, said.non_commercial) == ("(c) Somebody", True)


@pytest.mark.parametrize(
    "terms",
    ["CC-BY-NC-SA-4.0", "CC BY-NC 4.0", "CC BY NC 4.0", "Non-commercial research", "noncommercial"],
)
def test_a_license_against_commerce_is_told_however_it_is_spelled(terms: str) -> None:
    assert reader(profile="generic", license=terms).source.non_commercial
