"""Checkpoints: one safetensors file with a network, its configuration, and where it comes from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path

import safetensors
import safetensors.torch
from torch import Tensor, nn

from eqrt.core.errors import EqrtError
from eqrt.core.files import write_whole
from eqrt.training.files import writing
from eqrt.training.networks.registry import ModelConfig, build_network


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """What a model card says about where the weights come from."""

    name: str
    data: str
    """Training data and its credits, one sentence per source."""
    license: str
    """Licence of the weights (an SPDX expression, or the terms' name)."""
    non_commercial: bool
    """Whether some of the data forbids commercial use; `eqrt` then says so."""
    metrics: dict[str, float]
    """Measured on the held-out data: metres, and shares in 0 to 1."""
    baseline: dict[str, float]
    """Of constant velocity on the same data."""
    command: str
    """What trained it, as typed."""
    config_sha256: str
    """Of the training configuration (`TrainConfig.sha256`)."""
    parameters: int
    steps: int
    """Optimizer steps behind these weights."""
    seed: int
    recordings: int = 0
    """How many recordings were trained on; 0 in older cards, which do not say."""
    samples: int = 0
    """Windows trained on, each counted as often as it was drawn; 0 likewise."""
    trained_on: tuple[str, ...] = ()
    """The groups of recordings behind these weights (`group_digest`), sorted; empty likewise."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """What `load_checkpoint` reads."""

    network: nn.Module
    config: ModelConfig
    card: Card


def save_checkpoint(path: Path, network: nn.Module, config: ModelConfig, card: Card) -> None:
    """Write the file at once: a reader sees the old one or the new one, never half.

    Raises EqrtError if the disk does not take it.
    """
    header = {"config": json.dumps(config.to_tables()), "card": json.dumps(asdict(card))}
    write_tensors(path, network.state_dict(), header)


def load_checkpoint(path: Path) -> Checkpoint:
    """The network in evaluation mode, float32 on the CPU.

    Raises EqrtError if the file is missing, damaged, or of another version of the network; it names
    the fields that differ.
    """
    tensors, header = read_tensors(path)
    if "card" not in header:
        raise EqrtError(
            f"{path}: not a checkpoint (no card in it); give the model.safetensors that "
            "`eqrt train` writes"
        )
    try:
        tables = json.loads(header["config"])
        config = ModelConfig.from_tables(tables["scene"], tables["network"])
        card = _read_card(header["card"])
        network = build_network(config)
    except (KeyError, ValueError, TypeError) as error:
        raise EqrtError(f"{path}: not a checkpoint of this version ({error})") from error
    load_tensors(path, network, tensors)
    return Checkpoint(network.eval(), config, card)


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: dict[str, str]) -> None:
    """Write a safetensors file and then put it in its place.

    Raises EqrtError if the disk does not take it.
    """
    ready = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, safetensors.torch.save(ready, metadata=header))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a safetensors file, on the CPU, and its header.

    Raises EqrtError if it is missing or damaged.
    """
    if path.is_dir():
        raise EqrtError(f"{path}: a folder; give the model.safetensors in it")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            names = file.keys()
            return {name: file.get_tensor(name) for name in names}, file.metadata() or {}
    except FileNotFoundError as error:
        raise EqrtError(f"{path}: no such checkpoint; `eqrt train` writes one") from error
    except (OSError, safetensors.SafetensorError) as error:
        raise EqrtError(f"{path}: not a checkpoint ({error})") from error


def load_tensors(path: Path, network: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Fill `network` with `tensors`; EqrtError says which of them do not fit."""
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    wrong = sorted(name for name in expected | found if expected.get(name) != found.get(name))
    if wrong:
        raise EqrtError(
            f"{path}: {len(wrong)} tensors do not fit this network (first: {wrong[0]}, "
            f"found {found.get(wrong[0])}, expected {expected.get(wrong[0])}); train again"
        )
    network.load_state_dict(tensors)


def _read_card(text: str) -> Card:
    values = json.loads(text)
    known = {field.name for field in fields(Card)}
    needed = {field.name for field in fields(Card) if field.default is MISSING}
    wrong = sorted((needed - set(values)) | (set(values) - known))
    if wrong:
        raise ValueError(f"the card's fields differ: {', '.join(wrong)}")
    values["trained_on"] = tuple(values.get("trained_on", ()))
    return Card(**values)
