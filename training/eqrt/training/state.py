"""Everything a training must remember to go on as if it had never stopped.

That is the weights, their running average, the optimizer's moments, the step, and the running loss.
There is no state of random numbers: batches and dropout are seeded by (seed, step).
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.optim import Adam, AdamW, Optimizer
from torch.optim.swa_utils import get_ema_multi_avg_fn

from eqrt.core.errors import EqrtError
from eqrt.training.checkpoint import load_tensors, read_tensors, write_tensors
from eqrt.training.configuration import LoopConfig, TrainConfig, differences
from eqrt.training.muon import Muon
from eqrt.training.networks.registry import build_network


@dataclass(slots=True)
class TrainingState:
    """A training between two steps."""

    network: nn.Module
    """As it is trained."""
    average: nn.Module
    """The running average of its weights, which is what evaluates well; in evaluation mode."""
    optimizer: Optimizer
    step: int = 0
    """Steps done."""
    loss: float | None = None
    """Running mean; None before the first step."""


def new_state(config: TrainConfig, device: torch.device) -> TrainingState:
    """A network with random weights, drawn with the configuration's seed."""
    torch.manual_seed(config.train.seed)
    network = build_network(config.model).to(device)
    average = copy.deepcopy(network).eval()  # trained by `update_average` only
    return TrainingState(network, average, new_optimizer(network, config.train))


def new_optimizer(network: nn.Module, config: LoopConfig) -> Optimizer:
    """Weight decay on matrices only. Muon hands everything but hidden matrices to AdamW."""
    if config.optimizer == "muon":
        return Muon(network, config.learning_rate, config.weight_decay)
    parameters = [weight for weight in network.parameters() if weight.requires_grad]
    groups = [
        {
            "params": [weight for weight in parameters if weight.dim() >= 2],
            "weight_decay": config.weight_decay,
        },
        {"params": [weight for weight in parameters if weight.dim() < 2], "weight_decay": 0.0},
    ]
    groups = [group for group in groups if group["params"]]
    kind = Adam if config.optimizer == "adam" else AdamW
    # Fused is several times faster on a CPU, where each small operation costs; on a GPU the default
    # is about as fast, and leaves the count of steps on the CPU (`_beside`).
    on_cpu = all(weight.device.type == "cpu" for weight in parameters)
    return kind(groups, lr=config.learning_rate, fused=on_cpu or None)


def update_average(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Move the averaged weights (and buffers) a little towards the trained ones, in place."""
    mean, new = list(average.state_dict().values()), list(network.state_dict().values())
    smooth = [(m, n) for m, n in zip(mean, new, strict=True) if m.is_floating_point()]
    counts = [(m, n) for m, n in zip(mean, new, strict=True) if not m.is_floating_point()]
    blend = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    blend([m for m, _ in smooth], [n for _, n in smooth], None)
    for m, n in counts:
        m.copy_(n)


def save_state(
    path: Path, state: TrainingState, config: TrainConfig, pool: Mapping[str, int]
) -> None:
    """Write the state at once. `pool` says what it trains on, so that a change is noticed."""
    header = {
        "step": json.dumps(state.step),
        "loss": json.dumps(state.loss),
        "config": json.dumps(config.to_tables()),
        "data": json.dumps(pool),
        "torch": torch.__version__,
    }
    tensors = _prefixed("network", state.network.state_dict())
    tensors |= _prefixed("average", state.average.state_dict())
    for name, weight in state.network.named_parameters():
        moments = state.optimizer.state.get(weight, {})
        tensors |= _prefixed(f"optimizer.{name}", moments)
    write_tensors(path, tensors, header)


def load_state(
    path: Path, state: TrainingState, config: TrainConfig, pool: Mapping[str, int]
) -> None:
    """Bring `state` to where the file left off.

    Raises EqrtError if the file is damaged, or of another configuration or other data; it says
    which fields differ.
    """
    tensors, header = read_tensors(path)
    try:
        there = TrainConfig.from_tables(json.loads(header["config"])).to_tables()
        data = json.loads(header["data"])
        step, loss = json.loads(header["step"]), json.loads(header["loss"])
    except (KeyError, ValueError) as error:
        raise EqrtError(f"{path}: not a training state of this version ({error})") from error
    _check_same(path, "configuration", differences(there, config.to_tables()))
    _check_same(path, "data", differences(data, dict(pool)))
    load_tensors(path, state.network, _unprefixed("network", tensors))
    load_tensors(path, state.average, _unprefixed("average", tensors))
    for name, weight in state.network.named_parameters():
        if moments := _unprefixed(f"optimizer.{name}", tensors):
            state.optimizer.state[weight] = _beside(weight, moments)
    state.step, state.loss = step, loss


def _check_same(path: Path, what: str, different: list[str]) -> None:
    if different:
        raise EqrtError(
            f"{path}: is of another {what}: {'; '.join(different)}; make them the same, or start "
            "anew with another --out"
        )


def _beside(weight: Tensor, moments: dict[str, Tensor]) -> dict[str, Tensor]:
    """The moments on the weight's device; the step count stays on the CPU, as Adam has it."""
    return {k: v if k == "step" else v.to(weight.device) for k, v in moments.items()}


def _prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {f"{prefix}.{name}": tensor for name, tensor in tensors.items()}


def _unprefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    start = prefix + "."
    return {n.removeprefix(start): t for n, t in tensors.items() if n.startswith(start)}
