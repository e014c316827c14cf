"""`eqrt replay`: the service on a log, the same bytes every time, and a file only when whole."""

from __future__ import annotations

import gzip
import json
import math
import re
import subprocess
import sys
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drives import DRIVES, Car, first_seconds, shipped_predictor, traffic
from eqrt.cli import main
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import output, replay
from processes import EQRT, environment, eqrt
from source_tree import ROOT

NGSIM = DRIVES["ngsim"]
RECORDING = "there/eqrt-20260301T101500Z-0badcafe-0000.mcap"
KEYS = {  # of docs/output.md
    "cycle": int,
    "time_s": float,
    "cycle_mode": str,
    "model_id": str,
    "tile_id": str,
    "track_id": int,
    "object_id": int,
    "mode": str,
    "anchor_s": float,
    "age_s": float,
    "dt_s": float,
    "position": list,
    "velocity": list,
    "probabilities": list,
    "trajectories": list,
}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """The first seconds of NGSIM."""
    path = tmp_path / "drive.log"
    path.write_text(first_seconds(NGSIM.log, 2.0))
    return path


def run(log: Path, out: Path | str, *options: str) -> int:
    return main(["replay", str(log), *(options or NGSIM.options), "--out", str(out)])


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_same_log_gives_the_same_bytes(log: Path, tmp_path: Path) -> None:
    """In another process, with another order of hashes, and from the packed log."""
    packed = tmp_path / "packed.log.gz"
    packed.write_bytes(gzip.compress(log.read_bytes()))
    for source, seed in ((log, "0"), (packed, "1")):
        out = tmp_path / f"{seed}.jsonl"
        done = eqrt("replay", str(source), *NGSIM.options, "--out", str(out), PYTHONHASHSEED=seed)
        assert (done.returncode, done.stdout) == (0, "")
    assert (tmp_path / "0.jsonl").read_bytes() == (tmp_path / "1.jsonl").read_bytes()


def test_a_line_has_the_documented_keys_and_only_those(log: Path, tmp_path: Path) -> None:
    assert run(log, tmp_path / "out.jsonl") == 0
    contract, lines = shipped_predictor().contract, lines_of(tmp_path / "out.jsonl")
    documented = (ROOT / "docs/output.md").read_text().partition("## JSON lines")[2]
    assert len(lines) > 500
    for line in lines:
        assert list(line) == list(KEYS)
        for key, kind in KEYS.items():
            assert isinstance(line[key], kind), key
        shape = (contract.num_modes, contract.horizon_steps, 2)
        assert np.shape(line["trajectories"]) == shape
        assert np.shape(line["probabilities"]) == shape[:1]
        assert Mode[line["mode"]] in (Mode.RUN, Mode.PARTIAL, Mode.FALLBACK)
        assert Mode[line["cycle_mode"]] is Mode.RUN
    assert all(f"`{key}`" in documented for key in KEYS)


def test_lines_are_those_of_a_pipeline_fed_by_hand(log: Path, tmp_path: Path) -> None:
    assert run(log, tmp_path / "out.jsonl") == 0
    assert NGSIM.tile is not None
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), load_tile(NGSIM.tile))
    by_hand: list[ForecastSet] = []
    for line in log.read_text().splitlines():
        message = candump_message(line)
        by_hand += pipeline.poll(message.timestamp)
        by_hand += pipeline.feed(message, message.timestamp)
    by_hand += pipeline.finish(message.timestamp)
    assert b"".join(map(json_lines, by_hand)) == (tmp_path / "out.jsonl").read_bytes()


def test_the_last_cycle_counts_although_the_log_ends_in_it() -> None:
    """Its rest was never recorded."""
    cars = [Car(object_id=1, x_m=20.0, y_m=0.0), Car(object_id=2, x_m=30.0, y_m=3.0)]
    pipeline = Pipeline(load_profile("generic"), shipped_predictor())
    last = list(replay(pipeline, list(traffic(cars, 0.3))[:-1]))[-1]
    assert last.timestamp_s == pytest.approx(0.3)
    assert last.num_targets == 2


def test_messages_whose_stamps_are_no_times_change_nothing() -> None:
    cars = [Car(object_id=1, x_m=20.0, y_m=0.0), Car(object_id=2, x_m=30.0, y_m=3.0)]

    def told(odd: list[float]) -> list[bytes]:
        messages = list(traffic(cars, 2.5))
        for number, stamp in enumerate(odd):
            strange = copy(messages[40 * number])
            strange.timestamp = stamp
            messages.insert(40 * number + 20, strange)
        pipeline = Pipeline(load_profile("generic"), shipped_predictor())
        return [json_lines(made) for made in replay(pipeline, messages)]

    assert told([math.nan, math.inf, -math.inf]) == told([]) != []


def test_a_replay_ends_with_a_line_about_it(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(log, tmp_path / "out.jsonl") == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"eqrt replay: {len(log.read_text().splitlines())} messages, 20 cycles, ")
    assert f", {len(lines_of(tmp_path / 'out.jsonl'))} predictions in " in err
    assert err.count("\n") == 1


def test_a_log_that_ends_in_a_line_is_read_up_to_there_and_reported(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = log.read_text()
    log.write_text(whole[: whole.index("\n", len(whole) // 2) + 20])
    assert run(log, tmp_path / "out.jsonl") == 0
    remark, _ = capsys.readouterr().err.splitlines()
    assert remark.startswith(f"eqrt: {log}: ends in the middle of line ")
    assert len(lines_of(tmp_path / "out.jsonl")) > 100


def test_standard_output_gets_the_lines_and_nothing_else(log: Path, tmp_path: Path) -> None:
    done = eqrt("replay", str(log), *NGSIM.options, "--out", "-")
    assert run(log, tmp_path / "out.jsonl") == 0
    assert done.stdout.encode() == (tmp_path / "out.jsonl").read_bytes()
    assert done.stderr.startswith("eqrt replay: ")


def test_a_reader_that_has_seen_enough_ends_the_replay_quietly(log: Path) -> None:
    """As `head` does."""
    command = [*EQRT, "replay", str(log), *NGSIM.options, "--out", "-"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment()
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert json.loads(process.stdout.readline())
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


def test_a_replay_that_fails_leaves_what_was_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The output appears when it is whole, in one step."""
    out, empty = tmp_path / "out.jsonl", tmp_path / "empty.log"
    out.write_text("yesterday's\n")
    empty.write_text("no message here\n")
    assert run(empty, out) == 1
    assert "there is no CAN message in it" in capsys.readouterr().err
    assert out.read_text() == "yesterday's\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.log", "out.jsonl"]


@pytest.mark.parametrize("read", ["drive.log", "./there/../drive.log", "a.tile", RECORDING])
def test_what_a_replay_reads_is_not_written_over(
    read: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / RECORDING).write_text("an earlier run\n")
    tile = tmp_path / "a.tile"
    tile.write_bytes(Path(NGSIM.options[NGSIM.options.index("--tile") + 1]).read_bytes())
    before = (tmp_path / read).read_bytes()
    options = ["--profile", "generic", "--tile", str(tile), "--diff", str(tmp_path / "there")]
    assert run(log, tmp_path / read, *options) == 2
    assert "is read here and would be lost; choose another file" in capsys.readouterr().err
    assert (tmp_path / read).read_bytes() == before


def test_while_a_replay_writes_its_output_is_not_there(tmp_path: Path) -> None:
    out = tmp_path / "out.jsonl"
    with output(str(out)) as stream:
        stream.write(b"half\n")
        assert not out.exists()
    assert out.read_bytes() == b"half\n"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.skipif(sys.platform == "win32", reason="there are no devices in the file system")
def test_a_device_is_written_and_stays_a_device(log: Path) -> None:
    assert run(log, "/dev/null") == 0
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize(
    ("options", "objects", "status"),
    [
        (["--can", "radar=can1", "--can", "car=can0"], True, 0),
        (["--can", "radar=can0", "--can", "car=can1"], False, 1),
        (["--can", "can1"], True, 1),  # nothing tells how the car moves
        (["--can", "can0"], False, 1),
    ],
)
def test_only_the_named_channels_of_a_log_are_read(
    options: list[str],
    objects: bool,
    status: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The RAV4's radar is on can1, its wheels are on can0."""
    log = tmp_path / "drive.log"
    log.write_text(first_seconds(DRIVES["rav4"].log, 1.0))
    assert run(log, tmp_path / "out.jsonl", *DRIVES["rav4"].options, *options) == status
    found = int(capsys.readouterr().err.split(" cycles, ")[1].split()[0])
    assert (found > 0) == objects


def test_a_replay_counts_its_cycles_by_mode(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(log, tmp_path / "out.jsonl") == 0
    assert capsys.readouterr().err.endswith("; cycles by mode: RUN 20\n")


@pytest.mark.parametrize(
    ("profile", "without", "reason"),
    [
        ("toyota-rav4", "", " messages is one that the profile 'toyota-rav4' reads"),
        ("ars408", " 60A#", "no object list came"),
        ("ars408", " 60B#", "all object lists are empty"),
        ("ars408", " 300#", "nothing tells the car's speed and yaw rate (SpeedInformation not on"),
        ("ars408", " 30[01]#", "(SpeedInformation, YawRateInformation not on the bus)"),
    ],
)
def test_a_replay_without_predictions_says_why_and_fails(
    profile: str, without: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And leaves what was there."""
    log, out = tmp_path / "drive.log", tmp_path / "out.jsonl"
    lines = first_seconds(DRIVES["ars408"].log, 1.0).splitlines(keepends=True)
    log.write_text("".join(one for one in lines if not (without and re.search(without, one))))
    out.write_text("yesterday's\n")
    assert run(log, out, "--profile", profile) == 1
    summary, said = capsys.readouterr().err.splitlines()
    assert " 0 predictions in " in summary
    assert said.startswith("eqrt: no predictions: ")
    assert reason in said
    assert out.read_text() == "yesterday's\n"


def test_a_profile_without_a_sensor_predicts_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One for an INS alone, which is there."""
    log = tmp_path / "drive.log"
    log.write_text("(1.0) can0 134#0000000000000000\n")
    assert run(log, tmp_path / "out.jsonl", "--profile", "sbg-ins") == 1
    assert "'sbg-ins' has no [[sensor]]" in capsys.readouterr().err
