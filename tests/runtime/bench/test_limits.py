"""Budgets and baselines: what breaks them, and what they refuse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bench_reports import MS, case, report
from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bench.baseline import compare, load_baseline
from eqrt.runtime.bench.budget import broken, check_duty, load_budget
from eqrt.runtime.bench.json_form import to_json
from eqrt.runtime.bench.report import Punctuality
from source_tree import ROOT

SHIPPED = ROOT / "deploy/budgets.toml"


def budget_of(folder: Path, text: str, schedule: str = 'schedule = "back-to-back"') -> Path:
    path = folder / "budget.toml"
    path.write_text(f"{schedule}\n{text}\n")
    return path


# --- budgets


def test_each_broken_limit_is_a_line_with_what_found_and_allowed(tmp_path: Path) -> None:
    text = """
    [start]
    cold_start_s = 0.4
    rss_over_bare_mib = 20
    [targets.1]
    p50_ms = 4.0
    p99_ms = 3.5
    rss_peak_mib = 60.5
    rss_slope_kib_per_s = 0
    """
    assert broken(load_budget(budget_of(tmp_path, text)), report(case())) == [
        "start: cold_start is 0.5 s, allowed 0.4 s",
        "1 target: p99 is 4 ms, allowed 3.5 ms",
        "1 target: rss_peak is 61 MiB, allowed 60.5 MiB",
    ]


def test_deadline_misses_are_counted(tmp_path: Path) -> None:
    path = budget_of(
        tmp_path, "rate_hz = 10\n[targets.8]\ndeadline_misses = 2", 'schedule = "periodic"'
    )
    kept = Punctuality(ticks=700, misses=3, skipped=0, wake_up=None)
    assert broken(load_budget(path), report(case(8, punctuality=kept))) == [
        "8 targets: deadline_misses is 3, allowed 2"
    ]


def test_a_percentile_without_samples_enough_is_an_error_and_not_within_budget(
    tmp_path: Path,
) -> None:
    budget = load_budget(budget_of(tmp_path, "[targets.1]\np99_ms = 10"))
    with pytest.raises(EqrtError, match=r"p99_ms of 1 target was not measured; measure for longer"):
        broken(budget, report(case(totals_ns=[MS] * 661)))


def test_a_budget_for_another_duty_is_refused_before_measuring(tmp_path: Path) -> None:
    budget = load_budget(budget_of(tmp_path, "[targets.8]\np50_ms = 1"))
    check_duty(budget, report(case(1), case(8)).settings)
    with pytest.raises(UsageError, match="limits for 8 targets, which are not measured"):
        check_duty(budget, report(case(1)).settings)
    periodic = report(case(8), schedule="periodic", rate_hz=10.0)
    with pytest.raises(UsageError, match="is for --schedule back-to-back --threads 1"):
        check_duty(budget, periodic.settings)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[start]\nwarm_start_s = 1", "start.warm_start_s is not known; known are cold_start_s,"),
        ("[targets.8]\np95_ms = 1", "targets.8.p95_ms is not known"),
        ("[targets.some]\np99_ms = 1", r"\[targets.some\]: 'some' is no number of targets"),
        ("[targets.8]\np99_ms = '1'", "targets.8.p99_ms is '1', expected a number, 0 or more"),
        ("[targets.8]\np99_ms = -1", "targets.8.p99_ms is -1, expected a number, 0 or more"),
        ("[targets.8]\np99_ms = nan", "targets.8.p99_ms is nan, expected a number, 0 or more"),
        ("start = 1", "start is 1, expected a table"),
        ("targets = [", "not TOML"),
        ("rules = 1", "rules is not known"),
    ],
)
def test_a_budget_that_says_nothing_we_know_is_refused_in_one_line(
    tmp_path: Path, text: str, said: str
) -> None:
    with pytest.raises(EqrtError, match=said) as error:
        load_budget(budget_of(tmp_path, text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("schedule", ["", "schedule = 'hourly'", "schedule = 'periodic'"])
def test_a_budget_needs_a_schedule_and_its_rate(tmp_path: Path, schedule: str) -> None:
    with pytest.raises(EqrtError, match=r"schedule is|rate_hz is None"):
        load_budget(budget_of(tmp_path, "", schedule))


def test_a_budget_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    budget = budget_of(tmp_path, "[targets.1]\np50_ms = 1\n")
    budget.write_bytes(b"\xef\xbb\xbf" + budget.read_bytes())
    assert load_budget(budget).targets == {1: {"p50_ms": 1}}


def test_a_missing_budget_is_named() -> None:
    with pytest.raises(EqrtError, match=r"nowhere.toml: cannot be read \(No such file"):
        load_budget(Path("nowhere.toml"))


def test_the_shipped_budget_is_for_the_defaults_at_10_hz() -> None:
    budget = load_budget(SHIPPED)
    check_duty(
        budget, report(case(1), case(8), case(32), schedule="periodic", rate_hz=10.0).settings
    )
    for limits in budget.targets.values():
        assert limits["p50_ms"] < limits["p99_ms"]


# --- baselines


def stored(folder: Path, baseline: object) -> Path:
    path = folder / "old.json"
    path.write_text(to_json(baseline))
    return path


def test_slower_beyond_chance_and_margin_is_a_regression(tmp_path: Path) -> None:
    now = report(case(totals_ns=[5 * MS] * 700))
    before = report(case(totals_ns=[4 * MS] * 700))
    baseline = load_baseline(stored(tmp_path, before), now.settings)
    found = compare(baseline, now)
    assert [change.percentile for change in found.regressions] == ["p50", "p90", "p99"]
    assert {change.ratio for change in found.changes} == {1.25}
    assert compare(now, baseline).regressions == ()
    assert all(change.significant for change in compare(now, baseline).changes)


def test_slower_by_less_than_the_margin_is_none() -> None:
    before, now = report(case(totals_ns=[100] * 700)), report(case(totals_ns=[105] * 700))
    found = compare(before, now)
    assert all(change.significant for change in found.changes)
    assert found.regressions == ()


def test_intervals_that_overlap_are_chance() -> None:
    """Half of the runs take 1 ms, half 3: which of the two is the median is a matter of luck."""
    before = report(case(totals_ns=[MS] * 351 + [3 * MS] * 349))
    now = report(case(totals_ns=[MS] * 349 + [3 * MS] * 351))
    median = compare(before, now).changes[0]
    assert (median.percentile, median.ratio, median.regression) == ("p50", 3.0, False)


def test_percentiles_that_only_one_side_has_are_left_out() -> None:
    found = compare(report(case(totals_ns=[MS] * 100)), report(case(totals_ns=[MS] * 700)))
    assert [change.percentile for change in found.changes] == ["p50", "p90"]


def test_another_machine_and_another_model_are_said_and_compared_all_the_same() -> None:
    now = report(case())
    before = replace(
        now,
        environment=replace(now.environment, cpu="Slow", cores_allowed=(0,), numpy="1.26.0"),
        model=replace(now.model, name="naive", sha256="f" * 64),
        settings=replace(now.settings, threads=2),
        cases=(replace(now.cases[0], reasons=("noise",)),),
    )
    found = compare(before, now)
    assert found.remarks == (
        "ANOTHER MACHINE: Slow, 2 cores before",
        "other cores: 0 before, 0,1 now",
        "ANOTHER MODEL: naive 1.0.0 (ffffffff) before",
        "other threads: 2 before, 1 now",
        "numpy 1.26.0 before, 2.0.0 now",
        "the baseline was INVALID",
    )
    assert len(found.changes) == 3


def test_physics_that_got_slower_too_is_said() -> None:
    slower = report(case(physics_ns=[MS // 5] * 700))
    assert compare(report(case()), slower).remarks == (
        "1 target: constant velocity took 2.00 x as long, too: that much is the machine",
    )


def test_a_baseline_of_something_else_is_refused(tmp_path: Path) -> None:
    path = stored(tmp_path, report(case(8)))
    with pytest.raises(UsageError, match="measured 8 targets; give one of them"):
        load_baseline(path, report(case(1)).settings)
    with pytest.raises(UsageError, match="measured the model back-to-back, this run is the model"):
        load_baseline(path, report(case(8), schedule="periodic", rate_hz=10.0).settings)
