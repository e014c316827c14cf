"""Profiles: what is built in loads, what is wrong is refused by one line that says where."""

from __future__ import annotations

import math
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding import profile, profile_schema
from eqrt.runtime.decoding.profile import builtin_profiles, load_profile
from tiny_sensor import COUNTED, DBC, SENSOR, SLOTS, profile_of


@pytest.mark.parametrize("name", builtin_profiles())
def test_a_built_in_profile_loads_by_its_name(name: str) -> None:
    loaded = load_profile(name)
    assert loaded.name == name
    assert loaded.description
    assert loaded.sensors or loaded.ego


def test_the_sensors_we_promise_are_built_in() -> None:
    assert {"ars408", "generic", "srr520", "toyota-rav4"} <= set(builtin_profiles())


def test_two_sources_of_latitude_and_longitude_are_refused(tmp_path: Path) -> None:
    ego = (
        '[[ego]]\nbus = "car"\ndbc = "tiny.dbc"\nmessages = { p = "POLAR" }\n'
        'fields = { latitude = "ANGLE", longitude = "ANGLE", heading = "ANGLE" }\n'
    )
    with pytest.raises(ProfileError, match=r"more than one \[\[ego\]\] gives latitude and long"):
        profile_of(tmp_path, 'description = "two"\n' + ego + ego)


MOTION = """
[[ego]]
bus = "car"
dbc = "tiny.dbc"
messages = { ego = "EGO" }
latency_s = MOTION_S
fields = { speed = "LEFT", yaw_rate = "YAW_RATE" }
"""
POSE = """
[[ego]]
bus = "car"
dbc = "tiny.dbc"
messages = { pose = "EGO" }
latency_s = POSE_S

[ego.fields]
x = { signal = "LEFT", unit = "m" }
y = { signal = "RIGHT", unit = "m" }
yaw = { signal = "YAW_RATE", unit = "deg" }
"""


def late(sensor_s: float, motion_s: float | None = None, pose_s: float | None = None) -> str:
    """A profile whose sources have these latencies; None = there is none."""
    text = COUNTED.replace("timeout_s", f"latency_s = {sensor_s}\ntimeout_s", 1)
    text += "" if motion_s is None else MOTION.replace("MOTION_S", str(motion_s))
    return text + ("" if pose_s is None else POSE.replace("POSE_S", str(pose_s)))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (late(1.0), "sensor[0]: latency_s is 1.0, expected 0 to below 1: older input is not used"),
        (late(math.nan), "sensor[0]: latency_s is nan, expected 0 to below 1"),
        (late(-0.1), "sensor[0]: latency_s is -0.1, expected 0 to below 1"),
        (late(0.9, 1.5), "ego[0]: latency_s is 1.5, expected 0 to below 1: older input is not"),
        (
            late(0.0, 0.25),
            "ego[0]: latency_s is 0.25, expected at most 0.2: the sensor 'tiny' has latency_s = 0, "
            "and the ego motion is extrapolated for 0.2 s at most",
        ),
        (late(0.1, 0.31), "ego[0]: latency_s is 0.31, expected at most 0.3: the sensor 'tiny' has"),
        (late(0.0, None, 0.25), "ego[0]: latency_s is 0.25, expected at most 0.2: the sensor"),
        (
            late(0.0, 0.1, 0.55),
            "ego[1]: latency_s is 0.55, expected at most 0.5: the sensor 'tiny' has latency_s = 0, "
            "and a pose is believed for 0.5 s at most",
        ),
    ],
)
def test_a_latency_that_can_never_work_is_refused(
    tmp_path: Path, text: str, complaint: str
) -> None:
    with pytest.raises(ProfileError) as refusal:
        profile_of(tmp_path, text)
    assert f"tiny.toml: {complaint}" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "latencies",
    [
        pytest.param((0.99,), id="the sensor alone"),
        pytest.param((0.0, 0.2), id="the ego motion, as long as it is extrapolated"),
        pytest.param((0.7, 0.9), id="as much later as the sensor"),
        pytest.param((0.0, 0.0, 0.5), id="a pose to which dead reckoning adds"),
        pytest.param((0.3, None, 0.5), id="a pose alone"),
    ],
)
def test_a_latency_that_may_work_is_taken(
    tmp_path: Path, latencies: tuple[float | None, ...]
) -> None:
    loaded = profile_of(tmp_path, late(*latencies))  # type: ignore[arg-type]  # the first is a number
    found = [loaded.sensors[0].latency_s, *(ego.latency_s for ego in loaded.ego)]
    assert found == [latency_s for latency_s in latencies if latency_s is not None]


def test_a_profile_is_loaded_from_a_path(tmp_path: Path) -> None:
    loaded = profile_of(tmp_path, SLOTS)
    assert loaded.name == "tiny"
    assert loaded.sensor("tiny").slots == (0, 1, 2, 3)
    assert not loaded.has_ego


def test_roles_are_the_buses_that_the_profile_speaks_of() -> None:
    assert load_profile("toyota-rav4").roles == ("radar", "car")
    assert load_profile("generic").roles == ("car",)


def test_the_mount_is_ego_from_sensor_in_radians(tmp_path: Path) -> None:
    mount = 'mount = { x_m = 3.5, y_m = -0.5, yaw_deg = 180.0 }\nframing = "slots"'
    sensor = profile_of(tmp_path, SLOTS.replace('framing = "slots"', mount)).sensor("tiny")
    assert (sensor.mount.x_m, sensor.mount.y_m) == (3.5, -0.5)
    assert sensor.mount.yaw_rad == pytest.approx(3.14159265)


def test_id_offsets_move_sensor_and_ego(tmp_path: Path) -> None:
    moved = 'description = "moved"\narbitration_id_offset = 0x20\n' + (
        COUNTED.replace('description = "a tiny sensor"', "").replace(
            "timeout_s", "arbitration_id_offset = 0x200\ntimeout_s"
        )
        + '[[ego]]\nbus = "car"\ndbc = "tiny.dbc"\nmessages = { ego = "EGO" }\n'
        + 'fields = { yaw_rate = "YAW_RATE" }\n'
    )
    assert profile_of(tmp_path, moved).arbitration_ids == {0x320, 0x330, 0x340, 0x170}


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("timeout_s", "timeout", "sensor[0]: unknown key 'timeout'; the keys are name, bus, dbc"),
        (
            "count =",
            "cuont =",
            "sensor[0].header: unknown key 'cuont'; the keys are message, count",
        ),
        ("sign = -1", "sing = -1", "sensor[0].fields.y: unknown key 'sing'; the keys are signal"),
        ("optional = true", "optional = 1", "sensor[0].messages.second.optional is 1, expected tr"),
        ("sign = -1", "sign = 2", "sensor[0].fields.y.sign is 2, expected 1 or -1"),
        ("timeout_s = 0.1", 'timeout_s = "1"', "sensor[0].timeout_s is '1', expected a number"),
        ("timeout_s = 0.1", "timeout_s = 100", "timeout_s is 100.0, expected above 0 to 10"),
        ('"counted"', '"count"', "framing is 'count', expected 'counted' or 'slots' or 'single'"),
        ('framing = "counted"', "", "the key sensor[0].framing is missing"),
        ('name = "tiny"', 'name = ["tiny"]', "sensor[0].name is a list, expected a string"),
        ("[sensor.header]", "[sensor.objects]", "sensor[0].objects: unknown key 'message'"),
        (
            'count = "COUNT"',
            "",
            'framing = "counted" needs a [sensor.header] with message and coun',
        ),
        ('"counted"', '"slots"', 'framing = "slots" needs slots = { first = ..., last = ... }'),
        ('velocity = "radial"', "", 'velocity = "none" goes with no velocity field'),
        (
            '"radial"',
            '"relative"',
            'velocity = "relative" goes with fields.velocity_x or velocity_y',
        ),
        ('x = "first.X"', "", "fields must have a position: x and y, or range and azimuth"),
        ('id = "ID"', "", 'framing = "counted" has no slots; fields.id must name a signal'),
        ('"tiny.dbc"', '"tyni.dbc"', "there is no DBC 'tyni.dbc' beside the profile, nor built in"),
        ("SECOND_0", "SECOND_O", "tiny.dbc has no message 'SECOND_O'; it has SECOND_"),
        ("SECOND_0", "FIRST_00", "sensor[0]: the message FIRST_00 is named more than once"),
        ("first.X", "first.Z", "fields.x: the message FIRST_00 has no signal 'Z'; it has"),
        (
            "first.X",
            "third.X",
            "fields.x: there is no message 'third' here; there is first, second",
        ),
        ("first.X", "X", "fields.x: say which message 'X' is in, for example 'first.X'"),
        ("first.X", "first.ID", "fields.x: the DBC gives first.ID no unit; add unit = one of 'm'"),
        ("first.X", "first.RATE", "fields.x: the DBC gives first.RATE the unit 'm/s'; add unit ="),
        (
            "sign = -1",
            'unit = "deg"',
            "fields.y: unit 'deg' is no length; known are 'm', 'cm', 'mm'",
        ),
        ("STATE == 1", "STATE = 1", "fields.new_track: 'first.STATE = 1' is not a condition: expe"),
        ("STATE != 0", "STAT != 0", "fields.valid: the message FIRST_00 has no signal 'STAT'"),
        ('"second.SCORE"', "{ signal = 'second.SCORE', table = { 999 = 1.0 } }", "is never 999"),
        ('"second.SCORE"', "{ signal = 'second.SCORE', table = { a = 1.0 } }", "is not an integer"),
        ("optional = true", 'checksum = { kind = "md5" }', "kind is 'md5', expected 'sum8' or"),
        (
            "timeout_s",
            "arbitration_id_offset = -288\ntimeout_s",
            "makes -0x20 of LIST's id 0x100",
        ),
        ("description =", "yaw_rate_bias_deg_s = 99\ndescription =", "yaw_rate_bias_deg_s is 99"),
    ],
)
def test_a_wrong_profile_is_refused_by_one_line_that_says_where(
    tmp_path: Path, old: str, new: str, complaint: str
) -> None:
    assert old in COUNTED
    with pytest.raises(ProfileError) as refusal:
        profile_of(tmp_path, COUNTED.replace(old, new, 1))
    text = str(refusal.value)
    assert complaint in text
    assert "tiny.toml" in text
    assert "\n" not in text


def test_a_class_that_does_not_exist_is_refused_with_those_that_do(tmp_path: Path) -> None:
    table = '[sensor.fields.class]\nsignal = "first.STATE"\ntable = { 1 = "lorry" }\n'
    with pytest.raises(ProfileError, match="no class 'lorry'; there are unknown, car, truck"):
        profile_of(tmp_path, COUNTED + table)


def test_slots_that_are_laid_out_differently_are_refused(tmp_path: Path) -> None:
    """One decode serves all slots."""
    other = DBC.replace("FIRST_02: 8 R\n SG_ X : 0|16@1-", "FIRST_02: 8 R\n SG_ X : 0|16@1+")
    with pytest.raises(ProfileError, match="'X' is not laid out alike in every slot"):
        profile_of(tmp_path, SLOTS, other)


def test_two_sensors_of_one_name_are_refused(tmp_path: Path) -> None:
    again = SLOTS + SLOTS.replace('description = "a tiny sensor"', "")
    with pytest.raises(ProfileError, match="more than one sensor has the name 'tiny'"):
        profile_of(tmp_path, again)


def test_an_unknown_profile_is_refused_with_those_that_are_built_in() -> None:
    with pytest.raises(ProfileError, match=r"there is no profile 'ars404'; built in are ars408, "):
        load_profile("ars404")


def test_a_path_to_nowhere_is_refused() -> None:
    with pytest.raises(ProfileError, match=r"there is no profile '/no/such/file.toml'"):
        load_profile("/no/such/file.toml")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_files_of_any_editor_are_read(encoding: str, tmp_path: Path) -> None:
    """With a mark before them, and a degree sign in UTF-8 or in the DBC format's own encoding."""
    dbc = DBC.replace('"deg"', '"\N{DEGREE SIGN}"')
    (tmp_path / "tiny.dbc").write_text(dbc, encoding=encoding)
    toml = "utf-8" if encoding == "cp1252" else encoding
    polar = f"""{SENSOR}
framing = "single"
messages = {{ polar = "POLAR" }}
fields = {{ range = {{ signal = "RANGE", unit = "m" }}, azimuth = "ANGLE" }}
"""
    (tmp_path / "profile.toml").write_text(polar, encoding=toml)
    assert load_profile(str(tmp_path / "profile.toml")).sensors[0].name == "tiny"


@pytest.mark.parametrize("text", ["description = ", "a = 1\na = 2", "\x00", "description = 'x"])
def test_a_file_that_is_not_toml_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ProfileError, match=r"tiny.toml is not TOML: "):
        profile_of(tmp_path, text)


def test_a_profile_without_sensor_and_ego_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match=r"neither a \[\[sensor\]\] nor an \[\[ego\]\]"):
        profile_of(tmp_path, 'description = "nothing"')


@pytest.mark.parametrize("dbc", ["", "hello", "\x00\xff", "BO_TX_BU_ 1 : R;", 'VERSION "BO_"'])
def test_a_dbc_without_a_message_is_refused(tmp_path: Path, dbc: str) -> None:
    with pytest.raises(
        ProfileError, match=r"the DBC .*tiny\.dbc describes no message; is it a DBC"
    ):
        profile_of(tmp_path, SLOTS, dbc)


def test_a_dbc_that_does_not_parse_is_refused_by_one_line_that_says_where(tmp_path: Path) -> None:
    lines = ["", 'CM_ "some\nlines";', *DBC.splitlines()]
    number = next(i for i, line in enumerate(lines) if "16|16@1-" in line)
    lines[number] = lines[number].replace("16|16@1-", "16|16@x-")
    place = rf"line {number + 2}, column {lines[number].index('x-') + 1}"
    with pytest.raises(ProfileError, match=rf"the DBC .*tiny\.dbc does not parse: .*{place}") as no:
        profile_of(tmp_path, SLOTS, "\n".join(lines))
    assert "\n" not in str(no.value)


def test_a_dbc_with_a_broken_comment_is_used_without_it(tmp_path: Path) -> None:
    """Published DBCs have such comments and value tables; where the bits lie is not in doubt."""
    broken = DBC + 'CM_ SG_ 272 "no signal named";\nVAL_ 999 NOBODY 0 "nothing" ;\n'
    assert profile_of(tmp_path, SLOTS, broken).arbitration_ids == {
        *range(0x110, 0x114),
        *range(0x120, 0x124),
    }


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ("{}", "fields must have speed, yaw_rate, or a pose"),
        ('{ x = "LEFT", y = "LEFT" }', "a pose needs x, y, yaw, and fields has only some of"),
        ('{ latitude = "LEFT" }', "a pose needs latitude, longitude, heading, and fields has"),
        ('{ reverse = "LEFT < 0", yaw_rate = "YAW_RATE" }', "turns fields.speed around, which is"),
        ("{ speed = { mean = [] } }", "fields.speed: mean is empty; name the signals"),
        ('{ speed = "YAW_RATE" }', "fields.speed: the DBC gives YAW_RATE the unit 'deg/s'; add"),
        ("{ speed = 3 }", "ego[0].fields.speed is 3, expected a string"),
    ],
)
def test_a_wrong_ego_is_refused(tmp_path: Path, fields: str, complaint: str) -> None:
    ego = f'[[ego]]\nbus = "car"\ndbc = "tiny.dbc"\nmessages = {{ e = "EGO" }}\nfields = {fields}\n'
    with pytest.raises(ProfileError) as refusal:
        profile_of(tmp_path, 'description = "ego"\n' + ego)
    assert complaint in str(refusal.value)


def test_a_sensor_template_names_its_slots(tmp_path: Path) -> None:
    """`{slot}` counts in decimal, `{slot:02d}` and `{slot:X}` as they say."""
    text = SENSOR + 'framing = "slots"\nslots = { first = 1, last = 2 }\n'
    text += 'messages = { one = "FIRST_0{slot}", two = "FIRST_{slot:02X}" }\n'
    text += 'fields = { x = "one.X", y = "one.Y" }\n'
    with pytest.raises(ProfileError, match="the message FIRST_01 is named more than once"):
        profile_of(tmp_path, text)


DOCS = Path(__file__).parents[2] / "docs" / "profiles.md"


def test_the_page_about_profiles_has_every_key() -> None:
    text = DOCS.read_text()
    tables = [
        kind
        for kind in vars(profile_schema).values()
        if isinstance(kind, type) and is_dataclass(kind)
    ]
    keys = {field.metadata.get("key", field.name) for kind in tables for field in fields(kind)}
    shown = set(re.findall(r"\w+", text))
    assert sorted(keys - shown) == []


def test_the_page_about_profiles_shows_profiles_that_load(tmp_path: Path) -> None:
    """The ARS408's and the generic one, which is the built-in one to the letter."""
    blocks = re.findall(r"```toml\n(.*?)```", DOCS.read_text(), re.DOTALL)
    ars408, generic = (block for block in blocks if block.startswith("description"))
    assert profile_of(tmp_path, ars408).sensors[0].framing == "counted"
    built_in = Path(profile.__file__).parent / "profiles" / "generic.toml"
    assert built_in.read_text().endswith(generic)


def test_the_page_about_profiles_lists_the_built_in_ones() -> None:
    listed = re.findall(r"^\| `([a-z0-9-]+)` \|", DOCS.read_text(), re.MULTILINE)
    assert set(builtin_profiles()) <= set(listed)
