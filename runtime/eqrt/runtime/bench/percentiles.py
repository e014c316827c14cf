"""Percentiles that can be stood behind: given only with enough samples, with intervals.

The rule. A percentile is given if at least two samples lie beyond its true value with 99 %
confidence: then it does not hang on the single slowest sample. Of n independent samples the number
beyond the p-quantile is binomial, so n must satisfy p^n + n (1 - p) p^(n - 1) <= 0.01:
11 samples for p50, 64 for p90, 662 for p99, 6,636 for p99.9.

The value is the nearest rank: the smallest sample that at least that share of all samples does not
exceed; something that was measured, not interpolated. The interval around it are two samples that
enclose the true value with 99 % confidence, whatever the distribution (order statistics). Samples
of one run are not quite independent, so it is, if anything, too narrow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from math import exp, lgamma, log, log1p

import numpy as np
from numpy.typing import NDArray

Int64 = NDArray[np.int64]

CONFIDENCE = 0.99
"""Of the sample-size rule and of the intervals."""
PERCENTILES = {"p50": 5_000, "p90": 9_000, "p99": 9_900, "p99.9": 9_990}
"""Name -> ten-thousandths; whole numbers, because 0.29 * 100 is not 29."""
_WHOLE = 10_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """One percentile, nanoseconds."""

    value_ns: int
    low_ns: int
    """The true value lies between these two with CONFIDENCE."""
    high_ns: int


def estimates(samples_ns: Int64) -> dict[str, Estimate]:
    """The percentiles that (n,) samples are enough for, by name."""
    ordered = np.sort(samples_ns)
    return dict(_estimates(ordered))


@cache
def samples_needed(name: str) -> int:
    """The fewest samples that the percentile `name` is given for."""
    share = PERCENTILES[name] / _WHOLE
    low, high = 1, 1
    while _at_most_one_beyond(high, share) > 1.0 - CONFIDENCE:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        enough = _at_most_one_beyond(middle, share) <= 1.0 - CONFIDENCE
        low, high = (low, middle) if enough else (middle, high)
    return high


def nearest_rank(count: int, name: str) -> int:
    """The rank (1 = smallest) of the sample that is the percentile `name` of `count` samples."""
    return -(-count * PERCENTILES[name] // _WHOLE)


def interval_ranks(count: int, name: str) -> tuple[int, int]:
    """The ranks (1 = smallest) of the samples that enclose the true percentile.

    The number of samples below it is binomial: it is below the low rank, and not below the high
    one, with half of 1 - CONFIDENCE each. Raises ValueError with fewer than `samples_needed`.
    """
    if count < samples_needed(name):
        raise ValueError(f"{count} samples are too few for {name}")
    first, below = _binomial(count, PERCENTILES[name] / _WHOLE)
    tail = (1.0 - CONFIDENCE) / 2
    up_to = np.cumsum(below)
    above = np.append(np.cumsum(below[::-1])[::-1][1:], 0.0)  # summed from the small end: exact
    low = first + int(np.count_nonzero(up_to <= tail))
    high = first + int(np.argmax(above <= tail)) + 1
    return low, high


def _estimates(ordered: Int64) -> Iterator[tuple[str, Estimate]]:
    count = len(ordered)
    for name in PERCENTILES:
        if count >= samples_needed(name):
            low, high = interval_ranks(count, name)
            yield (
                name,
                Estimate(
                    value_ns=int(ordered[nearest_rank(count, name) - 1]),
                    low_ns=int(ordered[low - 1]),
                    high_ns=int(ordered[high - 1]),
                ),
            )


def _at_most_one_beyond(count: int, share: float) -> float:
    """Probability that at most one of `count` samples lies beyond the quantile `share`."""
    return exp(count * log(share)) + count * (1.0 - share) * exp((count - 1) * log(share))


def _binomial(count: int, share: float) -> tuple[int, NDArray[np.float64]]:
    """The first k that matters, and P(k), P(k + 1), ... of the binomial distribution.

    What is left out, beyond 12 standard deviations, is less likely than 1e-12.
    """
    middle, spread = count * share, 12.0 * (count * share * (1.0 - share)) ** 0.5 + 12.0
    first, last = max(0, int(middle - spread)), min(count, int(middle + spread))
    start = lgamma(count + 1) - lgamma(first + 1) - lgamma(count - first + 1)
    start += first * log(share) + (count - first) * log1p(-share)
    k = np.arange(first, last)
    steps = np.log((count - k) / (k + 1)) + log(share / (1.0 - share))
    return first, np.exp(start + np.concatenate([[0.0], np.cumsum(steps)]))
