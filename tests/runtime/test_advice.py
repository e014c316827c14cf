"""What a setup lacks is said in one line that ends with what to do, before anybody wonders."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from drives import DRIVES, TILE, first_seconds
from eqrt.cli import main
from eqrt.runtime.advice import taken_to_stand, unused_map
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.prediction.tiles import load_tile
from processes import Serving
from tiny_sensor import COUNTED, profile_of
from two_tiles import other_tile

WITHOUT_POSES = "the map will not be used, because the profile 'ars408' gives no poses"


@pytest.fixture
def ars408(tmp_path: Path) -> Path:
    """Two seconds of the radar."""
    path = tmp_path / "drive.log"
    path.write_text(first_seconds(DRIVES["ars408"].log, 2.0))
    return path


def test_a_replay_says_that_a_map_without_poses_is_not_used(
    ars408: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--profile", "ars408", "--tile", str(TILE), "--out", "/dev/null"]
    assert main(["replay", str(ars408), *options]) == 0
    (warning,) = [line for line in capsys.readouterr().err.splitlines() if "map" in line]
    assert warning.startswith(f"eqrt: {TILE}: {WITHOUT_POSES}")


def test_the_service_says_that_a_map_without_poses_is_not_used() -> None:
    channel = f"advice-{time.monotonic_ns()}"
    on = ["--can", channel, "--can-interface", LOCAL]
    with Serving(*on, "--profile", "ars408", "--tile", str(TILE)) as service:
        status, _, errors = service.end()
    assert status == 0
    assert WITHOUT_POSES in errors


def test_a_profile_that_tells_no_motion_is_said_to_stand(tmp_path: Path) -> None:
    """Unless the user says so."""
    radar = profile_of(tmp_path, COUNTED)
    assert "taken to stand still" in (taken_to_stand(radar, stationary=False) or "")
    assert taken_to_stand(radar, stationary=True) is None
    for name in ("ars408", "srr520", "sbg-ins"):
        assert taken_to_stand(load_profile(name), stationary=False) is None


def test_the_service_says_that_the_sensor_is_taken_to_stand(tmp_path: Path) -> None:
    profile_of(tmp_path, COUNTED)
    channel = f"advice-{time.monotonic_ns()}"
    on = ["--can", channel, "--can-interface", LOCAL, "--profile", str(tmp_path / "tiny.toml")]
    with Serving(*on) as service:
        _, _, errors = service.end()
    with Serving(*on, "--stationary") as service:
        _, _, silence = service.end()
    assert "eqrt: the profile 'tiny' has no [[ego]]" in errors
    assert "[[ego]]" not in silence


def test_a_map_is_used_where_there_are_poses_for_it(tmp_path: Path) -> None:
    """In its own x and y any map; by latitude and longitude one that says where it is."""
    nowhere = load_tile(other_tile(tmp_path))
    somewhere = load_tile(other_tile(tmp_path, origin_latitude_deg=48.0, origin_longitude_deg=11.0))
    ins, generic = load_profile("sbg-ins"), load_profile("generic")
    assert unused_map(load_profile("ars408"), None) is None
    assert unused_map(generic, nowhere) is None
    assert unused_map(ins, somewhere) is None
    assert "--origin LAT,LON" in (unused_map(ins, nowhere) or "")
