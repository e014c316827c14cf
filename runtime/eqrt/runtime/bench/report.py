"""What a benchmark found: plain values, from which the table, the JSON and the page are made.

Times are whole nanoseconds where they were measured one by one. docs/benchmarks.md documents every
field; SCHEMA changes when one of them changes its meaning or goes.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace

from eqrt.runtime.bench.cold_start import ColdStart
from eqrt.runtime.bench.environment import Environment, ModelIdentity
from eqrt.runtime.bench.percentiles import Estimate
from eqrt.runtime.bench.resources import Resources

SCHEMA = 1
BACK_TO_BACK, PERIODIC = "back-to-back", "periodic"
SCHEDULES = (BACK_TO_BACK, PERIODIC)


MODEL, SERVICE = "model", "service"
"""What is benchmarked, and the name of the workload that is judged then."""
GENERATED = "generated: the recorded drive of eqrt demo, filled up with copies"
"""The traffic of a service benchmark without a log."""
NOUNS = {MODEL: "target", SERVICE: "object"}
"""What there is a number of in a case."""


def counted(targets: int, benchmark: str = MODEL) -> str:
    """`1 target`, `8 targets`; of the service, objects."""
    return f"{targets} {NOUNS[benchmark]}{'s' * (targets != 1)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Distribution:
    """Of one duration."""

    mean_ns: int
    min_ns: int
    max_ns: int
    percentiles: dict[str, Estimate]
    """Only those that there are samples enough for (`eqrt.runtime.bench.percentiles`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Histogram:
    """Bins of equal ratio."""

    edges_ns: tuple[int, ...]
    counts: tuple[int, ...]
    """One fewer than edges; bin i is from edges_ns[i] up to, not including, edges_ns[i + 1]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """How durations went over time, in equal stretches; a stretch without samples is left out."""

    start_s: tuple[float, ...]
    """Of the stretches, from the first run."""
    median_ns: tuple[int, ...]
    max_ns: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkloadResult:
    """One workload in one case."""

    name: str
    samples: int
    total: Distribution
    """Of a run: the sum of its stages."""
    stages: dict[str, Distribution]
    cpu_mean_ns: int
    """CPU time of a run, all threads."""
    histogram: Histogram
    course: Course


@dataclass(frozen=True, slots=True, kw_only=True)
class Punctuality:
    """How a periodic schedule was kept."""

    ticks: int
    """That came while measuring."""
    misses: int
    """Ticks whose answer was not there when the next one came, the skipped ones included."""
    skipped: int
    """Ticks that had passed altogether when the run before them ended."""
    wake_up: Distribution | None
    """From when a run was due to when it began, where there was time to wait for it; None if there
    never was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One number of targets, measured once."""

    targets: int
    """In each prediction; of the service, the objects in each cycle of the traffic."""
    seconds: float
    """That it ran."""
    workloads: tuple[WorkloadResult, ...]
    """The one that is judged first."""
    punctuality: Punctuality | None
    """None back-to-back."""
    resources: Resources
    reasons: tuple[str, ...]
    """Why the figures are not to be trusted; empty = VALID."""
    advice: tuple[str, ...]

    @property
    def valid(self) -> bool:
        """Whether nothing speaks against the figures."""
        return not self.reasons

    def advised(self, more: Sequence[str]) -> Case:
        """With more advice."""
        return replace(self, advice=(*self.advice, *more))

    @property
    def title(self) -> str:
        """`8 targets`, `8 objects`."""
        return counted(self.targets, SERVICE if self.judged.name == SERVICE else MODEL)

    @property
    def judged(self) -> WorkloadResult:
        """The workload that verdict, budget and baseline are about."""
        return self.workloads[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What was asked for."""

    benchmark: str
    """`model`: predictions of ready scenes; `service`: from the bus to the bus."""
    targets: tuple[int, ...]
    seconds: float
    """Per case."""
    schedule: str
    """One of SCHEDULES."""
    rate_hz: float | None
    """None back-to-back."""
    threads: int
    bus: str | None = None
    """Of the service: channel and interface."""
    log: str | None = None
    """Of the service: the recorded log that is played; None = generated traffic."""

    def duty(self) -> str:
        """The schedule in words."""
        if self.rate_hz is None:
            return self.schedule
        return f"{self.schedule} at {self.rate_hz:g} Hz"


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Everything."""

    schema: int
    measured_at: str
    """UTC, ISO 8601."""
    settings: Settings
    environment: Environment
    model: ModelIdentity
    cold_start: ColdStart
    cases: tuple[Case, ...]

    @property
    def valid(self) -> bool:
        """Whether every case asked for was measured, and is valid."""
        complete = len(self.cases) == len(self.settings.targets)
        return complete and all(case.valid for case in self.cases)


def report_now(
    settings: Settings,
    environment: Environment,
    model: ModelIdentity,
    cold_start: ColdStart,
    cases: Sequence[Case],
) -> Report:
    """A report that was just measured."""
    return Report(
        schema=SCHEMA,
        measured_at=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        settings=settings,
        environment=environment,
        model=model,
        cold_start=cold_start,
        cases=tuple(cases),
    )
