"""Ego motion and pose: means, directions, groups of messages, ages."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import can
import cantools.database
import pytest

import eqrt.runtime.decoding.profile
from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import EgoMotion, EgoPose
from eqrt.runtime.decoding.profile import load_profile
from tiny_sensor import EGO, GEAR, decoder_of, message

SBG_DBC = Path(eqrt.runtime.decoding.profile.__file__).parent / "dbc" / "sbg" / "sbgCan.dbc"

WHEELS = """
description = "speed from two wheels, with the gear for its direction"

[[ego]]
bus = "car"
dbc = "tiny.dbc"
messages = { gear = "GEAR", wheels = "EGO" }
latency_s = 0.01
hold_s = 1.0

[ego.fields]
speed = { mean = ["wheels.LEFT", "wheels.RIGHT"] }
reverse = "gear.GEAR == 2"
yaw_rate = { signal = "wheels.YAW_RATE", sign = -1, when = "raw(wheels.YAW_RATE) != -32768" }
valid = "wheels.LEFT < 6000"
"""


def ego(left_km_h: float, right_km_h: float, yaw_rate_deg_s: float = 0.0) -> can.Message:
    numbers = (round(10 * left_km_h), round(10 * right_km_h), round(10 * yaw_rate_deg_s))
    return message(EGO, b"".join((n & 0xFFFF).to_bytes(2, "little") for n in numbers) + bytes(2))


def feed(folder: Path, messages: list[tuple[float, can.Message]]) -> list[Event]:
    decoder = decoder_of(folder, WHEELS)
    return [event for at_s, one in messages for event in decoder.feed(one, at_s)]


def test_a_speed_is_the_mean_of_the_wheels_in_metres_per_second(tmp_path: Path) -> None:
    (motion,) = feed(tmp_path, [(5.0, ego(35.0, 37.0, 90.0))])
    assert isinstance(motion, EgoMotion)
    assert motion.timestamp_s == pytest.approx(4.99)
    assert motion.speed_mps == pytest.approx(10.0)
    assert motion.yaw_rate_rad_s == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(("age_s", "speed"), [(0.5, -10.0), (1.5, 10.0)])
def test_the_gear_turns_the_speed_around_while_it_is_fresh(
    tmp_path: Path, age_s: float, speed: float
) -> None:
    gear = message(GEAR, bytes([2]))
    (motion,) = feed(tmp_path, [(5.0 - age_s, gear), (5.0, ego(36.0, 36.0))])
    assert isinstance(motion, EgoMotion)
    assert motion.speed_mps == pytest.approx(speed)


def test_a_value_marked_not_available_is_none(tmp_path: Path) -> None:
    (motion,) = feed(tmp_path, [(5.0, ego(36.0, 36.0, -3276.8))])
    assert isinstance(motion, EgoMotion)
    assert motion.speed_mps == pytest.approx(10.0)
    assert motion.yaw_rate_rad_s is None


def test_a_message_that_is_not_valid_tells_nothing(tmp_path: Path) -> None:
    assert feed(tmp_path, [(5.0, ego(6000.0, 36.0))]) == []


def test_a_message_cut_short_tells_what_is_in_it(tmp_path: Path) -> None:
    cut = ego(36.0, 36.0, 10.0)
    cut.data = cut.data[:5]
    (motion,) = feed(tmp_path, [(5.0, cut)])
    assert isinstance(motion, EgoMotion)
    assert motion.speed_mps == pytest.approx(10.0)
    assert motion.yaw_rate_rad_s is None


def test_an_empty_message_tells_nothing(tmp_path: Path) -> None:
    assert feed(tmp_path, [(5.0, message(EGO, b""))]) == []


def sbg_messages(
    latitude_deg: float, longitude_deg: float, heading_rad: float
) -> list[can.Message]:
    """What the INS sends of a fix that is good to 10 cm, from its published DBC."""
    database: Any = cantools.database.load_file(SBG_DBC)
    values = {
        "SBG_ECAN_MSG_EKF_EULER": {"ROLL": 0, "PITCH": 0, "YAW": heading_rad},
        "SBG_ECAN_MSG_EKF_POS": {"LATITUDE": latitude_deg, "LONGITUDE": longitude_deg},
        "SBG_ECAN_MSG_EKF_POS_ACC": dict.fromkeys(
            ("LATITUDE_ACC", "LONGITUDE_ACC", "ALTITUDE_ACC"), 0.1
        ),
    }
    definitions = [(database.get_message_by_name(name), value) for name, value in values.items()]
    return [message(d.frame_id, d.encode(value)) for d, value in definitions]


def pose_of(decoder: Decoder, messages: list[can.Message]) -> Pose2:
    (event,) = [event for one in messages for event in decoder.feed(one, 1.0)]
    assert isinstance(event, EgoPose)
    return event.map_from_ego


# East and north as lanelet2's LocalCartesianProjector has them.
@pytest.mark.parametrize(
    ("origin", "here", "place"),
    [
        ((49.0, 8.4), (49.01, 8.42), (1463.142840, 1112.291071)),
        ((-33.9, 151.2), (-33.95, 151.23), (2773.166263, -5546.455830)),
        ((0.0, 0.0), (0.2, -0.3), (-33395.492548, 22114.811156)),
    ],
)
def test_latitude_and_longitude_are_placed_as_in_a_lanelet2_map(
    origin: tuple[float, float], here: tuple[float, float], place: tuple[float, float]
) -> None:
    decoder = Decoder(load_profile("sbg-ins"), map_origin_deg=origin)
    pose = pose_of(decoder, sbg_messages(*here, heading_rad=0.5))
    assert (pose.x_m, pose.y_m) == pytest.approx(place, abs=0.011)  # a step of 1e-7 degrees


def test_a_heading_is_turned_into_a_yaw_from_east() -> None:
    """0.5 rad clockwise from north; north itself leans by the convergence of the meridians."""
    decoder = Decoder(load_profile("sbg-ins"), map_origin_deg=(49.0, 8.4))
    convergence = math.radians(0.02) * math.sin(math.radians(49.01))
    pose = pose_of(decoder, sbg_messages(49.01, 8.42, heading_rad=0.5))
    assert pose.yaw_rad == pytest.approx(math.pi / 2 - 0.5 + convergence, abs=1e-4)


def test_without_a_map_the_first_pose_is_the_origin() -> None:
    decoder = Decoder(load_profile("sbg-ins"))
    first = pose_of(decoder, sbg_messages(49.0, 8.4, heading_rad=math.pi / 2))
    assert (first.x_m, first.y_m) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert first.yaw_rad == pytest.approx(0.0, abs=1e-4)
    second = pose_of(decoder, sbg_messages(49.0, 8.401, heading_rad=math.pi / 2))
    assert second.x_m == pytest.approx(73.17, abs=0.02)  # a thousandth of a degree at 49 north


def test_a_map_without_a_place_on_earth_gets_no_pose() -> None:
    decoder = Decoder(load_profile("sbg-ins"), map_origin_deg=(math.nan, math.nan))
    for one in sbg_messages(49.0, 8.4, 0.0):
        assert decoder.feed(one, 1.0) == []


def test_a_fix_that_is_not_accurate_is_not_told() -> None:
    decoder = Decoder(load_profile("sbg-ins"))
    *others, accuracy = sbg_messages(49.0, 8.4, 0.0)
    accuracy.data[0:2] = (250).to_bytes(2, "little")  # 2.5 m
    for one in (*others, accuracy):
        assert decoder.feed(one, 1.0) == []
