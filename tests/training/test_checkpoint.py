"""Checkpoints come back as they were, or are refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from eqrt.core.errors import EqrtError
from eqrt.training.checkpoint import (
    Card,
    load_checkpoint,
    read_tensors,
    save_checkpoint,
    write_tensors,
)
from eqrt.training.networks.registry import build_network
from eqrt.training.state import new_state, save_state
from tiny_training import tiny

CARD = Card(
    name="tiny",
    data="made up",
    license="Apache-2.0",
    non_commercial=False,
    metrics={"ade_3s": 1.0},
    baseline={"ade_3s": 2.0},
    command="eqrt train --config tiny.toml",
    config_sha256=tiny().sha256,
    parameters=1234,
    steps=100,
    seed=1,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    torch.manual_seed(3)
    save_checkpoint(tmp_path / "m.safetensors", build_network(tiny().model), tiny().model, CARD)
    return tmp_path / "m.safetensors"


def changed_header(path: Path, name: str, old: str, new: str) -> None:
    tensors, header = read_tensors(path)
    assert old in header[name]
    write_tensors(path, tensors, header | {name: header[name].replace(old, new)})


def test_it_comes_back_as_it_was(path: Path) -> None:
    torch.manual_seed(3)
    expected = build_network(tiny().model).state_dict()
    checkpoint = load_checkpoint(path)
    assert checkpoint.card == CARD
    assert checkpoint.config == tiny().model
    assert not checkpoint.network.training
    found = checkpoint.network.state_dict()
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_it_is_a_plain_safetensors_file_whose_header_says_what_it_is(path: Path) -> None:
    header = read_tensors(path)[1]
    assert json.loads(header["config"])["network"]["kind"] == "compact"
    assert json.loads(header["card"])["license"] == "Apache-2.0"


def test_what_is_no_checkpoint_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(EqrtError, match="no such checkpoint"):
        load_checkpoint(tmp_path / "missing.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(EqrtError, match="not a checkpoint") as refused:
        load_checkpoint(tmp_path / "bad.safetensors")
    assert "\n" not in str(refused.value)
    with pytest.raises(EqrtError, match=r"a folder; give the model\.safetensors in it"):
        load_checkpoint(tmp_path)


def test_the_state_of_a_training_is_no_checkpoint(tmp_path: Path) -> None:
    config = tiny()
    state = new_state(config, torch.device("cpu"))
    save_state(tmp_path / "state.safetensors", state, config, {})
    with pytest.raises(EqrtError, match=r"no card in it\); give the model\.safetensors"):
        load_checkpoint(tmp_path / "state.safetensors")


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("config", '"heads"', '"hats"', r"\[network\] has missing or unknown fields: .*hats"),
        ("config", '"compact"', '"oracle"', "kind is 'oracle'"),
        ("card", '"seed"', '"sead"', "card's fields differ: sead, seed"),
        ("config", '"width": 16', '"width": 32', "do not fit this network"),
    ],
)
def test_one_of_another_version_says_what_differs(
    path: Path, name: str, old: str, new: str, said: str
) -> None:
    changed_header(path, name, old, new)
    with pytest.raises(EqrtError, match=said) as refused:
        load_checkpoint(path)
    assert str(path) in str(refused.value)
