"""A training run as a TOML file: what is trained, on which windows, and how.

Tables: [scene] and [network] (`eqrt.training.networks`), [data], [train] and, for training on
distorted windows, [augment].
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from eqrt.core.errors import EqrtError, UsageError
from eqrt.training.augment import AugmentConfig
from eqrt.training.dataset.windows import WindowOptions
from eqrt.training.losses import LOSSES
from eqrt.training.networks.registry import ModelConfig
from eqrt.training.tables import (
    BoundedCount,
    Count,
    NotNegative,
    PartialShare,
    Positive,
    check_names,
    fill,
)

Tables = dict[str, Any]
MAX_SEED = 2**63 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class DataConfig:
    """Which windows are cut, which are held out, and how often each is drawn. Table [data]."""

    targets: Literal["focal", "complete", "all"] | None = None
    """Whose windows (`WindowOptions`)."""
    stride: Count | None = None
    """Steps between windows (`WindowOptions`). Without either, prepared data is taken as it is."""
    held_out: tuple[str, ...] = ()
    """Recordings or groups to evaluate on and never train on (`Split`); empty = the data's own."""
    train_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 1.0
    """Of the groups of recordings that are not held out, how many to train on: how much do fewer
    cost? Drawn by their names, so that a smaller share is part of a larger one."""
    focal_weight: NotNegative = 1.0
    """How often in an epoch a window of the dataset's own targets is drawn, on average."""
    driving_weight: NotNegative = 1.0
    """Likewise one of another target that moves MIN_DRIVE_M or more while it is seen."""
    standing_weight: NotNegative = 1.0
    """Likewise all the rest. Most of recorded traffic is parked, and easy."""
    cut_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 1.0
    """Of these, so much for a window that its recording cuts off: that ends before the horizon
    does, or had begun no more than half a history before. Models are measured on whole windows,
    and the end of the horizon, the hardest part, is learned from windows that reach it."""

    def window_options(self) -> WindowOptions | None:
        """For the cutter; None = nothing is asked for."""
        if self.targets is None and self.stride is None:
            return None
        return WindowOptions(stride=self.stride, targets=self.targets or "all")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """How the network is trained. Table [train]; either `steps` or `epochs`."""

    steps: Count | None = None
    epochs: Positive | None = None
    batch_size: BoundedCount
    """Windows per step, those of all processes together."""
    optimizer: Literal["adam", "adamw", "muon"]
    learning_rate: Positive
    weight_decay: NotNegative
    """On matrices only: biases and scales are few and mean something."""
    schedule: Literal["cosine", "constant"]
    """Of the learning rate, after the warm-up."""
    warmup_steps: Annotated[int, msgspec.Meta(ge=0)]
    max_grad_norm: Positive
    average_decay: PartialShare
    """Of the running average of the weights, per step; 0 = no averaging."""
    loss: str
    """A key of `eqrt.training.losses.LOSSES`."""
    evaluate_every: Count
    """Steps; as often, checkpoint and state are written."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=MAX_SEED)]
    precision: Literal["float32", "bf16"] = "float32"

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.epochs is None):
            raise ValueError("give either steps or epochs")
        if self.loss not in LOSSES:
            raise ValueError(f"loss is {self.loss!r}, expected one of {', '.join(LOSSES)}")

    def total_steps(self, samples_per_epoch: int) -> int:
        """Optimizer steps of the whole training."""
        if self.steps is not None:
            return self.steps
        assert self.epochs is not None  # __post_init__
        return math.ceil(self.epochs * samples_per_epoch / self.batch_size)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """A configuration file."""

    name: str
    model: ModelConfig
    data: DataConfig
    train: LoopConfig
    augment: AugmentConfig | None
    """None = windows as they were recorded."""

    @classmethod
    def from_tables(cls, tables: Tables) -> TrainConfig:
        """Raises ValueError that names the table and what is missing, unknown or wrong in it."""
        check_names("top level", set(tables), _NEEDED, _NEEDED | {"augment"})
        if not isinstance(tables["name"], str):
            raise ValueError(f"name is {tables['name']!r}, expected a text")
        config = cls(
            name=tables["name"],
            model=ModelConfig.from_tables(tables["scene"], tables["network"]),
            data=fill(DataConfig, tables["data"], "data"),
            train=fill(LoopConfig, tables["train"], "train"),
            augment=fill(AugmentConfig, tables["augment"], "augment")
            if "augment" in tables
            else None,
        )
        modes = config.model.scene.num_modes
        if config.train.loss == "ade" and modes > 1:
            raise ValueError(f"[train] loss 'ade' trains one mode, [scene] has {modes}; best_mode?")
        return config

    def to_tables(self) -> Tables:
        """What `from_tables` reads."""
        tables = {"name": self.name, **self.model.to_tables()}
        tables |= {"data": _given(self.data), "train": _given(self.train)}
        return tables if self.augment is None else tables | {"augment": asdict(self.augment)}

    @property
    def sha256(self) -> str:
        """Of everything in it, in one spelling."""
        text = json.dumps(self.to_tables(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def with_steps(self, steps: int) -> TrainConfig:
        """The same for another length."""
        return replace(self, train=replace(self.train, steps=steps, epochs=None))

    def with_seed(self, seed: int) -> TrainConfig:
        """The same for other random numbers."""
        return replace(self, train=replace(self.train, seed=seed))

    def with_train_share(self, share: float) -> TrainConfig:
        """The same on another share of the recordings."""
        return replace(self, data=replace(self.data, train_share=share))


_NEEDED = {"name", "scene", "network", "data", "train"}


def load_config(path: Path) -> TrainConfig:
    """Read a configuration; EqrtError names the file and the first field that is wrong."""
    try:
        return TrainConfig.from_tables(tomllib.loads(path.read_text(encoding="utf-8-sig")))
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such configuration; see training/configs") from error
    except OSError as error:
        raise UsageError(f"{path}: not a readable file ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise EqrtError(f"{path}: not TOML ({error})") from error
    except ValueError as error:
        raise EqrtError(f"{path}: {error}") from error


def differences(there: Tables, here: Tables) -> list[str]:
    """One phrase for every field that two configurations do not share."""
    one, other = _flat(there), _flat(here)
    return [
        f"{name} ({one.get(name, 'absent')} there, {other.get(name, 'absent')} here)"
        for name in sorted(one | other)
        if one.get(name) != other.get(name)
    ]


def _given(config: DataConfig | LoopConfig) -> Tables:
    """The fields that have a value, as TOML and JSON would hold them."""
    values = {name: value for name, value in asdict(config).items() if value is not None}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}


def _flat(tables: Tables) -> Tables:
    flat: Tables = {}
    for name, value in tables.items():
        if isinstance(value, dict):
            flat |= {f"[{name}] {key}": item for key, item in value.items()}
        else:
            flat[name] = value
    return flat
