"""CommonRoad scenarios as recordings: which share vehicles, and what is in one."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from eqrt.core.errors import LogError
from eqrt.training.recordings.commonroad import read_scenario
from eqrt.training.recordings.commonroad_recordings import CommonRoadReader, group_of
from window_samples import NGSIM, SCENARIO, scenario


def speed_sequences(path: Path, steps: int = 15) -> set[tuple[float, ...]]:
    """Every stretch of `steps` speeds that varies: as good as a fingerprint of a vehicle."""
    rows = [np.round(track.speed_mps, 3).tolist() for track in read_scenario(path).tracks]
    windows = (tuple(row[i : i + steps]) for row in rows for i in range(len(row) - steps))
    return {window for window in windows if len(set(window)) > steps // 2}


def test_scenarios_that_share_vehicles_share_a_group() -> None:
    """Two chance matches are allowed: speeds that a recorder repeats look alike."""
    found = {path.name.partition(".")[0]: speed_sequences(path) for path in NGSIM.glob("*.xml.gz")}
    for one, ours in found.items():
        for other, theirs in found.items():
            if len(ours & theirs) > 2:
                assert group_of(one) == group_of(other), (one, other)
    assert len(found["USA_US101-22_4_T-1"] & found["USA_US101-21_2_T-1"]) > 10


@pytest.mark.parametrize(
    ("name", "group"),
    [
        ("USA_US101-22_4_T-1", "USA_US101-21"),
        ("USA_US101-5_1_T-1", "USA_US101-5"),
        ("USA_US101-15_1_T-1", "USA_US101-5"),
        ("USA_US101-24_2_T-1", "USA_US101-1"),
        ("USA_US101-26_2_T-1", "USA_US101-26"),
        ("USA_Lanker-1_2_T-1", "USA_Lanker-1"),
        ("DEU_A9-15_1_T-1", "DEU_A9-15"),
        ("my drive", "my drive"),
    ],
)
def test_a_group_is_a_place_and_a_time(name: str, group: str) -> None:
    assert group_of(name) == group


def test_a_recording_holds_what_the_scenario_says() -> None:
    tracks, recording = read_scenario(SCENARIO).tracks, scenario()
    assert recording.name == "USA_Peach-4_8_T-1"
    assert recording.dt_s == 0.1
    assert recording.track_ids == tuple(str(track.track_id) for track in tracks)
    for row, track in enumerate(tracks):
        np.testing.assert_array_equal(recording.tracks.positions[row, track.step], track.position)
        np.testing.assert_array_equal(
            np.flatnonzero(recording.tracks.valid[row]), np.sort(track.step)
        )
    assert recording.may_be_target.all()  # cars, all of them
    assert not recording.focal.any()
    assert recording.lanes is not None


def test_a_pedestrian_is_no_target(tmp_path: Path) -> None:
    text = gzip.decompress(SCENARIO.read_bytes()).replace(b"<type>car<", b"<type>pedestrian<", 1)
    path = tmp_path / "walk.xml"
    path.write_bytes(text)
    reader = CommonRoadReader()
    may_be_target = next(iter(reader.read(reader.parts(path)[0]))).may_be_target
    assert np.count_nonzero(~may_be_target) == 1


def test_parts_are_the_files_by_name() -> None:
    names = [Path(part.path).name for part in CommonRoadReader().parts(NGSIM)]
    assert len(names) == 9
    assert names == sorted(names)


def test_an_empty_folder_is_an_error_a_user_understands(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no CommonRoad scenario"):
        CommonRoadReader().parts(tmp_path)


@pytest.mark.parametrize(
    ("last_step", "said"),
    [
        ("999999999", "a time step is not within 0 to 100000"),
        ("3000000000", "obstacle 507: a time is beyond 2147483647 steps"),
        ("1e300", "obstacle 507: a time is beyond"),
    ],
)
def test_a_scenario_of_days_is_refused(tmp_path: Path, last_step: str, said: str) -> None:
    """A wrong time must not fill the memory."""
    text = gzip.decompress(SCENARIO.read_bytes()).decode()
    last = text.rindex("<time>", 0, text.index("</trajectory>"))
    begin = text.index("<exact>", last) + len("<exact>")
    path = tmp_path / "long.xml"
    path.write_text(f"{text[:begin]}{last_step}{text[text.index('<', begin) :]}")
    with pytest.raises(LogError, match=rf"long\.xml: {said}"):
        list(CommonRoadReader().read(CommonRoadReader().parts(path)[0]))
