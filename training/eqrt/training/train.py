"""`eqrt train`: train a predictor on recorded scenarios.

A plain loop: seed, data, model, then steps. The weights kept are a running average of the weights
trained (which evaluates better than any single step of it).
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch.optim import AdamW

from eqrt.core.errors import EqrtError, UsageError
from eqrt.training.augment import AugmentConfig, augment
from eqrt.training.checkpoint import Card, save_checkpoint
from eqrt.training.config import ModelConfig
from eqrt.training.data import Windows, batches, load_windows, scenario_files, scenario_name
from eqrt.training.evaluate import INPUTS, evaluate, evaluate_constant_velocity
from eqrt.training.losses import best_mode_loss
from eqrt.training.model import EquivariantPredictor


@dataclass(frozen=True, slots=True, kw_only=True)
class DataConfig:
    """Which scenarios, and which of them are held out."""

    held_out: list[str]
    """Scenario names (without .xml) that are evaluated on and never trained on."""
    stride: int
    """Steps between training windows."""
    credits: str
    license: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """How the network is trained."""

    steps: int
    batch_size: int
    learning_rate: float
    weight_decay: float
    warmup_steps: int
    max_grad_norm: float
    average_decay: float
    """Of the running average of the weights, per step."""
    evaluate_every: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """A configuration file: [model], [data], [train], [augment]."""

    name: str
    model: ModelConfig
    data: DataConfig
    train: LoopConfig
    augment: AugmentConfig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt train`."""
    parser.add_argument(
        "--config", type=Path, required=True, help="TOML file, see training/configs"
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of CommonRoad scenarios")
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoint and metrics")
    parser.add_argument("--steps", type=int, help="instead of the configuration's")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default 1)")


def run(args: argparse.Namespace) -> int:
    """Train, evaluate, save."""
    torch.set_num_threads(args.threads)
    config = load_config(args.config)
    steps = args.steps or config.train.steps
    training, held_out = load_data(config, args.data)
    course = evaluate_constant_velocity(held_out, config.model.dt_s)
    print(f"constant velocity   {_row(course)}", flush=True)
    model = train(config, training, held_out, steps, args.out)
    metrics = evaluate(model, held_out)
    print(f"held out            {_row(metrics)}")
    card = Card(
        name=config.name,
        data=config.data.credits,
        license=config.data.license,
        metrics=metrics,
        baseline=course,
    )
    save_checkpoint(args.out / "model.safetensors", model, card)
    print(f"checkpoint          {args.out / 'model.safetensors'}")
    return 0


def load_config(path: Path) -> TrainConfig:
    """Read a configuration; EqrtError names the first field that is missing or unknown."""
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such configuration; see training/configs") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise EqrtError(f"{path}: not TOML ({error})") from error
    tables = {"model": ModelConfig, "data": DataConfig, "train": LoopConfig}
    tables |= {"augment": AugmentConfig}
    parsed = {name: _table(kind, values.pop(name, {}), path, name) for name, kind in tables.items()}
    config: TrainConfig = _table(TrainConfig, values | parsed, path, "top level")
    return config


def load_data(config: TrainConfig, folder: Path) -> tuple[Windows, Windows]:
    """Training and held-out windows, split by recording."""
    files = {scenario_name(path): path for path in scenario_files(folder)}
    missing = sorted(set(config.data.held_out) - set(files))
    if missing:
        raise EqrtError(f"{folder}: held-out scenario {missing[0]} is not here")
    contract = config.model.contract(config.name, "0.0.0")
    train_files = [path for name, path in files.items() if name not in config.data.held_out]
    if not train_files:
        raise EqrtError(f"{folder}: every scenario here is held out; nothing to train on")
    held_files = [files[name] for name in config.data.held_out]
    training = load_windows(train_files, contract, config.data.stride)
    held_out = load_windows(held_files, contract, config.data.stride)
    print(f"training windows    {len(training)} of {len(train_files)} scenarios")
    print(f"held-out windows    {len(held_out)} of {len(held_files)} scenarios", flush=True)
    return training, held_out


def train(
    config: TrainConfig, training: Windows, held_out: Windows, steps: int, out: Path
) -> EquivariantPredictor:
    """The loop. Returns the averaged network; `out` receives `metrics.jsonl`."""
    loop = config.train
    torch.manual_seed(loop.seed)
    generator = torch.Generator().manual_seed(loop.seed)
    model = EquivariantPredictor(config.model)
    average = copy.deepcopy(model)
    optimizer = AdamW(model.parameters(), loop.learning_rate, weight_decay=loop.weight_decay)
    stream = batches(training, loop.batch_size, generator)
    out.mkdir(parents=True, exist_ok=True)
    started, running = time.perf_counter(), 0.0
    with (out / "metrics.jsonl").open("w", encoding="utf-8") as log:
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = loop.learning_rate * schedule(step, steps, loop.warmup_steps)
            batch = augment(next(stream), config.augment, generator)
            model.train()
            trajectories, probabilities = model(*(batch[name] for name in INPUTS))
            loss = best_mode_loss(
                trajectories, probabilities, batch["future"], batch["future_valid"]
            )
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
            torch.nn.utils.clip_grad_norm_(model.parameters(), loop.max_grad_norm)
            optimizer.step()
            update_average(average, model, loop.average_decay)
            running = loss.item() if step == 0 else 0.98 * running + 0.02 * loss.item()
            if (step + 1) % loop.evaluate_every == 0 or step + 1 == steps:
                metrics = evaluate(average, held_out)
                seconds = time.perf_counter() - started
                print(
                    f"step {step + 1:>6} loss {running:.3f} {_row(metrics)} {seconds:.0f} s",
                    flush=True,
                )
                log.write(json.dumps({"step": step + 1, "loss": running, **metrics}) + "\n")
                log.flush()
    return average.eval()


def update_average(average: torch.nn.Module, model: torch.nn.Module, decay: float) -> None:
    """Move the averaged weights a little towards the trained ones, in place."""
    with torch.no_grad():
        for mean, weight in zip(average.parameters(), model.parameters(), strict=True):
            mean.lerp_(weight, 1.0 - decay)


def schedule(step: int, steps: int, warmup_steps: int) -> float:
    """Linear warm-up, then half a cosine down to zero: a factor on the learning rate."""
    if step < warmup_steps:
        return (step + 1) / warmup_steps
    return 0.5 * (1.0 + math.cos(math.pi * (step - warmup_steps) / max(steps - warmup_steps, 1)))


def _table(kind: type[Any], values: object, path: Path, where: str) -> Any:
    names = {field.name for field in fields(kind)}
    if not isinstance(values, dict) or set(values) != names:
        found = set(values) if isinstance(values, dict) else set()
        wrong = ", ".join(sorted(names ^ found))
        raise EqrtError(f"{path}: [{where}] has missing or unknown fields: {wrong}")
    return kind(**values)


def _row(metrics: dict[str, float]) -> str:
    return " ".join(f"{name} {value:.3f}" for name, value in metrics.items())
