"""A recording brings its profile along, whatever that calls its DBCs, and no other file counts."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path

import pytest
from mcap.writer import Writer

from drives import TILE, shipped_predictor
from eqrt.cli import main
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.decoding import toml_tables
from eqrt.runtime.decoding.profile import load_profile, profile_files
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.recording.identity import identity_of
from eqrt.runtime.recording.reader import Recording, read_recordings
from eqrt.runtime.recording.topics import FORMAT_VERSION, IDENTITY, PROFILE
from processes import Heard, Serving, eqrt
from recorded_drives import CHANNELS, patiently
from tiny_sensor import COUNTED, DBC, first, header

PROFILES = {
    "beside the profile": ("own.toml", "tiny.dbc"),
    "in a neighbouring folder": ("own.toml", "../dbc/tiny.dbc"),
    "by an absolute path": ("own.toml", "{folder}/dbc/tiny.dbc"),
    "of a profile with another ending": ("own.cfg", "../dbc/tiny.dbc"),
    "of a profile with a long name": ("o" * 240 + ".toml", "../dbc/tiny.dbc"),
}


def write_profile(folder: Path, name: str, dbc: str) -> Path:
    """With the DBC beside the profile and in the folder `dbc` next to it."""
    for where in ("profiles", "dbc"):
        (folder / where).mkdir(parents=True)
        (folder / where / "tiny.dbc").write_text(DBC)
    profile = folder / "profiles" / name
    profile.write_text(COUNTED.replace("tiny.dbc", dbc.format(folder=folder)))
    return profile


@pytest.mark.parametrize("where", PROFILES)
def test_a_drive_is_replayed_wherever_its_dbc_was_and_whatever_became_of_it(
    where: str, tmp_path: Path
) -> None:
    """To the last bit, when profile and DBC have been changed, and when they are gone."""
    profile = write_profile(tmp_path / "setup", *PROFILES[where])
    recorded = tmp_path / "rec"
    record(profile, recorded)
    (recording,) = read_recordings(recorded)
    said = b"".join(map(json_lines, recording.forecasts()))
    assert said.count(b"\n") > 5
    for dbc in (tmp_path / "setup").rglob("*.dbc"):
        dbc.write_text(DBC.replace("(0.01,0)", "(0.02,0)"))
    assert replayed(recorded, tmp_path) == said
    changed = replayed(recorded, tmp_path, "--profile", str(profile))
    assert changed.count(b"\n") > 5
    assert changed != said
    shutil.rmtree(tmp_path / "setup")
    assert replayed(recorded, tmp_path) == said


def record(profile: Path, folder: Path) -> None:
    """Two seconds of one object, by the service."""
    channel = next(CHANNELS)
    bus = ["--can", channel, "--can-interface", LOCAL, "--profile", str(profile), "--stationary"]
    with (
        Heard(channel, []) as heard,
        Serving(*bus, "--datagrams", heard.address, "--record", str(folder)) as service,
        open_bus(channel, LOCAL, receive_ids=[]) as sender,
    ):
        for counter in range(20):
            sender.send(header(1, counter % 16))
            sender.send(first(20.0, 1.0, 3, counter=counter % 16))
            time.sleep(0.1)
        patiently(lambda: sum(one.num_targets for one in heard.forecasts) > 5)
        assert service.end()[0] == 0


def replayed(folder: Path, work: Path, *options: str) -> bytes:
    out = work / "replayed.jsonl"
    done = eqrt("replay", str(folder), "--out", str(out), *options)
    assert done.returncode == 0, done.stderr
    return out.read_bytes()


# --- recordings that nobody recorded


def write_recording(path: Path, attached: Mapping[str, bytes], tile_id: str = "") -> Path:
    """One of nothing, with files in it; its profile is `own`."""
    pipeline = Pipeline(load_profile("generic"), shipped_predictor())
    identity = identity_of(pipeline, model_folder=path, channels=None, stationary=True)
    more = {"format": str(FORMAT_VERSION), "run": "00c0ffee", "part": "0", "profile": "own"}
    tile = {"tile": "a.tile", "tile_id": tile_id} if tile_id else {}
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(PROFILE, "by hand")
        writer.add_metadata(IDENTITY, identity | more | tile)
        for name, content in attached.items():
            writer.add_attachment(0, 1, name, "text/plain", content)
        writer.finish()
    return path


def own(dbc: str = "tiny.dbc") -> bytes:
    return COUNTED.replace("tiny.dbc", dbc).encode()


WELL = {"profile/own.toml": own(), "profile/tiny.dbc": DBC.encode()}


def assert_replayed(capsys: pytest.CaptureFixture[str], file: Path, *options: str) -> None:
    """All in it can be used. It holds no messages, and that is all there is to complain of."""
    assert main(["replay", str(file), "--out", "/dev/null", *options]) == 1
    complaint = capsys.readouterr().err.splitlines()[-1]
    assert complaint == "eqrt: no predictions: there are no messages in it"


@pytest.mark.parametrize(
    "name", ["profile", "profile/", "p" * 300, ".", "/", "../../evil", "profile/../../evil", "a\nb"]
)
def test_a_file_in_a_recording_is_never_one_on_the_disk(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is not asked for stays where it is, whatever it is called."""
    file = write_recording(tmp_path / "drive.mcap", {name: b"x"} | WELL)
    assert_replayed(capsys, file)
    assert list(tmp_path.rglob("*")) == [file]


@pytest.mark.parametrize("dbc", ["{here}/tiny.dbc", "{from_there}/tiny.dbc", "eqrt_objects.dbc"])
def test_a_recorded_profile_names_no_file_outside_the_recording(
    dbc: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Be it there, as these are, or built in: what a machine has is not what was recorded."""
    (tmp_path / "tiny.dbc").write_text(DBC)
    named = dbc.format(here=tmp_path, from_there=os.path.relpath(tmp_path))
    file = write_recording(tmp_path / "drive.mcap", WELL | {"profile/own.toml": own(named)})
    assert main(["replay", str(file), "--out", "/dev/null"]) == 1
    refused = f"{file}: the profile in it cannot be used (there is no {named!r} among its files)"
    assert capsys.readouterr().err == f"eqrt: {refused}; give one with --profile\n"
    given = tmp_path / "own.toml"
    given.write_bytes(own())
    assert_replayed(capsys, file, "--profile", str(given))


@pytest.mark.parametrize(
    "attached",
    [
        {},
        {"profile/own.toml": b"\xff"},
        {"profile/own.toml": own()},
        {"profile/own.toml": own("two\\nlines")},
        {"profile/own.toml": own("two\\nlines"), "profile/two\nlines": b"no DBC"},
        {"profile/own.toml": own("/" + "long" * 1000)},
        WELL | {"profile/own.toml": own() + b"#" * toml_tables.MAX_BYTES},
        WELL | {"profile/tiny.dbc": b"BO_ 1 "},
    ],
)
def test_a_recorded_profile_that_cannot_be_used_is_refused_in_a_line(
    attached: Mapping[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line names the recording and what to do."""
    file = write_recording(tmp_path / "drive.mcap", attached)
    assert main(["replay", str(file), "--out", "/dev/null"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"eqrt: {file}: the profile in it cannot be used (")
    assert said.endswith("); give one with --profile\n")
    assert said.count("\n") == 1
    assert len(said) < len(str(file)) + 300


def test_a_recorded_tile_that_is_damaged_is_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = bytearray(TILE.read_bytes())
    content[-1] ^= 1
    file = write_recording(tmp_path / "drive.mcap", WELL | {"tile": bytes(content)}, "00000000")
    assert main(["replay", str(file), "--out", "/dev/null"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"eqrt: {file}: the tile in it: the tile is damaged")
    assert said.count("\n") == 1


def test_recorded_files_are_called_what_their_profile_calls_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As those of earlier versions have: drives that could not be replayed then can be now."""
    profile = write_profile(tmp_path, "own.toml", "../dbc/tiny.dbc")
    assert set(profile_files(str(profile))) == {"own.toml", "../dbc/tiny.dbc"}
    attached = {f"profile/{name}": content for name, content in profile_files(str(profile)).items()}
    file = write_recording(tmp_path / "drive.mcap", attached)
    assert Recording([file]).attached["profile/../dbc/tiny.dbc"] == DBC.encode()
    assert_replayed(capsys, file)
