"""How cold a core goes while it waits, though it waits busily: who else uses its caches?

A program on a core of its own finds in the caches what it left there 30 ms ago. Beside another
program, or another guest of the same host that no counter here shows, it does not.
"""

from __future__ import annotations

from statistics import median

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.bench.schedule import CLOCK

_BYTES = 16 * 1024
"""Half of a small first-level cache."""
_WAIT_NS = 30_000_000
_TIMES = 25


def cooling() -> float:
    """How many times as long a sum of 16 KiB takes after 30 ms as at once: medians, in 0.8 s."""
    numbers = np.ones(_BYTES // 8)
    return round(_sum_ns(numbers, _WAIT_NS) / max(_sum_ns(numbers, 0), 1.0), 1)


def _sum_ns(numbers: NDArray[np.float64], wait_ns: int) -> float:
    return median(_once_ns(numbers, wait_ns) for _ in range(_TIMES))


def _once_ns(numbers: NDArray[np.float64], wait_ns: int) -> int:
    until_ns = CLOCK() + wait_ns
    while CLOCK() < until_ns:
        pass
    begun_ns = CLOCK()
    numbers.sum()
    return CLOCK() - begun_ns
