"""`eqrt can check`: right mappings pass, and each kind of wrong one is said in plain words."""

from __future__ import annotations

import itertools
import json
import re
import struct
import xml.etree.ElementTree as ET
from pathlib import Path

import can
import numpy as np
import pytest

from can_recordings import DATA
from eqrt import cli
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.can_check.check import check
from eqrt.runtime.can_check.motion import fit, pairs
from eqrt.runtime.can_check.observation import observe
from eqrt.runtime.can_check.report import Report
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from source_tree import ROOT

DECODING = ROOT / "runtime/eqrt/runtime/decoding"
DEMO = ROOT / "runtime/eqrt/runtime/demo/data/ngsim.log.gz"
LOGS = {
    "ars408": DATA / "ars408/candump.log.gz",
    "toyota-rav4": DATA / "rav4/candump.log.gz",
    "srr520": DATA / "srr520/candump.log.gz",
    "generic": DEMO,
}


def report_of(profile: str, log: Path) -> Report:
    loaded = load_profile(profile)
    return check(loaded, observe(read_log(log), loaded), str(log)).report


def said_about(report: Report) -> str:
    return "\n".join(f"{finding.about}: {finding.text}" for finding in report.findings)


def broken(folder: Path, profile: str, old: str, new: str) -> str:
    """A copy of a built-in profile in which one thing is wrong."""
    text = (DECODING / f"profiles/{profile}.toml").read_text()
    assert text.count(old) == 1, f"{old!r} is there {text.count(old)} times"
    path = folder / f"broken-{profile}.toml"
    path.write_text(text.replace(old, new))
    return str(path)


@pytest.mark.parametrize("profile", list(LOGS))
def test_nothing_looks_wrong_in_a_right_profile(profile: str) -> None:
    report = report_of(profile, LOGS[profile])
    assert report.decoded
    assert said_about(report) == ""


def test_counts_rates_and_gaps_are_those_of_the_log() -> None:
    report = report_of("ars408", LOGS["ars408"])
    rows = {row.name: row for row in report.profile_messages}
    assert rows["Obj_0_Status"].rhythm.count == 2001
    assert rows["Obj_0_Status"].rhythm.median_period_s == pytest.approx(0.0702, abs=1e-4)
    assert rows["Obj_1_General"].rhythm.count == report.sensors[0].objects == 5609
    assert rows["Obj_1_General"].used_by == "ars408"
    assert rows["Obj_2_Quality"].optional
    assert rows["SpeedInformation"].used_by == "ego"
    assert {row.id: row.rhythm.count for row in report.unknown} == {"0x201": 144, "0x700": 144}
    assert report.unknown_rest == (0, 0)
    assert [(c.name, c.known, c.unknown) for c in report.channels] == [("can0", 24590, 288)]


def test_ten_unknown_ids_are_shown_and_the_rest_is_counted() -> None:
    report = report_of("toyota-rav4", LOGS["toyota-rav4"])
    assert len(report.unknown) == 10
    counts = [row.rhythm.count for row in report.unknown]
    assert counts == sorted(counts, reverse=True)
    known = sum(row.rhythm.count for row in report.profile_messages)
    assert known + sum(counts) + report.unknown_rest[1] == report.messages == 98_800


def test_a_gap_and_where_it_is(tmp_path: Path) -> None:
    log = tmp_path / "gap.log"
    times_s = [0.0, 0.05, 0.10, 0.15, 0.65, 0.70]
    log.write_text("".join(f"({100 + t:.6f}) can0 300#0000\n" for t in times_s))
    report = report_of("ars408", log)
    rhythm = next(r for r in report.profile_messages if r.name == "SpeedInformation").rhythm
    assert rhythm.count == 6
    assert rhythm.median_period_s == pytest.approx(0.05)
    assert rhythm.worst_gap_s == pytest.approx(0.5)
    assert rhythm.worst_gap_at_s == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("profile", "old", "new", "said"),
    [
        (
            "toyota-rav4",
            'range_rate = "REL_SPEED"',
            'range_rate = { signal = "REL_SPEED", sign = -1 }',
            r"toyota: distance changes against range_rate .*wrong sign",
        ),
        (
            "toyota-rav4",
            'range_rate = "REL_SPEED"',
            'range_rate = { signal = "REL_SPEED", unit = "km/h" }',
            r"toyota: distance changes by 3\.6 m .*: m/s taken for km/h\?",
        ),
        (
            "toyota-rav4",
            'y = { signal = "LAT_DIST", sign = -1 }',
            'y = "LAT_DIST"',
            r"toyota: when the car turns, .* sign of y",
        ),
        (
            "toyota-rav4",
            'x = "LONG_DIST"',
            'x = { signal = "LONG_DIST", sign = -1 }',
            r"toyota: 100% of the objects are behind",
        ),
        (
            "toyota-rav4",
            'x = "LONG_DIST"',
            'x = { signal = "LONG_DIST", unit = "cm" }',
            r"toyota: distance (does not change as|changes by 0\.0)",
        ),
        (
            "toyota-rav4",
            '"wheels.WHEEL_SPEED_RL"]',
            '"wheels.WHEEL_SPEED_RL"]\nunit = "m/s"',
            r"toyota: .* stand on the ground .* 0\.278 times .*: km/h taken for m/s\?",
        ),
        (
            "toyota-rav4",
            '"wheels.WHEEL_SPEED_RL"]',
            '"wheels.WHEEL_SPEED_RL"]\nunit = "mph"',
            r"toyota: .* stand on the ground .* 0\.622 times .*: km/h taken for mph\?",
        ),
        (
            "toyota-rav4",
            'yaw_rate = "YAW_RATE"',
            'yaw_rate = { signal = "YAW_RATE", sign = -1 }',
            r"toyota: when the car turns, .* of the yaw rate",
        ),
        (
            "toyota-rav4",
            'yaw_rate = "YAW_RATE"',
            'yaw_rate = { signal = "YAW_RATE", unit = "rad/s" }',
            r"ego: speed times yaw rate is .* no tyre holds: degrees taken for radians",
        ),
        (
            "toyota-rav4",
            'message = "TRACK_A_{slot}"\ncounter = "COUNTER"\nchecksum = { kind = "sum8"',
            'message = "TRACK_A_{slot}"\ncounter = "COUNTER"\nchecksum = { kind = "xor8"',
            r"TRACK_A_0, TRACK_A_1, TRACK_A_2, TRACK_A_3 and 12 more: 19\d+ of 19200 fail their",
        ),
        (
            "ars408",
            'velocity_x = "general.Obj_VrelLong"',
            'velocity_x = { signal = "general.Obj_VrelLong", sign = -1 }',
            r"ars408: x changes against velocity_x .*wrong sign",
        ),
        (
            "ars408",
            'y = "general.Obj_DistLat"',
            'y = { signal = "general.Obj_DistLat", sign = -1 }',
            r"ars408: y changes against velocity_y .*wrong sign",
        ),
        (
            "generic",
            'velocity_x = { signal = "motion.VX"',
            'velocity_x = { unit = "km/h", signal = "motion.VX"',
            r"generic: velocities fit .* if divided by 0\.278 .*: m/s taken for km/h\?",
        ),
        (
            "ars408",
            "timeout_s = 0.03 ",
            "timeout_s = 0.0005 ",
            r"ars408: \d+ of 2001 cycles are incomplete: .*timeout_s is too short",
        ),
        (
            "srr520",
            'id = "OBJ{object}_ID"',
            'id = "OBJ{object}_LIFE_CYCLES"',
            r"srr520: 18 of 40 objects are left out: .* share their `id`",
        ),
        (
            "generic",
            'velocity = "absolute"',
            'velocity = "relative"',
            r'generic: velocities fit .* better as velocity = "absolute"',
        ),
        (
            "generic",
            'speed = { signal = "SPEED"',
            'speed = { unit = "km/h", signal = "SPEED"',
            r"ego: the poses change by 3\.61 of what the speed says: m/s taken for km/h\?",
        ),
        (
            "generic",
            'yaw = "yaw.YAW"',
            'yaw = { signal = "yaw.QUALITY", unit = "rad" }',
            r"ego: the poses do not change as the yaw rate says",
        ),
        (
            "generic",
            "hold_s = 0.02 ",
            "hold_s = 0.0001 ",
            r"ego: there is no pose, although EGO_YAW came: .*hold_s is shorter than",
        ),
        (
            "ars408",
            'speed = "RadarDevice_Speed"',
            'speed = { signal = "RadarDevice_Speed", when = "RadarDevice_Speed > 1000" }',
            r"ego: there is no speed, although SpeedInformation came: `valid` or `when` never",
        ),
        (
            "generic",
            'yaw_rate = { signal = "YAW_RATE"',
            'yaw_rate = { sign = -1, signal = "YAW_RATE"',
            r"generic: when the car turns, .* of the yaw rate",
        ),
    ],
)
def test_a_broken_mapping_is_named(
    tmp_path: Path, profile: str, old: str, new: str, said: str
) -> None:
    report = report_of(broken(tmp_path, profile, old, new), LOGS[profile])
    assert re.search(said, said_about(report)), said_about(report)


def test_what_is_damaged_is_not_blamed_on_a_condition(tmp_path: Path) -> None:
    profile = broken(
        tmp_path,
        "toyota-rav4",
        'message = "KINEMATICS"\nchecksum = { kind = "sum8"',
        'message = "KINEMATICS"\nchecksum = { kind = "xor8", byte = 0',
    )
    said = said_about(report_of(profile, LOGS["toyota-rav4"]))
    assert re.search(r"KINEMATICS: 4\d+ of 4974 fail their checksum", said), said
    assert "there is no yaw rate" not in said


def test_the_wrong_byte_order_is_named(tmp_path: Path) -> None:
    """LONG_DIST read as little-endian: its high byte is then another signal's."""
    dbc = (DECODING / "dbc/opendbc/toyota_adas.dbc").read_text(encoding="latin-1")
    wrong, times = re.subn(r"(SG_ LONG_DIST : )15\|15@0\+", r"\g<1>8|15@1+", dbc)
    assert times == 16
    (tmp_path / "wrong.dbc").write_text(wrong, encoding="latin-1")
    profile = broken(
        tmp_path, "toyota-rav4", 'dbc = "opendbc/toyota_adas.dbc"', 'dbc = "wrong.dbc"'
    )
    said = said_about(report_of(profile, LOGS["toyota-rav4"]))
    assert re.search(r"toyota: \d+% of the steps .*byte order", said), said


def test_a_sensor_with_other_ids_is_found(tmp_path: Path) -> None:
    profile = broken(
        tmp_path, "ars408", 'name = "ars408"', 'name = "ars408"\narbitration_id_offset = 0x10'
    )
    report = report_of(profile, LOGS["ars408"])
    assert "ars408: none of its messages came: Obj_0_Status (0x61A)" in said_about(report)
    assert "ars408: the same pattern of ids is there 0x10 lower: add -16 " in said_about(report)
    assert report.decoded  # the ego's speed and yaw rate are


def test_the_ids_of_the_ego_are_no_sensor_with_other_ids() -> None:
    """A car that sends 0x300 and 0x301, and a radar that is off: 0x60A and 0x60B it is not."""
    profile = load_profile("ars408")
    car = [m for m in itertools.islice(read_log(LOGS["ars408"]), 500) if m.arbitration_id < 0x302]
    said = said_about(check(profile, observe(car, profile), "drive.log").report)
    assert "ars408: none of its messages came: Obj_0_Status" in said
    assert "the same pattern of ids" not in said


def test_the_wrong_profile_decodes_nothing_and_the_status_says_so(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["can", "check", str(LOGS["ars408"]), "--profile", "sbg-ins"]) == 1
    said = capsys.readouterr().out
    assert "NOTHING DECODED" in said
    assert "ego: none of its messages came: " in said


def test_another_channel_is_not_read(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["can", "check", str(LOGS["ars408"]), "--profile", "ars408", "--can", "can7"]
    assert cli.main(arguments) == 1
    assert "wrong_bus 24590" in capsys.readouterr().out


def test_a_bus_on_another_channel_than_was_asked_for_is_named() -> None:
    profile = load_profile("toyota-rav4")
    asked = {"radar": "can1", "car": "can7"}
    log = read_log(LOGS["toyota-rav4"])
    report = check(profile, observe(log, profile, asked), "drive.log", asked).report
    said = said_about(report)
    assert "car: its messages come on can0, and none on can7: is it --can car=can0?" in said
    assert "radar: " not in said


@pytest.mark.parametrize("asked", [None, {"radar": "can1"}])
def test_messages_on_two_channels_are_named_where_none_was_asked_for(
    asked: dict[str, str | int] | None, tmp_path: Path
) -> None:
    once = read_log(LOGS["ars408"])
    lines = [
        f"({message.timestamp:.6f}) {name} {message.arbitration_id:03X}#{message.data.hex()}\n"
        for message in itertools.islice(once, 500)
        for name in ("can0", "can1")
    ]
    (tmp_path / "both.log").write_text("".join(lines))
    profile = load_profile("ars408")
    seen = observe(read_log(tmp_path / "both.log"), profile, asked)
    said = said_about(check(profile, seen, "both.log", asked).report)
    assert ("Obj_3_Extended and 2 more: on can0 and can1, " in said) == (asked is None)
    assert said.count("can0 and can1") == (asked is None)


@pytest.mark.parametrize("speed_mps", [0.0, 5.0])
def test_a_car_that_stands_need_not_turn(speed_mps: float) -> None:
    profile = load_profile("generic")
    messages = [
        message
        for i in range(50)
        for message in encode_cycle(
            timestamp_s=0.1 * i, counter=i, speed_mps=speed_mps, yaw_rate_rad_s=0.0
        )
    ]
    said = said_about(check(profile, observe(messages, profile), "drive.log").report)
    assert ("the yaw rate is always 0 deg/s" in said) == bool(speed_mps)


def test_a_log_of_two_goes_back_once_and_one_without_times_is_named() -> None:
    profile = load_profile("ars408")
    messages = list(itertools.islice(read_log(LOGS["ars408"]), 500))
    twice = observe([*messages, *messages], profile)
    assert "log: its clock goes back once: " in said_about(check(profile, twice, "log").report)
    at_once = [can.Message(0.0, m.arbitration_id, False, data=m.data) for m in messages]
    seen = observe(at_once, profile)
    said = said_about(check(profile, seen, "log").report)
    assert "log: all its messages carry the same time: " in said


def test_the_report_as_text_json_and_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found, pictures = tmp_path / "found.json", tmp_path / "pictures"
    arguments = ["can", "check", str(LOGS["toyota-rav4"]), "--profile", "toyota-rav4"]
    assert cli.main([*arguments, "--json", str(found), "--plot", str(pictures)]) == 0
    said = capsys.readouterr().out
    assert "Sensor toyota: 1200 cycles (0 incomplete), period 49.9 ms" in said
    assert "  mount x 3.5 m, y 0 m, yaw 0 degrees, as the profile says; " in said
    assert "and 96 more ids" in said
    values = json.loads(found.read_text())
    assert values["schema"] == 1
    assert values["sensors"][0]["objects"] == 10_100
    names = ["ego", "toyota-places", "toyota-range", "toyota-velocity"]
    assert sorted(path.stem for path in pictures.iterdir()) == names
    for name in names:
        assert f"drawn: {pictures / name}.svg" in said
        root = ET.fromstring((pictures / f"{name}.svg").read_text())
        drawn = [path.get("d", "") for path in root.iter("{http://www.w3.org/2000/svg}path")]
        assert max(map(len, drawn)) > 1_000, name


def test_places_are_drawn_ahead_up_and_left_to_the_left(tmp_path: Path) -> None:
    """One object ahead on the left, and the sensor: it is above and left of it."""
    log = tmp_path / "one.log"
    x, y = round((40.0 + 500.0) / 0.2), round((10.0 + 204.6) / 0.2)
    bits = (7 << 56) | (x << 43) | (y << 32) | (512 << 22) | (256 << 12)
    log.write_text(f"(1.000000) can0 60A#01000010\n(1.001000) can0 60B#{bits:016X}\n")
    pictures = tmp_path / "pictures"
    arguments = ["can", "check", str(log), "--profile", "ars408", "--plot", str(pictures)]
    assert cli.main(arguments) == 0
    text = (pictures / "ars408-places.svg").read_text()
    clipped = text.partition("clip-path=")[2].partition("</g>")[0]
    objects, sensor = re.findall(r'd="M([\d.]+),([\d.]+)h0"', clipped)
    assert float(objects[0]) < float(sensor[0])
    assert float(objects[1]) < float(sensor[1])


def test_a_file_that_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["can", "check", str(LOGS["srr520"]), "--profile", "srr520"]
    assert cli.main([*arguments, "--json", str(tmp_path / "no/file.json")]) == 1
    assert capsys.readouterr().err.startswith("eqrt: cannot write ")


@pytest.mark.parametrize("name", ["front/left", "../front", "/front"])
def test_the_pictures_of_a_sensor_stay_in_the_folder(name: str, tmp_path: Path) -> None:
    profile = broken(tmp_path, "ars408", 'name = "ars408"', f'name = "{name}"')
    pictures = tmp_path / "pictures"
    arguments = ["can", "check", str(LOGS["ars408"]), "--profile", profile]
    assert cli.main([*arguments, "--plot", str(pictures)]) == 0
    assert len(list(pictures.iterdir())) == 4
    assert all(path.name.endswith(".svg") for path in pictures.iterdir())


def test_two_tracks_are_never_compared_with_each_other() -> None:
    time_s = np.array([0.0, 0.5, 1.0, 0.0, 0.5, 1.0])
    track = np.array([0, 0, 0, 1, 1, 1])
    place = np.array([0.0, 1.0, 2.0, 50.0, 49.0, 48.0])
    said = np.array([2.0, 2.0, 2.0, -2.0, -2.0, -2.0])
    found = pairs(time_s, track, place, said)
    np.testing.assert_allclose(found.changed, [2.0, 2.0, -2.0, -2.0])
    np.testing.assert_allclose(found.said, found.changed)
    one = fit("x", found)
    assert (one.pairs, one.slope, one.correlation, one.residual) == (4, 1.0, 1.0, 0.0)


def test_a_gap_in_what_is_said_leaves_its_pairs_out() -> None:
    time_s = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    said = np.array([1.0, np.nan, 1.0, 1.0, 1.0])
    found = pairs(time_s, np.zeros(5, np.int64), time_s, said)
    np.testing.assert_allclose(found.said, [1.0])


DOUBLES = """VERSION ""
BU_: X
BO_ 256 OBJECT: 32 X
 SG_ X : 0|64@1- (1,0) [0|0] "m" X
 SG_ Y : 64|64@1- (1,0) [0|0] "m" X
 SG_ VX : 128|64@1- (1,0) [0|0] "m/s" X
 SG_ VY : 192|64@1- (1,0) [0|0] "m/s" X
BO_ 257 EGO: 16 X
 SG_ SPEED : 0|64@1- (1,0) [0|0] "m/s" X
 SG_ YAW_RATE : 64|64@1- (1,0) [0|0] "rad/s" X
SIG_VALTYPE_ 256 X : 2;
SIG_VALTYPE_ 256 Y : 2;
SIG_VALTYPE_ 256 VX : 2;
SIG_VALTYPE_ 256 VY : 2;
SIG_VALTYPE_ 257 SPEED : 2;
SIG_VALTYPE_ 257 YAW_RATE : 2;
"""
DOUBLES_PROFILE = """description = "doubles"
[[sensor]]
name = "doubles"
bus = "car"
dbc = "doubles.dbc"
framing = "single"
velocity = "relative"
messages = { object = "OBJECT" }
fields = { x = "X", y = "Y", velocity_x = "VX", velocity_y = "VY" }
[[ego]]
bus = "car"
dbc = "doubles.dbc"
messages = { ego = "EGO" }
fields = { speed = "SPEED", yaw_rate = "YAW_RATE" }
"""


@pytest.mark.parametrize("number", [1e308, 1e160, 1e18])
@pytest.mark.parametrize("alternates", [False, True])
def test_numbers_beyond_all_measure_are_found_and_drawn(
    *, number: float, alternates: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What doubles in the wrong byte order look like."""
    (tmp_path / "doubles.dbc").write_text(DOUBLES)
    (tmp_path / "doubles.toml").write_text(DOUBLES_PROFILE)
    lines = []
    for i in range(100):
        value = -number if alternates and i % 2 else number
        for arbitration_id, count in ((256, 4), (257, 2)):
            data = struct.pack(f"<{count}d", *[value] * count).hex()
            lines.append(f"({0.05 * i:.6f}) can0 {arbitration_id:X}##0{data}\n")
    log, found, pictures = tmp_path / "drive.log", tmp_path / "found.json", tmp_path / "pictures"
    log.write_text("".join(lines))
    arguments = ["can", "check", str(log), "--profile", str(tmp_path / "doubles.toml")]
    assert cli.main([*arguments, "--json", str(found), "--plot", str(pictures)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"doubles: 5 % of the objects are more than 1\.41e\+\d\d m away", said), said
    assert re.search(r"ego: the speed goes from -?1e\+\d\d to 1e\+\d\d m/s: is the unit", said), (
        said
    )
    assert max(map(len, said.splitlines())) < 200
    assert json.loads(found.read_text())["sensors"][0]["objects"] == 100
    texts = [path.read_text() for path in pictures.iterdir()]
    assert len(texts) == 4
    assert max(len(label) for text in texts for label in re.findall(r">([-\d.,e+]+)<", text)) < 12
