"""The training loop, on real recordings, for a few steps."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from eqrt.cli import main
from eqrt.core.errors import EqrtError, UsageError
from eqrt.training.checkpoint import load_checkpoint
from eqrt.training.data import load_windows
from eqrt.training.evaluate import evaluate, evaluate_constant_velocity, predict
from eqrt.training.losses import best_mode_loss, mode_displacement
from eqrt.training.train import load_config, schedule, train
from source_tree import ROOT

NGSIM = ROOT / "tests/data/ngsim"
CONFIG_FILE = ROOT / "training/configs/eqrt-ngsim.toml"
CONFIG = load_config(CONFIG_FILE)


def test_training_beats_constant_velocity_on_what_it_saw(tmp_path: Path) -> None:
    """A hundred steps on eight seconds of motorway."""
    contract = CONFIG.model.contract("test", "0.0.0")
    windows = load_windows([NGSIM / "USA_US101-15_1_T-1.xml.gz"], contract, stride=3)
    loop = replace(CONFIG.train, evaluate_every=1000, batch_size=32, average_decay=0.9)
    model = train(replace(CONFIG, train=loop), windows, windows, 100, tmp_path)
    learned = evaluate(model, windows)
    course = evaluate_constant_velocity(windows, CONFIG.model.dt_s)
    assert learned["ade_3s"] < 0.95 * course["ade_3s"]
    assert np.isfinite(predict(model, windows)).all()


def test_the_same_seed_trains_the_same_network(tmp_path: Path) -> None:
    contract = CONFIG.model.contract("test", "0.0.0")
    windows = load_windows([NGSIM / "USA_Peach-4_8_T-1.xml.gz"], contract, stride=3)
    loop = replace(CONFIG.train, batch_size=16)
    models = [train(replace(CONFIG, train=loop), windows, windows, 3, tmp_path) for _ in range(2)]
    for one, other in zip(models[0].parameters(), models[1].parameters(), strict=True):
        assert torch.equal(one, other)


def test_the_command_writes_a_checkpoint_that_says_where_it_comes_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    data.mkdir()
    for name in (*CONFIG.data.held_out[-1:], "USA_Lanker-1_1_T-1"):
        shutil.copy(NGSIM / f"{name}.xml.gz", data)
    text = CONFIG_FILE.read_text(encoding="utf-8")
    start, end = text.index("held_out = ["), text.index("]\nstride")
    config = tmp_path / "config.toml"
    config.write_text(text[:start] + f'held_out = ["{CONFIG.data.held_out[-1]}"' + text[end:])
    out = tmp_path / "out"
    args = ["train", "--config", config, "--data", data, "--out", out, "--steps", "2"]
    assert main([str(arg) for arg in args]) == 0
    model, card = load_checkpoint(out / "model.safetensors")
    assert model.config == CONFIG.model
    assert card.license == "CC-BY-SA-4.0"
    assert card.metrics.keys() == card.baseline.keys()
    assert card.metrics["fde_3s"] > 0.0
    (line,) = (out / "metrics.jsonl").read_text().splitlines()
    assert json.loads(line)["step"] == 2
    assert "constant velocity" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("seed = 1", "sead = 1"), r"\[train\].*sead"),
        (("heads = 2", ""), r"\[model\].*heads"),
        (('name = "eqrt-ngsim"', "name ="), "not TOML"),
    ],
)
def test_a_wrong_configuration_names_the_file_and_the_field(
    tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(CONFIG_FILE.read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    with pytest.raises(EqrtError, match=said) as refused:
        load_config(path)
    assert str(path) in str(refused.value)


def test_a_missing_configuration_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such configuration"):
        load_config(tmp_path / "missing.toml")


def test_held_out_recordings_that_are_not_there_are_named(tmp_path: Path) -> None:
    shutil.copy(NGSIM / "USA_Lanker-1_1_T-1.xml.gz", tmp_path)
    args = ["train", "--config", CONFIG_FILE, "--data", tmp_path, "--out", tmp_path / "out"]
    assert main([str(arg) for arg in args]) == 1
    assert not (tmp_path / "out").exists()


def test_the_schedule_warms_up_and_comes_down_to_nothing() -> None:
    assert schedule(0, 100, 10) == pytest.approx(0.1)
    assert schedule(10, 100, 10) == pytest.approx(1.0)
    assert schedule(55, 100, 10) == pytest.approx(0.5)
    assert schedule(100, 100, 10) == pytest.approx(0.0)


def test_the_loss_is_the_displacement_of_the_best_mode_over_the_seen_steps() -> None:
    """Two modes, one 3 m off at every step, one 5 m off; the second half was not seen."""
    future = torch.zeros(1, 4, 2)
    valid = torch.tensor([[True, True, False, False]])
    modes = torch.zeros(1, 2, 4, 2)
    modes[0, 0, :, 0], modes[0, 1, :, 1] = 3.0, 5.0
    modes[0, 0, 2:] = 1000.0
    distance = mode_displacement(modes, future, valid)
    torch.testing.assert_close(distance, torch.tensor([[3.0, 5.0]]))
    sure = best_mode_loss(modes, torch.tensor([[1.0, 0.0]]), future, valid)
    torch.testing.assert_close(sure, torch.tensor(3.0))
    unsure = best_mode_loss(modes, torch.tensor([[0.5, 0.5]]), future, valid)
    torch.testing.assert_close(unsure, torch.tensor(3.0 + 0.5 * float(np.log(2.0))))
