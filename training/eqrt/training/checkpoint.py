"""Checkpoints: one safetensors file, the configuration and the data's credits in its header."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch

from eqrt.core.errors import EqrtError
from eqrt.training.config import ModelConfig
from eqrt.training.model import EquivariantPredictor


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """What a model card says about where the weights come from."""

    name: str
    data: str
    """Training data, credits and licence, one sentence."""
    license: str
    """Licence of the weights (an SPDX expression)."""
    metrics: dict[str, float]
    """Measured on the held-out data, metres."""
    baseline: dict[str, float]
    """Of constant velocity on the same data."""


def save_checkpoint(path: Path, model: EquivariantPredictor, card: Card) -> None:
    """Write the file at once: a reader sees the old one or the new one, never half."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"config": json.dumps(asdict(model.config)), "card": json.dumps(asdict(card))}
    tensors = {name: value.contiguous() for name, value in model.state_dict().items()}
    partial = path.with_suffix(path.suffix + ".part")
    safetensors.torch.save_file(tensors, partial, metadata=header)
    os.replace(partial, path)


def load_checkpoint(path: Path) -> tuple[EquivariantPredictor, Card]:
    """The network in evaluation mode, float32 on the CPU.

    Raises EqrtError if the file is missing, damaged, or of another version of the network.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no iterator)
        model = EquivariantPredictor(_read(ModelConfig, header["config"]))
        card = _read(Card, header["card"])
    except FileNotFoundError as error:
        raise EqrtError(f"{path}: no such checkpoint; `eqrt train` writes one") from error
    except (OSError, safetensors.SafetensorError, KeyError, ValueError, TypeError) as error:
        raise EqrtError(f"{path}: not a checkpoint of this version ({error})") from error
    _check_tensors(path, model, tensors)
    model.load_state_dict(tensors)
    return model.eval(), card


def _read(kind: type[Any], text: str) -> Any:
    values = json.loads(text)
    names = {field.name for field in fields(kind)}
    if set(values) != names:
        raise ValueError(f"{kind.__name__} fields differ: {sorted(set(values) ^ names)}")
    return kind(**values)


def _check_tensors(
    path: Path, model: EquivariantPredictor, tensors: dict[str, torch.Tensor]
) -> None:
    expected = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    wrong = sorted(name for name in expected | found if expected.get(name) != found.get(name))
    if wrong:
        raise EqrtError(
            f"{path}: {len(wrong)} tensors do not fit this network (first: {wrong[0]}, "
            f"found {found.get(wrong[0])}, expected {expected.get(wrong[0])}); train again"
        )
