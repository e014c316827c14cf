"""This report beside an older one: is anything slower, beyond what chance explains?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from eqrt.core.errors import UsageError
from eqrt.runtime.bench.json_form import read_json
from eqrt.runtime.bench.percentiles import Estimate
from eqrt.runtime.bench.report import NOUNS, SCHEMA, Case, Report, Settings

MARGIN = 0.05
"""Less than this is not called a regression, however sure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """One percentile of the judged workload, before and now."""

    title: str
    """Of the case."""
    percentile: str
    before: Estimate
    now: Estimate

    @property
    def ratio(self) -> float:
        """Now / before."""
        return self.now.value_ns / max(self.before.value_ns, 1)

    @property
    def significant(self) -> bool:
        """Whether the intervals are apart."""
        return self.now.low_ns > self.before.high_ns or self.now.high_ns < self.before.low_ns

    @property
    def regression(self) -> bool:
        """Slower, significantly, by more than MARGIN."""
        return self.significant and self.ratio > 1.0 + MARGIN


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """All changes, and what to know when reading them."""

    changes: tuple[Change, ...]
    remarks: tuple[str, ...]

    @property
    def regressions(self) -> tuple[Change, ...]:
        """What the command fails for."""
        return tuple(change for change in self.changes if change.regression)


def load_baseline(path: Path, settings: Settings) -> Report:
    """Read an older report, before measuring.

    Raises EqrtError if it is none, UsageError if it has nothing in common with what is asked for.
    """
    baseline = read_json(Report, path, SCHEMA)
    before = baseline.settings
    if (before.benchmark, before.duty()) != (settings.benchmark, settings.duty()):
        raise UsageError(
            f"{path} measured the {before.benchmark} {before.duty()}, this run is the "
            f"{settings.benchmark} {settings.duty()}; measure alike"
        )
    if not {case.targets for case in baseline.cases} & set(settings.targets):
        measured = ",".join(str(case.targets) for case in baseline.cases)
        noun = NOUNS[settings.benchmark]
        raise UsageError(f"{path} measured {measured or 'no'} {noun}s; give one of them: --{noun}s")
    return baseline


def compare(baseline: Report, report: Report) -> Comparison:
    """Case by case, percentile by percentile, where both have them."""
    before = {case.targets: case for case in baseline.cases}
    pairs = [(before[case.targets], case) for case in report.cases if case.targets in before]
    changes = [change for old, new in pairs for change in _changes(old, new)]
    return Comparison(changes=tuple(changes), remarks=tuple(_remarks(baseline, report, pairs)))


def _changes(before: Case, now: Case) -> Iterator[Change]:
    old = before.judged.total.percentiles
    for name, estimate in now.judged.total.percentiles.items():
        if name in old:
            yield Change(title=now.title, percentile=name, before=old[name], now=estimate)


def _remarks(baseline: Report, report: Report, pairs: list[tuple[Case, Case]]) -> Iterator[str]:
    old, new = baseline.environment, report.environment
    if (old.cpu, old.cores_present) != (new.cpu, new.cores_present):
        yield f"ANOTHER MACHINE: {old.cpu}, {old.cores_present} cores before"
    if old.cores_allowed != new.cores_allowed:
        yield f"other cores: {_listed(old.cores_allowed)} before, {_listed(new.cores_allowed)} now"
    if baseline.model.sha256 != report.model.sha256:
        before = f"{baseline.model.name} {baseline.model.version} ({baseline.model.sha256[:8]})"
        yield f"ANOTHER MODEL: {before} before"
    if baseline.settings.threads != report.settings.threads:
        yield f"other threads: {baseline.settings.threads} before, {report.settings.threads} now"
    for package in ("python", "numpy", "onnxruntime"):
        if getattr(old, package) != getattr(new, package):
            yield f"{package} {getattr(old, package)} before, {getattr(new, package)} now"
    if not baseline.valid:
        yield "the baseline was INVALID"
    for before_case, case in pairs:
        yield from _control(before_case, case)


def _control(before: Case, now: Case) -> Iterator[str]:
    """Physics has not changed: if it is slower or faster, the machine is."""
    old = {workload.name: workload.total.percentiles for workload in before.workloads[1:]}
    for workload in now.workloads[1:]:
        estimates = (old.get(workload.name, {}).get("p50"), workload.total.percentiles.get("p50"))
        if estimates[0] is None or estimates[1] is None:
            continue
        ratio = estimates[1].value_ns / max(estimates[0].value_ns, 1)
        if not 1.0 - MARGIN <= ratio <= 1.0 + MARGIN:
            yield (
                f"{now.title}: {workload.name} took {ratio:.2f} x as long, too: "
                "that much is the machine"
            )
            return


def _listed(cores: tuple[int, ...]) -> str:
    return ",".join(map(str, cores))
