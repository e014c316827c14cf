"""A training that begins with the weights of another one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from eqrt.cli import main
from eqrt.core.errors import EqrtError
from eqrt.training.checkpoint import load_checkpoint, read_tensors
from eqrt.training.dataset.split import group_digest
from eqrt.training.start import open_start
from eqrt.training.train import train
from tiny_training import DATA, tiny, tiny_data, tiny_file
from window_samples import packed_scenes

MODEL = "model.safetensors"
HARDLY = {"learning_rate": 1e-12, "weight_decay": 0.0, "warmup_steps": 0, "steps": 1, "seed": 9}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint of a short training."""
    out = tmp_path_factory.mktemp("trained")
    train(tiny().with_steps(3), tiny_data(), out)
    return out / MODEL


def test_it_begins_with_these_weights_and_not_with_random_ones(
    trained: Path, tmp_path: Path
) -> None:
    """A step that moves them by less than a float can tell, with another seed."""
    config = tiny({"train": HARDLY, "network": {"dropout": 0.0}})
    state = train(config, tiny_data(), tmp_path, start=open_start(trained, config))
    before, _ = read_tensors(trained)
    for name, weight in state.network.state_dict().items():
        torch.testing.assert_close(weight, before[name], atol=1e-9, rtol=1e-6)
    assert load_checkpoint(tmp_path / MODEL).card.metrics == pytest.approx(
        load_checkpoint(trained).card.metrics, abs=1e-4
    )


def test_the_licence_of_the_data_behind_the_start_counts_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trained on scenes that forbid commerce, then on others that do not: it stays forbidden."""
    where_the_scenes_say = ("stride = 5", "")
    config = tiny_file(
        tmp_path, ('held_out = ["USA_Peach-2"]', 'held_out = ["1"]'), where_the_scenes_say
    )
    scenes, first = packed_scenes(tmp_path / "scenes.npz", 4), tmp_path / "first"
    command = ["train", "--config", str(config), "--data", str(scenes), "--steps", "1"]
    assert main([*command, "--out", str(first)]) == 0
    (tmp_path / "own").mkdir()
    config = tiny_file(tmp_path / "own")
    command = ["train", "--config", str(config), "--from", str(first / MODEL), "--steps", "1"]
    command += [word for path in DATA for word in ("--data", str(path))]
    capsys.readouterr()
    assert main([*command, "--out", str(tmp_path / "second")]) == 0
    said = capsys.readouterr().out
    assert f"begins with         {first / MODEL}" in said
    assert "non-commercial" in said
    card = load_checkpoint(tmp_path / "second" / MODEL).card
    assert card.non_commercial
    assert "NGSIM" in card.data
    assert "Argoverse" in card.data
    assert f"--from {first / MODEL}" in card.command
    groups = {("Argoverse 1", str(number)) for number in (2, 3, 4)} | {("NGSIM", "USA_Peach-4")}
    assert set(card.trained_on) == {group_digest(*group) for group in groups}


def test_going_on_without_the_start_that_it_had_is_refused(trained: Path, tmp_path: Path) -> None:
    """Else its licence would be forgotten."""
    config = tiny().with_steps(2)
    train(config, tiny_data(), tmp_path, start=open_start(trained, config))
    with pytest.raises(EqrtError, match=r"another data: start \(\d+ there, absent here\)"):
        train(config, tiny_data(), tmp_path, resume=True)
    again = train(config, tiny_data(), tmp_path, start=open_start(trained, config), resume=True)
    assert again.step == 2


def test_a_start_of_another_scene_says_which_fields_differ(trained: Path) -> None:
    other = tiny({"scene": {"lane_choice": "nearest"}})
    with pytest.raises(EqrtError, match=r"another scene: lane_choice \(routes there, nearest"):
        open_start(trained, other)


def test_a_start_of_another_size_says_what_does_not_fit(trained: Path, tmp_path: Path) -> None:
    wider = tiny({"network": {"width": 32}}).with_steps(1)
    with pytest.raises(EqrtError, match="tensors do not fit this network"):
        train(wider, tiny_data(), tmp_path, start=open_start(trained, wider))
