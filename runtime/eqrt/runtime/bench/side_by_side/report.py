"""What a comparison found, as plain values, and as the table for a document."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from eqrt.runtime.bench.cold_start import ColdStart
from eqrt.runtime.bench.environment import Environment, ModelIdentity
from eqrt.runtime.bench.report import Case, Settings, WorkloadResult, counted
from eqrt.runtime.bench.side_by_side.accuracy import Accuracy
from eqrt.runtime.bench.table import duty, machine, ms

SCHEMA = 1
_RIGHT = "---:"


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedModel:
    """One of the models."""

    name: str
    """Of its workload; unique."""
    folder: str
    """As it was typed."""
    identity: ModelIdentity
    file_bytes: int
    parameters: int
    nodes: int
    """In the file."""
    cold_start: ColdStart
    accuracy: Accuracy | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SideBySide:
    """Everything."""

    schema: int
    measured_at: str
    """UTC, ISO 8601."""
    settings: Settings
    environment: Environment
    models: tuple[ComparedModel, ...]
    physics: dict[str, Accuracy]
    """Of those whose errors are known."""
    cases: tuple[Case, ...]
    """Workloads: the models in their order, then physics."""

    @property
    def valid(self) -> bool:
        """Whether every case asked for was measured, and is valid."""
        complete = len(self.cases) == len(self.settings.targets)
        return complete and all(case.valid for case in self.cases)


def markdown(report: SideBySide) -> str:
    """The table, and below it what it holds for."""
    lines = [_line(head) for head in _heads(report)]
    lines += [_line(row) for row in _rows(report)]
    return "\n".join([*lines, "", *_remarks(report)]) + "\n"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _heads(report: SideBySide) -> Iterator[list[str]]:
    titles = [
        title
        for case in report.cases
        for title in (f"{counted(case.targets)}, p50 ms", "p99 ms", "x first")
    ]
    titles += ["file MB", "parameters", "memory MiB"]
    titles += _error_titles(report)
    yield ["", *titles]
    yield ["---", *[_RIGHT] * len(titles)]


def _rows(report: SideBySide) -> Iterator[list[str]]:
    for place, model in enumerate(report.models):
        size = [f"{model.file_bytes / 1e6:.2f}", f"{model.parameters:,}"]
        start = model.cold_start
        size.append(f"{start.rss_mib - start.rss_bare_mib:.1f}")
        errors = _errors(report, model.accuracy)
        yield [model.name, *_latencies(report, place), *size, *errors]
    for place, workload in enumerate(report.cases[0].workloads):
        if place >= len(report.models):
            errors = _errors(report, report.physics.get(workload.name))
            yield [workload.name, *_latencies(report, place), "", "", "", *errors]


def _latencies(report: SideBySide, place: int) -> Iterator[str]:
    for case in report.cases:
        first, this = case.workloads[0], case.workloads[place]
        for name in ("p50", "p99"):
            found = this.total.percentiles.get(name)
            yield "-" if found is None else ms(found.value_ns)
        yield f"{middle_ns(this) / max(middle_ns(first), 1):.2f}"


def middle_ns(workload: WorkloadResult) -> int:
    """The median; the mean where there are too few samples for one."""
    found = workload.total.percentiles.get("p50")
    return workload.total.mean_ns if found is None else found.value_ns


def _known(report: SideBySide) -> list[Accuracy]:
    models = [model.accuracy for model in report.models if model.accuracy is not None]
    return [*models, *report.physics.values()]


def _error_titles(report: SideBySide) -> list[str]:
    known = _known(report)
    if not known:
        return []
    horizons = sorted({one.horizon_s for one in known})
    time = f" {horizons[0]:g} s" if len(horizons) == 1 else ""
    best = ["minADE, m", "minFDE, m"] if any(one.min_ade_m is not None for one in known) else []
    return [f"ADE{time}, m", f"FDE{time}, m", *best]


def _errors(report: SideBySide, accuracy: Accuracy | None) -> list[str]:
    titles = _error_titles(report)
    if accuracy is None:
        return [""] * len(titles)
    values = [accuracy.ade_m, accuracy.fde_m, accuracy.min_ade_m, accuracy.min_fde_m]
    return ["" if value is None else f"{value:.3f}" for value in values[: len(titles)]]


def _remarks(report: SideBySide) -> Iterator[str]:
    where = "; ".join(machine(report.environment))
    yield f"{duty(report.settings)}; {where}; {report.measured_at}."
    yield (
        "Latency is of a whole prediction of so many targets; all took turns in one process, and "
        "memory is what each takes beyond numpy and onnxruntime in a process of its own."
    )
    bad = [f"{case.title}: {'; '.join(case.reasons)}" for case in report.cases if not case.valid]
    yield "VALID." if report.valid else f"INVALID: {'. '.join(bad) or 'not all was measured'}."
    sources = _sources(report)
    if len(sources) == 1:
        yield f"Errors are from {next(iter(sources))}."
    elif sources:
        yield ""
        yield "Errors are from:"
        yield ""
        yield from (f"- {', '.join(names)}: {source}" for source, names in sources.items())
    if len(sources) > 1:
        yield ""
        yield "Errors on different data cannot be compared."


def _sources(report: SideBySide) -> Mapping[str, list[str]]:
    """Source -> whose errors stand there, with the horizon."""
    found: dict[str, list[str]] = {}
    owners = [(model.name, model.accuracy) for model in report.models]
    for name, accuracy in [*owners, *report.physics.items()]:
        if accuracy is not None:
            source = f"{accuracy.source}, after {accuracy.horizon_s:g} s"
            found.setdefault(source, []).append(name)
    return found
