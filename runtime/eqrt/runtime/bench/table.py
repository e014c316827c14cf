"""The report in a terminal, at most 100 columns wide."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping

from eqrt.runtime.bench.baseline import Comparison
from eqrt.runtime.bench.cold_start import ColdStart
from eqrt.runtime.bench.environment import Environment, ModelIdentity
from eqrt.runtime.bench.percentiles import CONFIDENCE, PERCENTILES, Estimate
from eqrt.runtime.bench.report import (
    GENERATED,
    NOUNS,
    Case,
    Distribution,
    Punctuality,
    Report,
    Settings,
)
from eqrt.runtime.bench.resources import Resources

WIDTH = 100
_NAME, _COLUMN = 22, 10


def heading_lines(
    settings: Settings, environment: Environment, model: ModelIdentity, cold_start: ColdStart
) -> list[str]:
    """What is measured where, and the cold start."""
    return model_lines(settings, environment, model) + _wrapped(
        f"cold start {cold_start.total_s:.2f} s, slowest of {cold_start.starts} "
        f"{cold_start.slowest_s:.2f} s (import {cold_start.import_s:.2f}, load "
        f"{cold_start.load_s:.2f}, first answer {1e3 * cold_start.first_s:.1f} ms); memory "
        f"{cold_start.rss_mib:.1f} MiB, of which numpy and onnxruntime "
        f"{cold_start.rss_bare_mib:.1f}",
    )


def model_lines(settings: Settings, environment: Environment, model: ModelIdentity) -> list[str]:
    """What is measured where."""
    service = []
    if settings.bus is not None:
        service.append(f"the service on {settings.bus}; traffic {settings.log or GENERATED}")
    return _wrapped(
        f"{model.name} {model.version} ({model.sha256[:8]}), {duty(settings)}",
        *service,
        *machine(environment),
    )


def duty(settings: Settings) -> str:
    """`1 thread, back-to-back, 20 s a case`."""
    threads = f"{settings.threads} thread{'s' * (settings.threads != 1)}"
    return f"{threads}, {settings.duty()}, {settings.seconds:g} s a case"


def machine(environment: Environment) -> list[str]:
    """Hardware; software."""
    cores = ",".join(map(str, environment.cores_allowed))
    parts = [
        environment.cpu,
        f"cores {cores} of {environment.cores_present}",
        f"governor {environment.governor}" if environment.governor else "",
        "virtual" if environment.hypervisor else "",
        f"Linux {environment.kernel}",
    ]
    versions = [
        f"{name} {getattr(environment, name)}"
        for name in ("eqrt", "python", "numpy", "onnxruntime")
    ]
    return [", ".join(part for part in parts if part), ", ".join(versions)]


def case_lines(case: Case) -> list[str]:
    """One number of targets: percentiles of every workload, resources, verdict, advice."""
    names = [*PERCENTILES, "max", "CPU"]
    title = f"{case.title}, ms"
    lines = [
        "",
        f"{title:<{_NAME}}" + "".join(f"{name:>{_COLUMN}}" for name in names) + "  samples",
    ]
    for workload in case.workloads:
        lines.append(
            _row(workload.name, workload.total, f"{ms(workload.cpu_mean_ns):>{_COLUMN}}")
            + f"{workload.samples:>9,}"
        )
        if workload is case.judged:
            lines += [_row(f"  {name}", part) for name, part in workload.stages.items()]
    if case.punctuality is not None and case.punctuality.wake_up is not None:
        lines.append(_row("wake-up, late by", case.punctuality.wake_up))
    lines += _wrapped(*_case_remarks(case))
    return [line.rstrip() for line in lines]


def closing_lines(report: Report) -> list[str]:
    """The verdict of all."""
    if report.valid:
        return ["", "VALID"]
    bad = [str(case.targets) for case in report.cases if not case.valid]
    noun = NOUNS[report.settings.benchmark]
    missing = len(report.settings.targets) - len(report.cases)
    parts = [f"{noun}s {', '.join(bad)}"] if bad else []
    parts += [f"{missing} cases not measured"] if missing else []
    return ["", f"INVALID: {'; '.join(parts)}: measure again on a quiet machine"]


def comparison_lines(comparison: Comparison) -> list[str]:
    """Every percentile beside the baseline's."""
    lines = ["", f"{'beside the baseline, ms':<26}{'before':>24}{'now':>28}{'now / before':>14}"]
    for change in comparison.changes:
        mark = " *" if change.significant else "  "
        lines.append(
            f"{f'{change.title}, {change.percentile}':<26}{interval(change.before):>24}"
            f"{interval(change.now):>28}{change.ratio:>12.3f}{mark}"
        )
    lines.append(f"* the intervals ({CONFIDENCE:.0%}) are apart")
    return lines + _wrapped(*comparison.remarks)


def _case_remarks(case: Case) -> Iterator[str]:
    yield _confidence(case.judged.total.percentiles)
    if case.punctuality is not None:
        yield _missed(case.punctuality)
    yield _costs(case.resources, case.judged.samples)
    yield "VALID" if case.valid else f"INVALID: {'; '.join(case.reasons)}"
    yield from case.advice


def _row(name: str, distribution: Distribution, more: str = "") -> str:
    found = distribution.percentiles
    cells = [ms(found[key].value_ns) if key in found else "-" for key in PERCENTILES]
    cells.append(ms(distribution.max_ns))
    return f"{_shortened(name):<{_NAME}}" + "".join(f"{cell:>{_COLUMN}}" for cell in cells) + more


def _shortened(name: str) -> str:
    return name if len(name) < _NAME else f"{name[: _NAME - 2]}…"


def _confidence(found: Mapping[str, Estimate]) -> str:
    if not found:
        return "too few samples for any percentile"
    parts = [f"{name} {interval(estimate)}" for name, estimate in found.items()]
    return f"with {CONFIDENCE:.0%} confidence: {', '.join(parts)} ms"


def _missed(punctuality: Punctuality) -> str:
    return (
        f"{punctuality.misses:,} of {punctuality.ticks:,} deadlines missed"
        f" ({punctuality.skipped:,} skipped)"
    )


def _costs(resources: Resources, turns: int) -> str:
    slope = resources.rss_slope_kib_per_s
    grows = "" if slope is None else f", {slope:+.1f} KiB/s"
    return (
        f"memory {resources.rss_start_mib:.1f} MiB, peak {resources.rss_peak_mib:.1f}{grows}; in "
        f"{turns:,} turns: switches {resources.voluntary_switches:,} voluntary, "
        f"{resources.involuntary_switches:,} not; page faults {resources.minor_faults:,} minor, "
        f"{resources.major_faults:,} major; others {resources.others_share:.1%}, "
        f"steal {resources.steal_share:.1%}"
    )


def interval(estimate: Estimate) -> str:
    """The two ends in milliseconds."""
    return f"{ms(estimate.low_ns)} to {ms(estimate.high_ns)}"


def ms(nanoseconds: int) -> str:
    """Milliseconds with three digits after the point, fewer where they say nothing."""
    value = nanoseconds / 1e6
    return f"{value:.3f}" if value < 100.0 else f"{value:.1f}"


def _wrapped(*paragraphs: str) -> list[str]:
    return [
        line
        for paragraph in paragraphs
        for line in textwrap.wrap(paragraph, WIDTH, subsequent_indent="  ")
    ]
