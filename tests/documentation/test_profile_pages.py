"""The profiles on our pages are whole: they load, and do what the page says."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any

import can
import cantools
import pytest

from drives import DRIVES, first_seconds, shipped_predictor
from eqrt.core.frames import Pose2
from eqrt.runtime.advice import unused_map
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.decoding import profile as profiles
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay
from source_tree import ROOT
from two_tiles import X_M, Y_M, other_tile

BUILT_IN = Path(profiles.__file__).parent / "profiles"
SBG: Any = cantools.database.load_file(BUILT_IN.parent / "dbc/sbg/sbgCan.dbc")
LATITUDE_DEG, LONGITUDE_DEG = 48.0, 11.0
_M_PER_DEG = 111_200.0  # of latitude


def blocks(page: str) -> list[str]:
    """The TOML on a page."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def built_in(name: str) -> dict[str, Any]:
    return tomllib.loads((BUILT_IN / f"{name}.toml").read_text(encoding="utf-8"))


@pytest.fixture
def radar_and_ins(tmp_path: Path) -> Path:
    path = tmp_path / "radar-ins.toml"
    path.write_text(blocks("radar-ins-map.md")[0], encoding="utf-8")
    return path


def test_radar_and_ins_are_those_that_come_with_eqrt(radar_and_ins: Path) -> None:
    """But for the mount, which the reader is told to change."""
    page = tomllib.loads(radar_and_ins.read_text())
    page["sensor"][0]["mount"] = built_in("ars408")["sensor"][0]["mount"]
    assert page["sensor"] == built_in("ars408")["sensor"]
    assert page["ego"] == built_in("sbg-ins")["ego"]
    profile = load_profile(str(radar_and_ins))
    assert profile.roles == ("radar", "car")
    assert all(map(profile.gives, ("speed", "yaw_rate", "pose")))


def ins_messages(time_s: float) -> list[can.Message]:
    """A car that stands at the beginning of the tile's first lane, looking along it."""
    place = {
        "LATITUDE": LATITUDE_DEG + Y_M / _M_PER_DEG,
        "LONGITUDE": LONGITUDE_DEG + X_M / (_M_PER_DEG * 0.6703),
    }
    told: dict[str, dict[str, float]] = {
        "SBG_ECAN_MSG_EKF_EULER": {"ROLL": 0, "PITCH": 0, "YAW": math.radians(90.0 + 42.0)},
        "SBG_ECAN_MSG_EKF_POS": place,
        "SBG_ECAN_MSG_EKF_POS_ACC": dict.fromkeys(
            ("LATITUDE_ACC", "LONGITUDE_ACC", "ALTITUDE_ACC"), 0.1
        ),
        "SBG_ECAN_MSG_EKF_VEL_BODY": dict.fromkeys(("VELOCITY_X", "VELOCITY_Y", "VELOCITY_Z"), 0),
        "SBG_ECAN_MSG_IMU_GYRO": dict.fromkeys(("GYRO_X", "GYRO_Y", "GYRO_Z"), 0),
    }
    return [
        can.Message(
            arbitration_id=SBG.get_message_by_name(name).frame_id,
            is_extended_id=False,
            data=SBG.encode_message(name, values),
            timestamp=time_s,
        )
        for name, values in told.items()
    ]


def test_a_radar_beside_an_ins_is_predicted_on_the_map(radar_and_ins: Path, tmp_path: Path) -> None:
    """The recorded ARS408, with an INS that sends at 50 Hz beside it."""
    at = {"origin_latitude_deg": LATITUDE_DEG, "origin_longitude_deg": LONGITUDE_DEG}
    tile = load_tile(other_tile(tmp_path, **at))
    profile = load_profile(str(radar_and_ins))
    assert unused_map(profile, tile) is None
    lines = first_seconds(DRIVES["ars408"].log, 4.0).splitlines()
    radar = [candump_message(line) for line in lines]
    start_s = radar[0].timestamp
    ins = [one for step in range(200) for one in ins_messages(start_s + step / 50)]
    messages = sorted([*ins, *radar], key=lambda message: message.timestamp)
    made = list(replay(Pipeline(profile, shipped_predictor(), tile), messages))
    last = [forecast for forecast in made if forecast.num_targets][-1]
    assert last.mode is Mode.RUN
    assert last.tile_id == tile.info.tile_id
    assert last.map_from_ego is not None
    assert (last.map_from_ego.x_m, last.map_from_ego.y_m) == pytest.approx((X_M, Y_M), abs=3.0)
    mounted = Pose2(3.6, 0.0, 0.0)
    assert profile.sensors[0].mount == mounted


def test_poses_from_a_program_take_the_place_of_the_ins(
    radar_and_ins: Path, tmp_path: Path
) -> None:
    page = radar_and_ins.read_text()
    changed = tmp_path / "radar-program.toml"
    changed.write_text(page[: page.index("[[ego]]")] + blocks("radar-ins-map.md")[1])
    profile = load_profile(str(changed))
    assert profile.roles == ("radar", "car")
    assert all(map(profile.gives, ("speed", "yaw_rate", "pose", "x")))
    assert unused_map(profile, load_tile(other_tile(tmp_path))) is None


def test_the_example_of_a_sensor_is_the_file_that_comes_with_eqrt() -> None:
    """So that what the page says of the ARS408, its mount among it, holds."""
    example = tomllib.loads(blocks("profiles.md")[0])
    assert example["sensor"] == built_in("ars408")["sensor"]
