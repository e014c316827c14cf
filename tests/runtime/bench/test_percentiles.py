"""Percentiles against counting, and the rule at its borders."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest

from eqrt.runtime.bench.percentiles import (
    PERCENTILES,
    estimates,
    interval_ranks,
    nearest_rank,
    samples_needed,
)


def tail(count: int, share: float, most: int) -> float:
    """P(at most `most` of `count` samples are below the quantile `share`), term by term."""
    return sum(comb(count, k) * share**k * (1.0 - share) ** (count - k) for k in range(most + 1))


@pytest.mark.parametrize(
    ("name", "needed"), [("p50", 11), ("p90", 64), ("p99", 662), ("p99.9", 6636)]
)
def test_two_samples_lie_beyond_a_percentile_with_99_percent_from_so_many_on(
    name: str, needed: int
) -> None:
    share = PERCENTILES[name] / 10_000

    def at_most_one_beyond(count: int) -> float:
        return float(share**count + count * (1.0 - share) * share ** (count - 1))

    assert samples_needed(name) == needed
    assert at_most_one_beyond(needed) <= 0.01 < at_most_one_beyond(needed - 1)


@pytest.mark.parametrize("name", PERCENTILES)
def test_a_percentile_is_given_from_its_first_sufficient_sample_on_and_not_before(
    name: str,
) -> None:
    enough = np.arange(samples_needed(name))
    assert name in estimates(enough)
    assert name not in estimates(enough[:-1])


def test_the_value_is_the_smallest_sample_that_so_many_do_not_exceed() -> None:
    samples = np.random.default_rng(1).permutation(np.arange(1, 1001))
    found = estimates(samples)
    assert (found["p50"].value_ns, found["p90"].value_ns, found["p99"].value_ns) == (500, 900, 990)
    assert "p99.9" not in found


def test_ranks_are_counted_in_whole_numbers() -> None:
    """0.999 * 7000 is a little more than 6993 in floating point, and its ceiling one rank off."""
    for count in range(11, 3000):
        for name, share in PERCENTILES.items():
            rank = nearest_rank(count, name)
            assert (rank - 1) * 10_000 < count * share <= rank * 10_000


@pytest.mark.parametrize(
    ("name", "count"),
    [("p50", 11), ("p50", 12), ("p50", 100), ("p90", 64), ("p90", 500), ("p99", 662), ("p99", 900)],
)
def test_the_interval_is_the_narrowest_with_half_a_percent_on_each_side(
    name: str, count: int
) -> None:
    share = PERCENTILES[name] / 10_000
    low, high = interval_ranks(count, name)
    assert 1 <= low <= nearest_rank(count, name) <= high <= count
    assert tail(count, share, low - 1) <= 0.005 < tail(count, share, low)
    assert 1.0 - tail(count, share, high - 1) <= 0.005 < 1.0 - tail(count, share, high - 2)


def test_for_eleven_samples_the_median_lies_between_the_first_and_the_last() -> None:
    """By hand: all 11 above it has probability 1 / 2048, at most one below it 12 / 2048 > 0.5 %."""
    assert interval_ranks(11, "p50") == (1, 11)


def test_intervals_enclose_the_true_percentile_as_often_as_they_say() -> None:
    rng = np.random.default_rng(2)
    low, high = interval_ranks(200, "p90")
    ordered = np.sort(rng.random((20_000, 200)), axis=1)  # uniform: the true p90 is 0.9
    enclosed = (ordered[:, low - 1] <= 0.9) & (ordered[:, high - 1] >= 0.9)
    assert enclosed.mean() >= 0.99 - 0.003  # four standard deviations of 20,000 trials


def test_a_million_samples_are_no_trouble() -> None:
    low, high = interval_ranks(1_000_000, "p99.9")
    assert low < 999_000 < high
    spread = 2.576 * (1_000_000 * 0.999 * 0.001) ** 0.5  # the normal approximation
    assert high - low == pytest.approx(2 * spread, rel=0.05)


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="661 samples are too few for p99"):
        interval_ranks(661, "p99")
