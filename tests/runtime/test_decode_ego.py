"""Ego motion and pose: means, directions, groups of messages, ages."""

from __future__ import annotations

import math
import struct
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import can
import cantools.database
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eqrt.runtime.decoding.profile
from eqrt.core.frames import Pose2, wrap_angle
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import EgoMotion, EgoPose
from eqrt.runtime.decoding.generic_objects import ListProtection, encode_cycle
from eqrt.runtime.decoding.geodesy import MapOrigin
from eqrt.runtime.decoding.profile import load_profile
from tiny_sensor import DBC, EGO, GEAR, decoder_of, message, profile_of

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


@pytest.mark.parametrize(("gear_s", "speed"), [(4.0, -10.0), (5.0, -10.0), (5.25, 10.0)])
def test_what_is_fresh_is_no_older_than_the_limit_and_not_from_the_future(
    tmp_path: Path, gear_s: float, speed: float
) -> None:
    """After the clock was set back nobody knows how old the gear is; times are exact in binary."""
    gear = message(GEAR, bytes([2]))
    (motion,) = feed(tmp_path, [(gear_s, gear), (5.0, ego(36.0, 36.0))])
    assert isinstance(motion, EgoMotion)
    assert motion.speed_mps == pytest.approx(speed)


def test_standing_still_is_something_to_tell(tmp_path: Path) -> None:
    (motion,) = feed(tmp_path, [(5.0, ego(0.0, 0.0))])
    assert isinstance(motion, EgoMotion)
    assert (motion.speed_mps, motion.yaw_rate_rad_s) == (0.0, 0.0)


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


EXACT, THREE = 0x170, (("A", 0), ("B", 64), ("C", 128))
POSE = """
description = "a pose in the map, with the speed and how old both are"

[[ego]]
bus = "car"
dbc = "tiny.dbc"
messages = { age = "GEAR", pose = "EGO" }
latency_s = 0.25
hold_s = 1.0

[ego.fields]
x = { signal = "pose.LEFT", unit = "m" }
y = { signal = "pose.RIGHT", unit = "m", sign = -1 }
yaw = { signal = "pose.YAW_RATE", unit = "deg" }
speed = "pose.LEFT"
age = { signal = "age.GEAR", unit = "ms" }
"""

EXACT_DBC = (
    f"{DBC}BO_ {EXACT} EXACT: 24 R\n"
    + "".join(f' SG_ {name} : {at}|64@1- (1,0) [0|0] "rad" R\n' for name, at in THREE)
    + "\n"
    + "".join(f"SIG_VALTYPE_ {EXACT} {name} : 2;\n" for name, _ in THREE)
)
PLACE = """
description = "a pose in three numbers that the message has as a float has them"

[[ego]]
bus = "car"
dbc = "tiny.dbc"
messages = { place = "EXACT" }
fields = { latitude = "A", longitude = "B", heading = "C" }
"""
PLACE_IN_MAP = PLACE.replace(
    'latitude = "A", longitude = "B", heading = "C"',
    'x = { signal = "A", unit = "m" }, y = { signal = "B", unit = "m" }, yaw = "C"',
)


def told(folder: Path, *messages: can.Message) -> list[Event]:
    """What the messages tell that come at 8 s."""
    decoder = decoder_of(folder, POSE)
    return [event for one in messages for event in decoder.feed(one, 8.0)]


def test_a_message_may_tell_motion_and_pose_of_one_time(tmp_path: Path) -> None:
    """Measured 250 ms (latency) and 125 ms (age) before it came."""
    motion, pose = told(tmp_path, message(GEAR, bytes([125])), ego(36.0, 20.0, 200.0))
    assert isinstance(motion, EgoMotion)
    assert isinstance(pose, EgoPose)
    assert motion.timestamp_s == pose.timestamp_s == 8.0 - 0.25 - 0.125
    assert motion.speed_mps == pytest.approx(10.0)
    assert motion.yaw_rate_rad_s is None
    assert (pose.map_from_ego.x_m, pose.map_from_ego.y_m) == pytest.approx((36.0, -20.0))
    assert pose.map_from_ego.yaw_rad == pytest.approx(math.radians(-160.0))


def test_without_an_age_only_the_latency_is_taken_off(tmp_path: Path) -> None:
    motion, pose = told(tmp_path, ego(36.0, 20.0))
    assert motion.timestamp_s == pose.timestamp_s == 7.75


@pytest.mark.parametrize(("age_s", "told_s"), [(-1e6, 0.0), (-0.5, 0.0), (0.5, -0.5)])
def test_nothing_is_measured_after_it_came(tmp_path: Path, age_s: float, told_s: float) -> None:
    """A time ahead of all others would cut the dead reckoning off, and with it every track."""
    aged = PLACE_IN_MAP.replace('yaw = "C"', 'yaw = "B", age = { signal = "C", unit = "s" }')
    (pose,) = exact(tmp_path, aged, 1.0, 2.0, age_s)
    assert pose.timestamp_s == told_s


def exact(folder: Path, text: str, *numbers: float) -> list[Event]:
    """What a message with these three numbers tells."""
    decoder = Decoder(profile_of(folder, text, EXACT_DBC))
    return decoder.feed(message(EXACT, struct.pack("<3d", *numbers)), 0.0)


@pytest.mark.parametrize("text", [PLACE, PLACE_IN_MAP])
@pytest.mark.parametrize("without", [(0,), (1,), (2,), (0, 1), (0, 1, 2)])
def test_a_pose_that_lacks_a_number_is_none(
    tmp_path: Path, text: str, without: tuple[int, ...]
) -> None:
    assert len(exact(tmp_path, text, 0.5, 0.25, 0.125)) == 1
    numbers = [math.nan if i in without else 0.5 for i in range(3)]
    assert exact(tmp_path, text, *numbers) == []


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("latitude_rad", "longitude_rad", "is_place"),
    [
        (math.pi / 2, 1.0, True),
        (math.nextafter(math.pi / 2, 2.0), 1.0, False),
        (1.0, math.pi, True),
        (1.0, math.nextafter(math.pi, 4.0), False),
    ],
)
def test_only_places_on_earth_are_told(
    tmp_path: Path, sign: int, latitude_rad: float, longitude_rad: float, is_place: bool
) -> None:
    """The poles are, and the far side of Greenwich."""
    told = exact(tmp_path, PLACE, sign * latitude_rad, sign * longitude_rad, 0.0)
    assert len(told) == is_place


@cache
def sbg_dbc() -> Any:
    return cantools.database.load_file(SBG_DBC)


def sbg_messages(
    latitude_deg: float, longitude_deg: float, heading_rad: float
) -> list[can.Message]:
    """What the INS sends of a fix that is good to 10 cm, from its published DBC."""
    values = {
        "SBG_ECAN_MSG_EKF_EULER": {"ROLL": 0, "PITCH": 0, "YAW": heading_rad},
        "SBG_ECAN_MSG_EKF_POS": {"LATITUDE": latitude_deg, "LONGITUDE": longitude_deg},
        "SBG_ECAN_MSG_EKF_POS_ACC": dict.fromkeys(
            ("LATITUDE_ACC", "LONGITUDE_ACC", "ALTITUDE_ACC"), 0.1
        ),
    }
    definitions = [(sbg_dbc().get_message_by_name(name), value) for name, value in values.items()]
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


@given(
    latitude_deg=st.floats(-80.0, 80.0),
    west_deg=st.floats(-0.2, 0.2),
    east_deg=st.floats(-0.2, 0.2),
    heading_rad=st.floats(0.0, math.tau),
)
def test_poses_at_the_180th_meridian_are_as_at_any_other(
    latitude_deg: float, west_deg: float, east_deg: float, heading_rad: float
) -> None:
    """The same distance from an origin on either side of it as at Greenwich; Fiji lies across."""
    here, there = (
        MapOrigin(math.radians(latitude_deg), longitude_rad(meridian_deg + west_deg)).pose(
            math.radians(latitude_deg), longitude_rad(meridian_deg + east_deg), heading_rad
        )
        for meridian_deg in (0.0, 180.0)
    )
    assert (there.x_m, there.y_m) == pytest.approx((here.x_m, here.y_m), abs=1e-6)
    assert wrap_angle(there.yaw_rad - here.yaw_rad) == pytest.approx(0.0, abs=1e-9)


def longitude_rad(degrees: float) -> float:
    """As an INS tells it: -180 to 180 degrees, in radians."""
    return wrap_angle(math.radians(degrees))


@pytest.mark.parametrize("longitude_deg", [179.9995, -179.9995])
def test_east_stays_east_across_the_180th_meridian(longitude_deg: float) -> None:
    decoder = Decoder(load_profile("sbg-ins"), map_origin_deg=(-16.8, 179.999))
    pose = pose_of(decoder, sbg_messages(-16.8, longitude_deg, heading_rad=math.pi / 2))
    assert pose.x_m == pytest.approx({179.9995: 53.30, -179.9995: 159.90}[longitude_deg], abs=0.02)
    assert pose.yaw_rad == pytest.approx(0.0, abs=1e-4)


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


def test_the_map_may_get_another_origin_under_way() -> None:
    decoder = Decoder(load_profile("sbg-ins"), map_origin_deg=(49.0, 8.4))
    assert decoder.set_map_origin((49.0, 8.401))
    pose = pose_of(decoder, sbg_messages(49.0, 8.402, 0.0))
    assert (pose.x_m, pose.y_m) == pytest.approx((73.17, 0.0), abs=0.02)
    assert decoder.set_map_origin(None)
    pose = pose_of(decoder, sbg_messages(49.2, 8.6, 0.0))
    assert (pose.x_m, pose.y_m) == (0.0, 0.0)


def test_an_origin_is_of_no_use_to_poses_that_are_in_the_map_already() -> None:
    assert not Decoder(load_profile("generic")).set_map_origin((49.0, 8.4))


APART = """
description = "a pose in two messages, with a yaw rate in the first"

[[ego]]
bus = "car"
dbc = "tiny.dbc"
messages = { place = "EGO", yaw = "GEAR" }
hold_s = 1.0

[ego.fields]
x = { signal = "place.LEFT", unit = "m" }
y = { signal = "place.RIGHT", unit = "m" }
yaw = { signal = "yaw.GEAR", unit = "deg" }
yaw_rate = "place.YAW_RATE"
valid = "yaw.GEAR < 200"
"""


def of_poses(folder: Path, *messages: can.Message) -> list[tuple[float, float]]:
    """When the poses were that the messages tell, 10 ms apart from 0 s on, and their x in m."""
    decoder = decoder_of(folder, APART)
    events = [event for i, one in enumerate(messages) for event in decoder.feed(one, i / 100)]
    poses = [event for event in events if isinstance(event, EgoPose)]
    return [(pose.timestamp_s, pose.map_from_ego.x_m) for pose in poses]


def test_a_place_counts_for_one_pose(tmp_path: Path) -> None:
    """Yaws come twice as often as places."""
    yaw = message(GEAR, bytes([90]))
    messages = [ego(1.0, 0.0), yaw, yaw, ego(2.0, 0.0), yaw, yaw]
    assert of_poses(tmp_path, *messages) == [(0.01, 1.0), (0.04, 2.0)]


def test_a_place_that_was_not_valid_makes_no_pose_of_a_later_time(tmp_path: Path) -> None:
    invalid, yaw = message(GEAR, bytes([200])), message(GEAR, bytes([90]))
    messages = [ego(1.0, 0.0), invalid, yaw, ego(2.0, 0.0), yaw]
    assert of_poses(tmp_path, *messages) == [(0.04, 2.0)]


def test_what_is_no_pose_is_held_all_the_same(tmp_path: Path) -> None:
    """Of the message with the place, only that counts once: the yaw rate is told three times."""
    decoder = decoder_of(tmp_path, APART)
    decoder.feed(ego(1.0, 0.0, 9.0), 0.0)
    told = [decoder.feed(message(GEAR, bytes([90])), at_s) for at_s in (0.25, 0.5, 1.0, 1.25)]
    assert [[type(event) for event in events] for events in told] == [
        [EgoMotion, EgoPose],
        [EgoMotion],
        [EgoMotion],
        [],
    ]


NUM_POSES, PERIOD_S, SPEED_MPS = 4, 0.02, 30.0


def sent_poses(profile: str) -> list[can.Message]:
    """Poses of a car on its way east from the map's origin."""
    protection = ListProtection() if profile == "generic-e2e" else None
    messages = []
    for i in range(NUM_POSES):
        x_m, timestamp_s = i * SPEED_MPS * PERIOD_S, i * PERIOD_S
        if profile == "sbg-ins":
            one = sbg_messages(0.0, math.degrees(x_m / 6378137.0), heading_rad=math.pi / 2)
        else:
            one = encode_cycle(
                timestamp_s=timestamp_s, map_from_ego=Pose2(x_m, 0.0, 0.0), protection=protection
            )
        for place, part in enumerate(one):
            part.timestamp = timestamp_s + 0.0003 * place
        messages += one
    return messages


@pytest.mark.parametrize("profile", ["generic", "generic-e2e", "sbg-ins"])
def test_a_pose_is_true_whatever_was_lost(profile: str) -> None:
    """Each message alone, and whatever lies between two of them."""
    known, messages = load_profile(profile), sent_poses(profile)
    per_pose = len(messages) // NUM_POSES
    for begin, end in combinations(range(len(messages) + 1), 2):
        decoder = Decoder(known, map_origin_deg=(0.0, 0.0))
        left = messages[:begin] + messages[end:]
        events = [event for one in left for event in decoder.feed(one, one.timestamp)]
        poses = [event for event in events if isinstance(event, EgoPose)]
        assert len(poses) == begin // per_pose + (len(messages) - end) // per_pose
        for pose in poses:
            true_m = SPEED_MPS * PERIOD_S * round(pose.timestamp_s / PERIOD_S)
            assert pose.map_from_ego.x_m == pytest.approx(true_m, abs=0.02)
