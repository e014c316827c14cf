"""A replay is exact where runs were given up and where model and tile were exchanged; or it says
which cycles it cannot make again. With the real service, in processes.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from drives import TILE
from eqrt.core.tile import decode, encode
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.prediction.tiles import save_tile
from eqrt.runtime.recording.reader import Recording, read_recordings
from eqrt.runtime.recording.runs import Outcome
from handmade_model import write_handmade
from processes import eqrt
from recorded_drives import patiently, recorded_drive
from source_tree import ROOT

SLOW_EQRT = [sys.executable, str(ROOT / "tests/slow_eqrt.py")]


def said(recording: Recording) -> bytes:
    """Its predictions, as JSON lines."""
    return b"".join(map(json_lines, recording.forecasts()))


# --- runs that were given up


def test_runs_that_were_given_up_are_given_up_again(tmp_path: Path) -> None:
    """And those that were not begun because the model was still at work, and those that failed; by
    a model that is quick and well.
    """
    folder = tmp_path / "rec"
    with recorded_drive("ngsim", folder, tmp_path / "drive.log", command=SLOW_EQRT) as (service, _):
        assert service.end()[0] == 0
    (recording,) = read_recordings(folder)
    outcomes = [outcome for step in recording.steps() for outcome in step.outcomes]
    assert outcomes.count(Outcome.GIVEN_UP) >= 6
    assert outcomes.count(Outcome.FAILED) >= 1
    modes = {int(mode) for one in recording.forecasts() for mode in one.agent_mode}
    assert {Mode.LATE, Mode.FALLBACK} <= modes
    lines = tmp_path / "replayed.jsonl"
    done = eqrt("replay", str(folder), "--out", str(lines), "--diff", str(folder))
    assert done.returncode == 0, done.stdout
    assert lines.read_bytes() == said(recording)


def test_a_replay_does_not_depend_on_how_quick_it_is(tmp_path: Path) -> None:
    """A slow machine replays what a quick one recorded."""
    folder = tmp_path / "rec"
    with recorded_drive("ngsim", folder, tmp_path / "drive.log", seconds=2.0) as (service, _):
        assert service.end()[0] == 0
    done = eqrt("replay", str(folder), "--diff", str(folder), command=SLOW_EQRT)
    assert done.returncode == 0, done.stdout


# --- exchanged models and tiles


@dataclass(frozen=True)
class Reloaded:
    """A recording in the middle of which model and tile were exchanged."""

    folder: Path
    model: Path
    """Where the first one was, and then the second."""
    second_cycles: int
    """With targets, by the second model."""


@pytest.fixture(scope="module")
def reloaded(tmp_path_factory: pytest.TempPathFactory) -> Reloaded:
    """The first model is the one that comes with eqrt."""
    work = tmp_path_factory.mktemp("reloaded")
    folder, model, tile = work / "rec", work / "model", work / "map.tile"
    shutil.copytree(DEFAULT_ARTIFACT, model)
    shutil.copy(TILE, tile)
    second = write_handmade(work / "second")
    lane_map, info = decode(TILE.read_bytes(), "demo")
    options = ("--model", str(model), "--tile", str(tile))
    with recorded_drive("ngsim", folder, work / "drive.log", *options, until=15) as (
        service,
        heard,
    ):
        model.rename(work / "first")
        second.rename(model)
        save_tile(tile, encode(lane_map, replace(info, name="other")))
        os.kill(service.pid, signal.SIGHUP)
        first_id = heard.forecasts[0].model_id
        patiently(lambda: heard.forecasts[-1].model_id != first_id)
        count = len(heard.forecasts)
        patiently(lambda: len(heard.forecasts) > count + 12)
        assert service.end()[0] == 0
    (recording,) = read_recordings(folder)
    cycles = [one for one in recording.forecasts() if one.num_targets]
    return Reloaded(folder, model, sum(one.model_id != first_id for one in cycles))


def test_a_replay_exchanges_model_and_tile_where_the_service_did(
    reloaded: Reloaded, tmp_path: Path
) -> None:
    """Tracks go on, and so do the parts of the recording: a part for each model and tile."""
    (recording,) = read_recordings(reloaded.folder)
    assert len({one.predicting for one in recording.identities}) == 2
    forecasts = list(recording.forecasts())
    assert len({one.model_id for one in forecasts}) == 2
    assert len({one.tile_id for one in forecasts} - {""}) == 2
    lines = tmp_path / "replayed.jsonl"
    folder = str(reloaded.folder)
    done = eqrt("replay", folder, "--out", str(lines), "--diff", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert lines.read_bytes() == said(recording)


def test_cycles_of_a_model_that_is_gone_are_left_out_and_no_difference(
    reloaded: Reloaded, tmp_path: Path
) -> None:
    """It says which and why, by its exit status too; with the model given, nothing is left out."""
    elsewhere, folder = tmp_path / "elsewhere", str(reloaded.folder)
    reloaded.model.rename(elsewhere)
    try:
        done = eqrt("replay", folder, "--diff", folder)
        given = eqrt("replay", folder, "--diff", folder, "--model", str(elsewhere))
    finally:
        elsewhere.rename(reloaded.model)
    assert done.returncode == 3, done.stdout + done.stderr
    assert f"left out of the replay {reloaded.second_cycles:>9,}" in squeezed(done.stdout)
    assert "cannot be made again and are left out: they were recorded with the model" in done.stderr
    assert f"which is no more at {reloaded.model}; give it with --model" in done.stderr
    assert (given.returncode, "left out" in given.stderr) == (0, False), given.stdout


def squeezed(text: str) -> str:
    """Columns of a table, whatever their width."""
    return "\n".join(
        f"{name.strip()} {count:>9}"
        for name, _, count in (line.rpartition(" ") for line in text.splitlines())
    )


def test_another_model_predicts_all_of_it(reloaded: Reloaded) -> None:
    """`--diff-model` with one of the two: the cycles of that one are the same."""
    folder = str(reloaded.folder)
    done = eqrt("replay", folder, "--diff-model", str(DEFAULT_ARTIFACT))
    assert done.returncode == 1, done.stderr
    assert "left out" not in done.stdout
    assert f"only in the replay {0:>9,}" in squeezed(done.stdout)
