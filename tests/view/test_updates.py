"""What pages are told, byte for byte, and in words."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crowd import crowd
from drives import TILE
from eqrt.core.errors import LogError
from eqrt.core.frames import Pose2
from eqrt.core.metrics import LENGTH_OF_SHARE
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.view.hindsight import Hindsight
from eqrt.runtime.view.playback import Playback
from eqrt.runtime.view.recorded import Record, TileUsed, read_records
from eqrt.runtime.view.server import Wanted
from eqrt.runtime.view.updates import STEP_M, course_rad, decode_update, encode_update
from eqrt.runtime.view.watch import NO_LANES, Lanes, Watch
from eqrt.runtime.view.words import DROPS, LEVELS, drops, mode_words
from forecast_sets import many, nobody, one_car
from recorded_drives import recorded_drive


def update_of(forecast: ForecastSet) -> bytes:
    ghosts = Hindsight().add(forecast)
    return encode_update(
        forecast,
        ghosts=ghosts,
        score=None,
        stream=0,
        time_s=forecast.moment_s,
        mode_since_s=0.0,
        lanes=NO_LANES,
    )


def test_places_come_back_to_a_centimetre() -> None:
    forecast = many(40)
    head, places = decode_update(update_of(forecast))
    assert head["shape"] == [40, 20, 6, 30]
    for name in ("position", "history", "trajectories"):
        np.testing.assert_allclose(places[name], getattr(forecast, name), atol=STEP_M / 2 + 1e-6)
    assert np.isnan(places["ghosts"]).all()
    assert head["agents"]["track_id"] == forecast.track_id.tolist()
    assert head["agents"]["probabilities"][7] == pytest.approx(forecast.probabilities[7], abs=1e-3)


def test_64_agents_with_6_modes_take_no_more_than_they_say() -> None:
    assert len(update_of(crowd(0, 64))) < 75_000  # 58,000 for places


def test_what_is_not_known_is_null_and_no_place() -> None:
    head, places = decode_update(update_of(one_car()))
    agents = head["agents"]
    assert agents["width_m"] == [None]
    assert agents["length_m"] == [4.5]
    assert agents["ellipses"] is None
    assert head["score"] is None
    np.testing.assert_array_equal(np.isnan(places["history"][0, :, 0]), np.arange(20) < 13)


def test_what_lies_too_far_out_is_no_place_rather_than_a_wrong_one() -> None:
    forecast = one_car()
    forecast.trajectories[0, 1, 20:] += 1e5
    _, places = decode_update(update_of(forecast))
    assert np.isnan(places["trajectories"][0, 1, 20:]).all()
    assert not np.isnan(places["trajectories"][0, 1, :20]).any()


def test_a_cycle_without_an_ego_pose_tells_none() -> None:
    """Nor does one from a recording of before there was None."""
    for nowhere in (None, Pose2()):
        silent = replace(nobody(), map_from_ego=nowhere, ego_speed_mps=math.nan)
        head, _ = decode_update(update_of(silent))
        assert head["ego"] is None
        assert head["level"] == "bad"
    standing = replace(one_car(), ego_speed_mps=0.0)
    assert decode_update(update_of(standing))[0]["ego"] == pytest.approx([100, 200, math.pi / 2])


def test_a_heading_is_measured_or_where_it_drives_to_or_not_known() -> None:
    forecast = replace(many(3), heading_rad=np.array([0.5, np.nan, np.nan]))
    forecast.velocity[1] = (0.0, -3.0)
    forecast.velocity[2] = (0.1, 0.1)
    np.testing.assert_allclose(course_rad(forecast), [0.5, -math.pi / 2, np.nan])


def test_what_only_seems_to_stand_is_not_said_to_be_predicted() -> None:
    unknown = replace(one_car(), velocity=np.full((1, 2), np.nan))
    for mode in (Mode.PARTIAL, Mode.LATE, Mode.FALLBACK):
        found = replace(unknown, agent_mode=np.array([mode], np.uint8))
        agents = decode_update(update_of(found))[0]["agents"]
        assert agents["words"] == ["not predicted: nothing tells how it moves"]
        assert agents["speed_mps"] == [None]
    agents = decode_update(update_of(one_car()))[0]["agents"]
    assert agents["words"] == ["predicted from a short history"]


def test_an_ellipse_holds_half_of_the_distribution() -> None:
    forecast = one_car()
    along, across = 3.0, 0.75
    covariances = np.zeros((1, 2, 30, 2, 2))
    covariances[..., 0, 0], covariances[..., 1, 1] = across, along
    head, _ = decode_update(update_of(replace(forecast, covariances=covariances)))
    long, short, angle = head["agents"]["ellipses"][0][0]
    assert long == pytest.approx(LENGTH_OF_SHARE[50] * math.sqrt(along / 3), abs=1e-3)
    assert short == pytest.approx(LENGTH_OF_SHARE[50] * math.sqrt(across / 3), abs=1e-3)
    assert abs(math.sin(angle)) == pytest.approx(1.0)  # it drives north


def test_every_mode_has_words_and_a_level() -> None:
    words = {mode_words(mode, 3) for mode in Mode if mode is not Mode.PARTIAL}
    assert len(words) == len(Mode) - 1
    assert not any(mode.name in text for text in words for mode in Mode)
    assert set(LEVELS) == set(Mode)
    assert mode_words(Mode.NO_POSE, 0) == "No ego motion: nothing is predicted"
    assert mode_words(Mode.NO_POSE, 4) == "No map pose: predicting without lanes"


def test_only_what_went_wrong_is_told() -> None:
    assert drops({"can_failed": 0, "can_sent": 7, "tracks_dropped": 2}) == {
        DROPS["tracks_dropped"]: 2
    }


def test_lanes_are_told_around_the_ego_vehicle_and_again_when_it_has_driven_on() -> None:
    tile = load_tile(TILE)
    lanes = Lanes(TILE)
    assert lanes.near(one_car()) is None  # predicted without a map
    x_m, y_m = tile.lane_map.lane_points(0)[0].tolist()

    def there(ahead_m: float) -> ForecastSet:
        pose = Pose2(x_m + ahead_m, y_m, 0.0)
        tile_id = "e66f7853" if ahead_m else ""
        return replace(one_car(), tile_id=tile_id, mode=Mode.RUN, map_from_ego=pose)

    first = lanes.near(there(0.0).targets(slice(0)))  # on an empty road no lanes are looked for
    assert first is not None
    told = json.loads(first)
    points = np.array(told["lanes"][0]).reshape(-1, 2) / 100.0 + told["origin"]
    np.testing.assert_allclose(points, tile.lane_map.lane_points(0), atol=0.01)
    assert lanes.near(there(150.0)) is None
    assert lanes.near(replace(there(300.0), mode=Mode.NO_POSE)) is None
    again = lanes.near(there(300.0))
    assert again is not None
    assert json.loads(again)["number"] == told["number"] + 1
    assert list(lanes.recent) == [first, again]  # for a page that comes now and steps back


def test_the_map_is_the_one_that_the_service_says(tmp_path: Path) -> None:
    tile = load_tile(TILE)
    x_m, y_m = tile.lane_map.lane_points(0)[0].tolist()
    place = Pose2(x_m, y_m, 0.0)
    there = replace(one_car(), tile_id=tile.info.tile_id, mode=Mode.RUN, map_from_ego=place)
    lanes = Lanes()
    assert lanes.near(there) is None
    assert lanes.hear(status_with(tmp_path / "gone.tile", "0badc0de")).startswith(
        f"no lanes are shown: {tmp_path / 'gone.tile'}: no such tile file"
    )
    assert lanes.hear(status_with(TILE, "0ddba11")).endswith("its lanes may differ")
    assert lanes.hear(status_with(TILE, tile.info.tile_id)) == ""
    assert lanes.near(there) is not None
    assert len(lanes.recent) == 1
    assert lanes.hear(status_with(TILE, "0ddba12"))
    assert lanes.number == NO_LANES  # until the first cycle on it


@pytest.mark.parametrize("exchanged", [(None, ""), ("gone.tile", "0badc0de")])
def test_lanes_of_a_map_that_is_used_no_more_are_not_shown(
    tmp_path: Path, exchanged: tuple[str | None, str]
) -> None:
    """Whether the service has none now, or one that the view cannot read; what is wrong is said
    until it is right again. Who steps back finds the lanes that there were.
    """
    tile = load_tile(TILE)
    x_m, y_m = tile.lane_map.lane_points(0)[0].tolist()
    place = Pose2(x_m, y_m, 0.0)
    there = replace(one_car(), tile_id=tile.info.tile_id, mode=Mode.RUN, map_from_ego=place)
    name, tile_id = exchanged
    lanes = Lanes()
    assert lanes.hear(status_with(TILE, tile.info.tile_id)) == ""
    told = lanes.near(there)
    assert told is not None
    assert json.loads(told)["number"] == lanes.number == 0
    for _ in range(2):
        said = lanes.hear(status_with(tmp_path / name if name else None, tile_id))
        assert said.startswith("no lanes are shown: ") == (name is not None)
    assert lanes.near(there) is None
    assert lanes.number == NO_LANES
    assert lanes.hear(status_with(TILE, tile.info.tile_id)) == ""
    assert lanes.near(there) is not None
    assert lanes.number == 1
    assert len(lanes.recent) == 2


def test_a_file_tells_the_lanes_of_the_cycles_that_are_asked_for() -> None:
    """Of each map that was used in it, and of none where there was none."""
    tile = load_tile(TILE)
    x_m, y_m = tile.lane_map.lane_points(0)[0].tolist()
    place = Pose2(x_m, y_m, 0.0)
    maps = [tile, None, replace(tile, info=replace(tile.info, tile_id="0ddba11"))]

    def records() -> Iterator[Record]:
        for drive, used in enumerate(maps):
            yield TileUsed(used)
            for cycle in range(10 * drive, 10 * drive + 10):
                mode = Mode.RUN if used else Mode.NO_MAP
                yield replace(crowd(cycle, 3), mode=mode, map_from_ego=place)

    with Playback(records(), "drive", None) as playback:
        while not playback.done:
            time.sleep(0.01)
        for first, expected in ((0, [0]), (10, []), (20, [1])):
            answers = list(playback.find(Wanted(first=first, last=first + 10)))
            told = [json.loads(answer) for answer in answers if isinstance(answer, str)]
            assert [one["number"] for one in told] == expected
            assert all(one["lanes"] for one in told)
            heads = [decode_update(one)[0] for one in answers if isinstance(one, bytes)]
            assert {head["lanes"] for head in heads} == set(expected or [NO_LANES])
        whole = list(playback.find(Wanted(first=0, last=30, lanes=1)))
        assert sum(isinstance(answer, str) for answer in whole) == 1
        assert playback.trouble == ""


def status_with(tile: Path | None, tile_id: str) -> ServiceStatus:
    return ServiceStatus(
        time_s=1.0,
        uptime_s=1.0,
        seconds=1.0,
        eqrt="0",
        profile="generic",
        model="m",
        model_id="",
        tile=str(tile or ""),
        tile_id=tile_id,
        mode=Mode.RUN,
        mode_s=1.0,
        objects=0,
        messages=0,
        latencies_s=[],
        stages_s={},
        totals={},
    )


def test_a_replayed_file_is_what_the_service_said(tmp_path: Path) -> None:
    path = tmp_path / "some.jsonl"
    said = [crowd(cycle, 9) for cycle in range(30)]
    path.write_bytes(b"".join(map(json_lines, said)))
    found = [record for record in read_records(path) if isinstance(record, ForecastSet)]
    assert [record.cycle for record in found] == list(range(30))
    for one, other in zip(found, said, strict=True):
        np.testing.assert_allclose(one.trajectories, other.trajectories, atol=1e-3)
        np.testing.assert_array_equal(one.track_id, other.track_id)
        assert one.mode is other.mode
    last, true = found[-1], said[-1]
    stayed = [i for i, track in enumerate(last.track_id) if track in said[0].track_id]
    assert last.history_valid[stayed].all()
    np.testing.assert_allclose(last.history[stayed], true.history[stayed], atol=2e-3)
    assert not found[0].history_valid[:, :-1].any()
    watch = Watch()
    for record in found:
        head, _ = decode_update(watch.update(record))
    assert head["ego"] is None
    assert head["agents"]["error_m"][stayed[0]][0] == pytest.approx(0.0, abs=0.01)


def test_a_replayed_file_tells_how_far_off_a_path_may_be(tmp_path: Path) -> None:
    path, said = tmp_path / "some.jsonl", crowd(0, 3)
    spread = np.tile(4.0 * np.eye(2), (*said.trajectories.shape[:3], 1, 1))
    spread[1] = np.nan  # of a target that physics predicts
    path.write_bytes(json_lines(replace(said, covariances=spread)))
    (found,) = (record for record in read_records(path) if isinstance(record, ForecastSet))
    assert found.covariances is not None
    np.testing.assert_array_equal(found.covariances, spread)
    head, _ = decode_update(Watch().update(found))
    ellipses = np.array(head["agents"]["ellipses"], float)
    assert np.isnan(ellipses[1]).all()
    assert (ellipses[[0, 2], :, :2] > 0.0).all()
    path.write_bytes(json_lines(replace(said, covariances=None)))
    (unsure,) = (record for record in read_records(path) if isinstance(record, ForecastSet))
    assert unsure.covariances is None


def test_a_recording_is_what_the_service_said_of_itself_too(tmp_path: Path) -> None:
    """A real service's, two seconds of it: the folder, and each of its files."""
    folder = tmp_path / "recorded"
    with recorded_drive("ngsim", folder, tmp_path / "some.log", seconds=2.5) as (service, heard):
        service.end()
    records = list(read_records(folder))
    cycles = [record for record in records if isinstance(record, ForecastSet)]
    assert [one.cycle for one in cycles] == [one.cycle for one in heard.forecasts]
    assert all(one.history_valid.any() for one in cycles if one.num_targets)
    assert isinstance(records[0], TileUsed)  # and travels with it, wherever it is watched
    assert records[0].tile is not None
    assert records[0].tile.info.tile_id == load_tile(TILE).info.tile_id
    statuses = [record for record in records if isinstance(record, ServiceStatus)]
    assert [one.time_s for one in statuses] == [one.time_s for one in heard.statuses]
    (file,) = folder.glob("*.mcap")
    assert len(list(read_records(file))) == len(records)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.log", b"", "not a file that can be watched"),
        ("a.jsonl", b'{"cycle": 1}\n', ":1: not a line of `eqrt replay`"),
        ("a.jsonl", b"\xff\n", ":1: not a line of `eqrt replay`"),
        ("missing.jsonl", None, "no such file"),
    ],
)
def test_a_file_that_cannot_be_watched_is_refused_in_one_line(
    tmp_path: Path, name: str, content: bytes | None, said: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError) as refused:
        list(read_records(path))
    assert said in str(refused.value)
    assert str(path) in str(refused.value)


def test_a_cycle_whose_lines_do_not_fit_together_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    path.write_bytes(json_lines(crowd(0, 2)) + json_lines(replace(one_car(), cycle=0)))
    with pytest.raises(LogError, match="cycle 0 cannot be used"):
        list(read_records(path))
    longer = b'"covariances":[[[1.0,0.0,1.0],['
    path.write_bytes(json_lines(crowd(0, 1)).replace(b'"covariances":[[[', longer))
    with pytest.raises(LogError, match="cycle 0 cannot be used"):
        list(read_records(path))
