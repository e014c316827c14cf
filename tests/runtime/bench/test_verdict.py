"""What makes figures INVALID, one reason at a time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from bench_reports import ENVIRONMENT, MS, QUIET, SETTINGS, result
from eqrt.runtime.bench.report import Punctuality
from eqrt.runtime.bench.verdict import advice, reasons

ENOUGH = result([4 * MS] * 662)


def test_nothing_speaks_against_a_quiet_machine() -> None:
    assert reasons(SETTINGS, ENOUGH, QUIET, 20.0, clock_went_back=False) == ()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"steal_share": 0.02}, "the hypervisor took 2.0% of the cores' time (at most 1%)"),
        ({"others_share": 0.5}, "other programs used 50.0% of the cores' time (at most 5%)"),
        ({"involuntary_switches": 1900}, "interrupted 100 times per second of CPU time"),
        (
            {"frequency_low_mhz": 1000.0, "frequency_high_mhz": 3000.0},
            "the cores' clock went from 1000 to 3000 MHz",
        ),
    ],
)
def test_a_disturbed_machine_is_a_reason(changes: dict[str, Any], reason: str) -> None:
    found = reasons(SETTINGS, ENOUGH, replace(QUIET, **changes), 20.0, clock_went_back=False)
    assert len(found) == 1
    assert found[0].startswith(reason)


def test_threads_that_interrupt_each_other_are_no_reason() -> None:
    restless = replace(QUIET, involuntary_switches=9_000)
    two = replace(SETTINGS, threads=2)
    assert reasons(two, ENOUGH, restless, 20.0, clock_went_back=False) == ()


def test_a_p99_needs_its_samples() -> None:
    few = result([4 * MS] * 661)
    found = reasons(SETTINGS, few, QUIET, 20.0, clock_went_back=False)
    assert found == ("661 samples, a p99 needs 662",)


def test_an_early_end_and_a_clock_that_went_back_are_reasons() -> None:
    found = reasons(SETTINGS, ENOUGH, QUIET, 12.0, clock_went_back=True)
    assert found == ("ran for 12.0 s of 20 s", "the clock went back")


def given(samples: list[int], **changes: Any) -> str:
    judged = replace(result(samples), **changes.pop("result", {}))
    return "\n".join(
        advice(
            replace(SETTINGS, **changes.pop("settings", {})),
            replace(ENVIRONMENT, **changes.pop("environment", {})),
            judged,
            changes.pop("punctuality", None),
            replace(QUIET, **changes),
        )
    )


def test_a_long_tail_is_pointed_out() -> None:
    assert "p99 is 5.0 x p50" in given([MS] * 900 + [5 * MS] * 100)
    assert "p99 is" not in given([MS] * 1000)


def test_the_advice_for_more_samples_says_how_long_to_measure() -> None:
    assert given([MS] * 331) == "p99 needs 662 samples, there are 331: --seconds 40"
    periodic = {"schedule": "periodic", "rate_hz": 10.0}
    assert "p99.9 needs 6,636 samples, there are 662: --seconds 664" in given(
        [MS] * 662, settings=periodic
    )
    assert given([MS] * 6636) == ""


def test_threads_that_burn_more_than_they_save_are_pointed_out() -> None:
    two = {"threads": 2}
    wasteful = {"cpu_mean_ns": 2 * MS}
    assert "2.0 s of CPU time" in given([MS] * 6636, settings=two, result=wasteful)
    assert given([MS] * 6636, result=wasteful) == ""


def test_missed_deadlines_faults_growth_and_the_governor_are_pointed_out() -> None:
    missed = Punctuality(ticks=700, misses=3, skipped=1, wake_up=None)
    said = given(
        [MS] * 6636,
        punctuality=missed,
        environment={"governor": "powersave", "flags": ()},
        rss_slope_kib_per_s=50.0,
        major_faults=2,
    )
    assert said.splitlines() == [
        "3 of 700 deadlines missed: fewer targets, a smaller model, or a lower rate",
        "memory grew by 50.0 KiB/s: does it go on? repeat with a longer --seconds",
        "2 pages came from disk: is memory short?",
        "the frequency governor is 'powersave': performance is steadier",
        "no AVX2 here: onnxruntime is several times slower without",
    ]


def test_caches_that_others_use_are_pointed_out_where_runs_wait() -> None:
    shared, periodic = {"cooling": 38.2}, {"schedule": "periodic", "rate_hz": 10.0}
    assert "a sum of 16 KiB takes 38 x as long" in given(
        [MS] * 6636, settings=periodic, environment=shared
    )
    assert given([MS] * 6636, environment=shared) == ""
    for own in (1.5, None):
        assert given([MS] * 6636, settings=periodic, environment={"cooling": own}) == ""
