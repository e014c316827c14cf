"""Batches, made ahead of the training by threads.

A batch is a pure function of the seed and the step, so it does not matter which thread makes it, or
in which process: each process of a training makes its slice of the batch and gets what the others
expect. Noise is drawn for blocks of BLOCK samples, so that a slice need not make the whole batch.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

import torch

from eqrt.training.augment import AugmentConfig, Batch, augment
from eqrt.training.sampling import NOISE, Pool, Rows, Sampler, derived_seed

BLOCK = 64
"""Samples that share a noise generator."""


@dataclass(frozen=True, slots=True)
class BatchMaker:
    """Makes the part of a step's batch that one of `world` processes trains on."""

    pool: Pool
    sampler: Sampler
    augmentation: AugmentConfig | None
    batch_size: int
    """Of all processes together; a multiple of `world`."""
    seed: int
    rank: int = 0
    world: int = 1

    def __call__(self, step: int) -> Batch:
        """The windows of `step`, augmented: tensors of batch_size / world rows."""
        share = self.batch_size // self.world
        first, last = self.rank * share, (self.rank + 1) * share
        members = self.sampler.members(step)
        blocks = range(first // BLOCK, -(-last // BLOCK))
        parts = [self._block(step, b, members[b * BLOCK : (b + 1) * BLOCK]) for b in blocks]
        begin = first - blocks.start * BLOCK
        return {
            name: torch.cat([part[name] for part in parts])[begin : begin + share]
            for name in parts[0]
        }

    def _block(self, step: int, block: int, members: Rows) -> Batch:
        batch = self.pool.gather(members).tensors()
        if self.augmentation is None:
            return batch
        generator = torch.Generator().manual_seed(derived_seed(NOISE, self.seed, step, block))
        return augment(batch, self.augmentation, generator)


@dataclass(frozen=True, slots=True)
class LoaderTimes:
    """What the loader did so far."""

    samples: int = 0
    """Made."""
    busy_s: float = 0.0
    """Time that its threads took to make them, together."""
    waited_s: float = 0.0
    """Time that the training waited for a batch."""


class Loader:
    """Batches of steps `first` to `last` - 1 in order, on `device`; to be used in a `with` block.

    An exception in a thread is raised where its batch would have been.
    """

    def __init__(
        self,
        make: Callable[[int], Batch],
        first: int,
        last: int,
        threads: int,
        device: torch.device,
    ) -> None:
        self._make = make
        self._device = device
        self._threads = threads
        self._steps: Iterator[int] = iter(range(first, last))
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix="eqrt-loader")
        self._ahead: deque[Future[tuple[Batch, float]]] = deque()
        self.times = LoaderTimes()

    def __enter__(self) -> Self:
        for _ in range(2 * self._threads):  # one each in the making, and one each ready
            self._submit()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._executor.shutdown(wait=True, cancel_futures=True)

    def __iter__(self) -> Iterator[Batch]:
        while self._ahead:
            asked = time.perf_counter()
            batch, busy_s = self._ahead.popleft().result()
            waited_s = time.perf_counter() - asked
            self._submit()
            self.times = replace(
                self.times,
                samples=self.times.samples + len(batch["future"]),
                busy_s=self.times.busy_s + busy_s,
                waited_s=self.times.waited_s + waited_s,
            )
            yield {n: tensor.to(self._device, non_blocking=True) for n, tensor in batch.items()}

    def _submit(self) -> None:
        if (step := next(self._steps, None)) is not None:
            self._ahead.append(self._executor.submit(self._timed, step))

    def _timed(self, step: int) -> tuple[Batch, float]:
        began = time.perf_counter()
        batch = self._make(step)
        if self._device.type == "cuda":  # pinned memory is copied while the device computes
            batch = {name: tensor.pin_memory() for name, tensor in batch.items()}
        return batch, time.perf_counter() - began
