"""From turns to results, with workloads whose times are known."""

from __future__ import annotations

import numpy as np
import pytest

from bench_reports import MS, Constant
from eqrt.runtime.bench.measure import (
    Measurement,
    clock_went_back,
    course,
    histogram,
    measure,
    punctuality,
    results,
    warm_up,
)
from eqrt.runtime.bench.resources import (
    core_times,
    shares,
    slope_kib_per_s,
)
from eqrt.runtime.bench.schedule import Turn

STAT = """cpu  300 0 100 1600 0 0 0 0 0 0
cpu0 {busy} 0 50 {idle} 0 10 20 {steal} 0 0
cpu1 200 0 50 800 0 0 0 0 0 0
intr 1 2 3
"""


def turns(*numbers: int, late_ms: int = 0) -> list[Turn]:
    return [Turn(n, 100 * MS * n, (100 * n + late_ms) * MS, waited=True) for n in numbers]


def test_every_workload_meets_every_turn_and_its_samples_are_kept_apart() -> None:
    loads = (Constant("model", 4 * MS), Constant("other", 8 * MS))
    looked: list[int] = []
    measured = measure(
        loads, turns(*range(30)), 7, between=lambda: looked.append(1), should_stop=lambda: False
    )
    assert loads[0].asked == loads[1].asked == list(range(30))
    assert len(looked) == len(measured) == 30
    model, other = results(loads, measured)
    assert (model.name, model.samples, model.total.mean_ns) == ("model", 30, 4 * MS)
    assert {name: part.max_ns for name, part in other.stages.items()} == {
        "first": 2 * MS,
        "second": 6 * MS,
    }
    assert model.total.percentiles["p50"].value_ns == 4 * MS
    assert "p90" not in model.total.percentiles


def test_being_told_to_stop_ends_it_after_the_turn_that_is_on() -> None:
    load = Constant()
    measured = measure(
        [load],
        turns(*range(30)),
        30,
        between=lambda: None,
        should_stop=lambda: len(load.asked) == 3,
    )
    assert len(measured) == 3


def test_a_deadline_is_missed_when_the_answer_comes_after_the_next_tick() -> None:
    """Ticks 0, 1 and 4 at 10 Hz, each begun 60 ms late: 40 ms are in time, 41 are not."""
    for work_ms, late in ((40, 0), (41, 3)):
        measured = measure(
            [Constant(total_ns=work_ms * MS)],
            turns(0, 1, 4, late_ms=60),
            3,
            between=lambda: None,
            should_stop=lambda: False,
        )
        kept = punctuality(measured, 10.0)
        assert (kept.ticks, kept.skipped, kept.misses) == (5, 2, 2 + late)
        assert kept.wake_up is not None
        assert kept.wake_up.max_ns == 60 * MS


def test_lateness_without_time_to_wait_is_not_the_wake_ups() -> None:
    late = [Turn(n, 0, 60 * MS, waited=False) for n in range(3)]
    measured = measure([Constant()], late, 3, between=lambda: None, should_stop=lambda: False)
    assert punctuality(measured, 10.0).wake_up is None


def test_a_clock_that_goes_back_is_noticed() -> None:
    forward = np.zeros((3, 4), np.int64)
    forward[:, 2] = (0, 5, 5)
    backward = forward[::-1]
    stages = np.ones((3, 2), np.int64)
    spent = np.ones(3, np.int64)
    assert not clock_went_back(Measurement(forward, (stages,), (spent,)))
    assert clock_went_back(Measurement(backward, (stages,), (spent,)))
    assert clock_went_back(Measurement(forward, (stages * np.array([1, -1]),), (spent,)))


def test_warming_up_runs_at_least_twenty_times_and_half_a_second() -> None:
    load, now = Constant(), iter(range(0, 100 * 30 * MS, 30 * MS))
    assert warm_up([load], lambda: next(now)) == pytest.approx(0.03)
    assert len(load.asked) == 20
    load, now = Constant(), iter(range(0, 1000 * MS, MS))
    warm_up([load], lambda: next(now))
    assert len(load.asked) == 500


def test_a_histogram_holds_every_sample_once() -> None:
    samples = np.array([5, 7, 7, 1_000, 90_000])
    found = histogram(samples)
    assert sum(found.counts) == 5
    assert len(found.edges_ns) == len(found.counts) + 1
    assert found.edges_ns[0] == 5
    assert found.edges_ns[-1] == 90_001
    assert sum(histogram(np.array([3, 3, 3])).counts) == 3


def test_a_course_keeps_the_slowest_of_every_stretch() -> None:
    started = np.arange(10_000) * MS
    samples = np.full(10_000, MS)
    samples[5_000] = 9 * MS
    found = course(started, samples)
    assert len(found.start_s) == 150
    assert found.max_ns.count(9 * MS) == 1
    assert set(found.median_ns) == {MS}
    assert course(started[:1], samples[:1]).median_ns == (MS,)


def test_what_others_and_the_hypervisor_took_is_told_from_the_kernels_counters() -> None:
    """Of core 0: 100 ticks busy, 60 idle, 40 stolen; 0.7 s of the busy second were our own."""
    before = core_times(STAT.format(busy=100, idle=800, steal=0), [0])
    after = core_times(STAT.format(busy=200, idle=860, steal=40), [0])
    others, steal = shares(before, after, own_s=0.7)
    assert others == pytest.approx(0.15)
    assert steal == pytest.approx(0.2)
    both = core_times(STAT.format(busy=100, idle=800, steal=0), [0, 1])
    assert both.all_s == pytest.approx(before.all_s + 10.5)
    assert shares(before, before, own_s=0.0) == (0.0, 0.0)


def test_memory_that_only_settles_at_the_start_does_not_slope() -> None:
    settling = [(float(s), 50.0 if s < 3 else 60.0) for s in range(13)]
    assert slope_kib_per_s(settling) == 0.0
    growing = [(float(s), 50.0 + s / 1024) for s in range(13)]
    assert slope_kib_per_s(growing) == pytest.approx(1.0, abs=1e-3)
    assert slope_kib_per_s(growing[:3]) is None
