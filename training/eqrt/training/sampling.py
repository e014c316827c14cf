"""Which windows a step trains on: a pure function of the seed and the step.

Epochs follow each other without a seam: sample number i of the whole training is the i-th entry of
all epochs' orders put end to end, and step s takes the next `batch_size` of them. So a resumed
training, or several processes that share one, need to remember nothing.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import EqrtError
from eqrt.training.dataset.windows import Windows

Rows = NDArray[np.intp]

ORDER, NOISE, DROPOUT = range(3)
"""What a derived seed is for: the first of its numbers, so that no two uses share one."""


def derived_seed(*parts: int) -> int:
    """A seed of its own for every tuple of numbers that are not negative."""
    return int(np.random.SeedSequence(parts).generate_state(1, np.uint64)[0] >> np.uint64(1))


class WindowSource(Protocol):
    """Where windows are gathered from: an opened dataset, or memory."""

    def gather(self, rows: Rows) -> Windows:
        """The windows `rows`, in this order, copied."""

    def checksum(self) -> int:
        """The same for the same windows, and hardly ever for others. Takes no reading of all."""


@dataclass(frozen=True, slots=True)
class InMemory:
    """Windows that are already there."""

    windows: Windows

    def gather(self, rows: Rows) -> Windows:
        """Copies of the windows `rows`."""
        return self.windows.select(rows)

    def checksum(self) -> int:
        """Of all of them."""
        return self.windows.checksum()


@dataclass(frozen=True, slots=True)
class Pool:
    """The rows of a source that are trained on, and how often each is drawn in an epoch."""

    source: WindowSource
    rows: Rows
    """(W,)"""
    weights: NDArray[np.float64]
    """(W,)"""

    @classmethod
    def of(cls, windows: Windows) -> Pool:
        """Windows in memory, each of them once an epoch."""
        return cls(InMemory(windows), np.arange(len(windows)), np.ones(len(windows)))

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def samples_per_epoch(self) -> int:
        """Windows drawn in an epoch, some of them perhaps twice and others not at all."""
        return max(round(float(self.weights.sum())), 1)

    def gather(self, members: Rows) -> Windows:
        """The windows number `members` of the pool, in this order."""
        return self.source.gather(self.rows[members])

    def fingerprint(self) -> dict[str, int]:
        """The same for the same windows, drawn as often, and hardly ever for others."""
        checksum = zlib.crc32(self.weights.tobytes(), zlib.crc32(self.rows.tobytes()))
        return {"windows": len(self), "checksum": checksum, "content": self.source.checksum()}


class Sampler:
    """Says which members of a pool belong to which step."""

    def __init__(self, pool: Pool, batch_size: int, seed: int) -> None:
        if not pool.weights.sum() > 0.0:
            raise EqrtError(
                f"{len(pool)} training windows, none of which is ever drawn; see the weights in "
                "[data], and which recordings are held out"
            )
        self._weights = pool.weights
        self._batch_size = batch_size
        self._seed = seed
        self._length = pool.samples_per_epoch
        self._order = lru_cache(maxsize=2)(self._new_order)  # a batch may end one and begin another

    def members(self, step: int) -> Rows:
        """(batch_size,) members of the pool, those of step `step`."""
        samples = np.arange(step * self._batch_size, (step + 1) * self._batch_size)
        epoch, place = np.divmod(samples, self._length)
        parts = [self._order(int(e))[place[epoch == e]] for e in np.unique(epoch)]
        return np.concatenate(parts)

    def _new_order(self, epoch: int) -> Rows:
        """Weight w draws a window floor(w) or ceil(w) times, w times on average; shuffled.

        Systematic sampling: the windows lie in random order on a line, each as long as its weight,
        and a comb with teeth 1 apart falls on it.
        """
        random = np.random.default_rng(derived_seed(ORDER, self._seed, epoch))
        lined_up = random.permutation(len(self._weights))
        ends = np.cumsum(self._weights[lined_up])
        spacing = ends[-1] / self._length  # 1, but for the rounding of the sum
        teeth = (np.arange(self._length) + random.random()) * spacing
        drawn = np.minimum(np.searchsorted(ends, teeth, side="right"), len(ends) - 1)
        return random.permutation(lined_up[drawn])
