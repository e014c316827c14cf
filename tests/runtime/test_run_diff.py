"""What `eqrt replay --diff` counts and measures, and its exit status."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drives import DRIVES, first_seconds
from eqrt.cli import main
from eqrt.core.errors import LogError
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.run_diff import Difference, compare_runs, table
from forecast_sets import many
from processes import EQRT, environment
from source_tree import ROOT

NGSIM = DRIVES["ngsim"]
OTHER_MODEL = ROOT / "deploy/models/eqrt-small-6"


def run(change: Callable[[ForecastSet], ForecastSet] = lambda x: x, start_s: float = 0.0) -> bytes:
    """Five cycles of eight targets, 0.1 s apart, the third one changed."""
    cycles = [at(many(8, seed=k), start_s + k / 10, k) for k in range(5)]
    cycles[2] = change(cycles[2])
    return b"".join(map(json_lines, cycles))


def at(forecast: ForecastSet, time_s: float, cycle: int) -> ForecastSet:
    return replace(forecast, cycle=cycle, timestamp_s=time_s, anchor_s=np.full(8, time_s))


def diff(first: bytes, second: bytes) -> Difference:
    return compare_runs(first.splitlines(), second.splitlines())


def test_a_run_does_not_differ_from_itself() -> None:
    found = diff(run(), run())
    assert found.is_none
    assert (found.cycles, found.targets, found.identical) == (5, 40, 40)
    assert found.distances_m == [0.0] * 40


def test_a_trajectory_that_moved_is_measured_and_the_worst_is_named() -> None:
    """3 m east and 4 m north at one step of one target: 5 m."""

    def moved(forecast: ForecastSet) -> ForecastSet:
        trajectories = forecast.trajectories.copy()
        trajectories[6, 0, 11] += (3.0, 4.0)
        return replace(forecast, trajectories=trajectories)

    found = diff(run(), run(moved))
    assert not found.is_none
    assert (found.identical, found.modes, found.cycle_modes) == (39, 0, 0)
    assert found.worst is not None
    assert (found.worst.track_id, found.worst.time_s) == (1006, 0.2)
    assert found.worst.distance_m == pytest.approx(5.0, abs=0.002)
    assert "track 1006, object 6, in the cycle at 0.200000 s" in table(found, "one", "other")


def test_other_modes_are_counted_per_cycle_and_per_target() -> None:
    late = np.full(8, Mode.LATE, np.uint8)
    found = diff(run(), run(lambda x: replace(x, mode=Mode.LATE, agent_mode=late)))
    assert (found.cycle_modes, found.modes, found.identical) == (1, 8, 32)
    assert max(found.distances_m) == 0.0


def test_what_only_one_run_has_is_counted_on_its_side() -> None:
    found = diff(run(), run(lambda x: x.targets(slice(3))))
    assert (found.targets_only_first, found.targets_only_second) == (5, 0)
    found = diff(run(lambda x: x.targets(slice(0))), run())
    assert (found.cycles, found.cycles_only_second, found.targets_only_second) == (4, 1, 8)
    assert not found.is_none


def test_runs_of_other_times_have_nothing_in_common() -> None:
    found = diff(run(), run(start_s=100.0))
    assert (found.cycles, found.cycles_only_first, found.cycles_only_second) == (0, 5, 5)


def test_several_starts_of_a_service_are_compared_one_by_one() -> None:
    """Their clocks begin anew."""
    assert diff(run() + run(), run() + run()).is_none
    found = diff(run() + run(), run())
    assert (found.cycles, found.cycles_only_first) == (5, 5)


def test_another_model_alone_is_no_difference_but_is_named() -> None:
    other = run().replace(b"89abcdef0123", b"00c0ffee0000")
    found = diff(run(), other)
    assert found.is_none
    assert table(found, "one", "other").startswith(
        "model: 89abcdef0123 in one, 00c0ffee0000 in other\n"
    )


def test_other_time_steps_are_not_compared() -> None:
    found = diff(run(), run(lambda x: replace(x, dt_s=0.2)))
    assert (found.incomparable, len(found.distances_m)) == (8, 32)


def test_a_line_that_is_no_prediction_is_an_error() -> None:
    with pytest.raises(LogError, match="the second run: line 1 is no prediction"):
        diff(run(), b'{"cycle": 1}\n')


@pytest.mark.parametrize("trajectories", [b"[]", b'"far"', b"[[[1.0]]]"])
def test_a_line_without_trajectories_is_an_error(trajectories: bytes) -> None:
    line, *more = run().splitlines()
    broken = re.sub(rb'"trajectories":.*', b'"trajectories":' + trajectories + b"}", line)
    with pytest.raises(
        LogError, match=r"object \d+ in the cycle at 0.000000 s has no trajectories"
    ):
        diff(run(), b"\n".join([broken, *more]))


# --- the command


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("diff") / "drive.log"
    path.write_text(first_seconds(NGSIM.log, 2.0))
    return path


def test_a_log_replayed_twice_is_identical(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = tmp_path / "first.jsonl"
    assert main(["replay", str(log), *NGSIM.options, "--out", str(lines)]) == 0
    assert main(["replay", str(log), *NGSIM.options, "--diff", str(lines)]) == 0
    rows = [line.split()[-1] for line in capsys.readouterr().out.splitlines()]
    count = lines.read_bytes().count(b"\n")
    assert [int(number) for number in rows[:9]] == [20, 0, 0, 0, count, 0, 0, count, 0]


def test_another_model_differs(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit status 1; every target is in both, and few are the same."""
    options = [*NGSIM.options, "--diff-model", str(OTHER_MODEL)]
    assert main(["replay", str(log), *options]) == 1
    rows = dict(line.rsplit(maxsplit=1) for line in capsys.readouterr().out.splitlines()[1:5])
    assert rows["  only in the replay"] == rows["  only in eqrt-small-6"] == "0"


def test_predictions_are_there_although_nobody_reads_the_comparison(
    log: Path, tmp_path: Path
) -> None:
    lines, again = tmp_path / "first.jsonl", tmp_path / "again.jsonl"
    assert main(["replay", str(log), *NGSIM.options, "--out", str(lines)]) == 0
    options = [*NGSIM.options, "--diff", str(lines), "--out", str(again)]
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb") as stdout:
        done = subprocess.run(
            [*EQRT, "replay", str(log), *options],
            stdout=stdout,
            stderr=subprocess.PIPE,
            env=environment(PYTHONUNBUFFERED="1"),
            check=False,
        )
    assert (done.returncode, done.stderr) == (1, b"")
    assert again.read_bytes() == lines.read_bytes()


def test_a_replay_must_be_asked_for_something(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(log), *NGSIM.options]) == 2
    assert "give --out FILE, or --diff RUN" in capsys.readouterr().err


def test_a_log_needs_a_profile(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(log), "--out", "-"]) == 2
    assert "add --profile NAME" in capsys.readouterr().err
