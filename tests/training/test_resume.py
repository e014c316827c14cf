"""A training that was stopped goes on as if it had not been: bit for bit, whatever stopped it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from eqrt.core.errors import EqrtError
from eqrt.training.checkpoint import read_tensors, write_tensors
from eqrt.training.progress import Lines
from eqrt.training.sampling import Pool
from eqrt.training.train import train
from eqrt.training.training_data import TrainingData
from processes import EQRT, PATIENCE_S, environment
from tiny_training import DATA, same_tensors, tiny, tiny_data, tiny_file

RESULTS = ("model.safetensors", "state.safetensors")


def start(config: Path, out: Path, *more: str) -> subprocess.Popen[str]:
    """The real command in a process of its own."""
    sources = [word for path in DATA for word in ("--data", str(path))]
    words = ["train", "--config", str(config), *sources, "--out", str(out), *more]
    return subprocess.Popen(
        [*EQRT, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )


def stop_after(process: subprocess.Popen[str], step: int, by: signal.Signals) -> tuple[int, str]:
    """Send a signal once it has evaluated that step: exit status, and what else it printed."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.split()[:2] == ["step", str(step)]:
            break
    process.send_signal(by)
    rest, errors = process.communicate(timeout=2 * PATIENCE_S)
    assert process.returncode != 1, errors
    return process.returncode, rest


def steps_in(out: Path) -> list[int]:
    lines = (out / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line)["step"] for line in lines]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hundred steps, evaluated at every tenth; dropout and every augmentation are on."""
    often = ("evaluate_every = 25", "evaluate_every = 10")
    return tiny_file(tmp_path_factory.mktemp("config"), often)


@pytest.fixture(scope="module")
def undisturbed(config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    process = start(config, out)
    _, errors = process.communicate(timeout=2 * PATIENCE_S)
    assert process.returncode == 0, errors
    return out


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_told_to_stop_it_finishes_the_step_and_goes_on_to_the_same_bits(
    config: Path, undisturbed: Path, tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "out"
    status, said = stop_after(start(config, out), 50, number)
    assert status == 128 + number
    assert "--resume" in said
    done = json.loads(read_tensors(out / "state.safetensors")[1]["step"])
    assert 50 <= done < 100
    _, errors = (process := start(config, out, "--resume")).communicate(timeout=2 * PATIENCE_S)
    assert process.returncode == 0, errors
    for name in RESULTS:
        assert same_tensors(out / name, undisturbed / name)
    assert steps_in(out) == steps_in(undisturbed)


def test_killed_it_goes_on_from_its_last_state_to_the_same_bits(
    config: Path, undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    status, _ = stop_after(start(config, out), 50, signal.SIGKILL)
    assert status == -signal.SIGKILL
    _, errors = (process := start(config, out, "--resume")).communicate(timeout=2 * PATIENCE_S)
    assert process.returncode == 0, errors
    for name in RESULTS:
        assert same_tensors(out / name, undisturbed / name)
    assert steps_in(out) == steps_in(undisturbed)


def test_fifty_and_fifty_steps_are_a_hundred(tmp_path: Path) -> None:
    """In one process, stopped between two evaluations."""
    config = tiny({"train": {"evaluate_every": 100}})
    whole = train(config, tiny_data(), tmp_path / "whole")
    left = iter(range(50, 0, -1))
    half = train(config, tiny_data(), tmp_path / "half", should_stop=lambda: next(left) == 1)
    assert half.step == 50
    assert not (tmp_path / "half" / "model.safetensors").exists()
    rest = train(config, tiny_data(), tmp_path / "half", resume=True)
    assert rest.step == whole.step == 100
    assert rest.loss == whole.loss
    for name in RESULTS:
        assert same_tensors(tmp_path / "half" / name, tmp_path / "whole" / name)
    assert steps_in(tmp_path / "half") == steps_in(tmp_path / "whole") == [50, 100]


@pytest.fixture
def begun(tmp_path: Path) -> Path:
    train(tiny().with_steps(2), tiny_data(), tmp_path)
    return tmp_path


def test_the_state_of_another_configuration_says_which_fields_differ(begun: Path) -> None:
    other = tiny({"train": {"seed": 5, "steps": 2}, "network": {"width": 32}})
    with pytest.raises(EqrtError) as refused:
        train(other, tiny_data(), begun, resume=True)
    said = str(refused.value)
    assert "another configuration" in said
    assert "[network] width (16 there, 32 here)" in said
    assert "[train] seed (1 there, 5 here)" in said
    assert "batch_size" not in said


def test_the_state_of_other_data_is_refused(begun: Path) -> None:
    held_out = tiny_data().held_out
    other = TrainingData(tiny_data().pool.of(held_out), held_out, tiny_data().source)
    with pytest.raises(EqrtError, match=r"another data: checksum .* there"):
        train(tiny().with_steps(2), other, begun, resume=True)


def test_the_state_of_as_many_other_windows_is_refused(tmp_path: Path) -> None:
    """The same rows and weights; everybody goes the other way."""
    config, windows = tiny().with_steps(2), tiny_data().held_out
    data = TrainingData(Pool.of(windows), windows, tiny_data().source)
    train(config, data, tmp_path)
    other = replace(data, pool=Pool.of(replace(windows, future=-windows.future)))
    with pytest.raises(EqrtError, match=r"another data: content \(\d+ there, \d+ here\)"):
        train(config, other, tmp_path, resume=True)
    assert train(config, data, tmp_path, resume=True).step == 2


def test_a_damaged_state_is_refused_in_one_line(begun: Path) -> None:
    path = begun / "state.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(EqrtError, match="not a checkpoint") as refused:
        train(tiny().with_steps(2), tiny_data(), begun, resume=True)
    assert "\n" not in str(refused.value)


def test_without_a_state_resuming_is_starting(tmp_path: Path) -> None:
    assert train(tiny().with_steps(1), tiny_data(), tmp_path, resume=True).step == 1


def test_a_finished_training_has_nothing_left_to_do(begun: Path) -> None:
    before = (begun / "model.safetensors").read_bytes()
    assert train(tiny().with_steps(2), tiny_data(), begun, resume=True).step == 2
    assert (begun / "model.safetensors").read_bytes() == before


class GoneAt(Lines):
    """Whoever reads the lines is gone when it is to read one that begins so."""

    def __init__(self, beginning: str) -> None:
        self._beginning = beginning

    def line(self, text: str) -> None:
        if text.startswith(self._beginning):
            raise BrokenPipeError


def test_what_was_evaluated_is_written_though_nobody_listens(tmp_path: Path) -> None:
    """Ctrl-C ends the `tee` behind a training before the training."""
    with pytest.raises(BrokenPipeError):
        train(tiny().with_steps(2), tiny_data(), tmp_path, display=GoneAt("step      2"))
    assert json.loads(read_tensors(tmp_path / "state.safetensors")[1]["step"]) == 2
    assert (tmp_path / "model.safetensors").exists()


def test_a_file_is_replaced_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted before the new one is whole, the old one is still there."""
    path = tmp_path / "x.safetensors"
    write_tensors(path, tiny_data().held_out.tensors(), {"step": "1"})

    def pull_the_plug(_: int) -> None:
        raise OSError("no power")

    monkeypatch.setattr(os, "fsync", pull_the_plug)
    with pytest.raises(EqrtError, match=r"x\.safetensors: cannot be written \(no power\)"):
        write_tensors(path, {}, {"step": "2"})
    assert read_tensors(path)[1] == {"step": "1"}
    assert list(tmp_path.iterdir()) == [path]
