"""A training that takes seconds: a small network, one recording to learn from, one held out."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from eqrt.training.checkpoint import read_tensors
from eqrt.training.configuration import TrainConfig
from eqrt.training.training_data import TrainingData, open_training_data
from source_tree import ROOT

NGSIM = ROOT / "tests/data/ngsim"
DATA = (NGSIM / "USA_Peach-4_8_T-1.xml.gz", NGSIM / "USA_Peach-2_1_T-1.xml.gz")
"""The second is held out."""

_SHIPPED = (ROOT / "training/configs/eqrt-free.toml").read_text(encoding="utf-8")
AUGMENT = _SHIPPED[_SHIPPED.index("[augment]") :]
"""Every distortion there is."""

TOML = f"""
name = "tiny"

[scene]
num_agents = 3
history_steps = 20
num_centerlines = 2
centerline_points = 8
lane_choice = "routes"
horizon_steps = 30
num_modes = 1
dt_s = 0.1

[network]
kind = "compact"
width = 16
hidden = 32
heads = 2
layers = 1
dropout = 0.1

[data]
targets = "all"
stride = 5
held_out = ["USA_Peach-2"]

[train]
steps = 100
batch_size = 16
optimizer = "adamw"
learning_rate = 2e-3
weight_decay = 5e-2
schedule = "cosine"
warmup_steps = 10
max_grad_norm = 1.0
average_decay = 0.9
loss = "best_mode"
evaluate_every = 25
seed = 1

{AUGMENT}
"""


def tiny(changes: Mapping[str, Mapping[str, Any]] | None = None) -> TrainConfig:
    """The configuration, with other values in some of its tables."""
    tables = tomllib.loads(TOML)
    for table, values in (changes or {}).items():
        tables[table] |= values
    return TrainConfig.from_tables(tables)


def tiny_file(folder: Path, *replacements: tuple[str, str]) -> Path:
    """The configuration as a file, some lines replaced."""
    text = TOML
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    path = folder / "tiny.toml"
    path.write_text(text, encoding="utf-8")
    return path


@lru_cache(maxsize=1)
def tiny_data() -> TrainingData:
    """What it is trained and measured on."""
    return open_training_data(tiny(), DATA)


def same_tensors(one: Path, other: Path) -> bool:
    """Whether two safetensors files hold the same bits under the same names."""
    (a, _), (b, _) = read_tensors(one), read_tensors(other)
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
