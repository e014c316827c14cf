"""Several processes that train one network: what `torchrun` starts, or one process alone.

Each process (rank) trains on an equal slice of every batch, so the mean of the ranks' losses and
gradients is that of the whole batch. Rank 0 alone evaluates, prints and writes.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from eqrt.core.errors import UsageError

PATIENCE = timedelta(hours=2)
"""How long the others wait while rank 0 evaluates, at most."""


@dataclass(frozen=True, slots=True)
class Ranks:
    """This process among the others."""

    device: torch.device
    rank: int = 0
    world: int = 1
    votes: dist.ProcessGroup | None = None
    """A group on the CPU, to agree on when to stop without waiting for the accelerator."""

    @property
    def leads(self) -> bool:
        """Whether this process is the one that writes."""
        return self.rank == 0

    def parallel(self, network: nn.Module) -> nn.Module:
        """`network`, its gradients averaged over the ranks."""
        if self.world == 1:
            return network
        devices = [self.device] if self.device.type == "cuda" else None
        # The ADE of one mode, for one, leaves the head of the probabilities without a gradient.
        return DistributedDataParallel(network, devices, find_unused_parameters=True)

    def mean(self, values: Tensor) -> Tensor:
        """The mean of every rank's `values`; NaN if one is."""
        if self.world > 1:
            dist.all_reduce(values)
            values = values / self.world
        return values

    def any(self, flag: bool) -> bool:
        """Whether `flag` is set in any rank: all of them hear the same answer."""
        if self.world == 1:
            return flag
        votes = torch.tensor(int(flag))
        dist.all_reduce(votes, dist.ReduceOp.MAX, self.votes)
        return bool(votes.item())


def alone(device: str = "cpu") -> Ranks:
    """A process that trains by itself."""
    return Ranks(torch.device(device))


@contextlib.contextmanager
def join_ranks(device: str) -> Iterator[Ranks]:
    """Take the place that `torchrun` gave this process, if it did.

    Raises UsageError if there is no such device.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: PyTorch finds no CUDA device here; try --device cpu")
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield alone(device)
        return
    here = torch.device(f"cuda:{os.environ['LOCAL_RANK']}" if device == "cuda" else device)
    if device == "cuda":
        torch.cuda.set_device(here)
    dist.init_process_group("nccl" if device == "cuda" else "gloo", timeout=PATIENCE)
    try:
        votes = dist.new_group(backend="gloo", timeout=PATIENCE)
        yield Ranks(here, dist.get_rank(), world, votes)
    finally:
        dist.destroy_process_group()
