"""Runs workloads by a schedule and keeps every sample, then sums them up.

In every turn all workloads run. The one that is judged comes first, right after the wake-up, as it
would in the car, and the others meet the same scenes at the same time; or they take turns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from eqrt.runtime.bench.percentiles import Int64, estimates
from eqrt.runtime.bench.report import (
    Course,
    Distribution,
    Histogram,
    Punctuality,
    WorkloadResult,
)
from eqrt.runtime.bench.resources import cpu_ns
from eqrt.runtime.bench.schedule import CLOCK, Clock, Turn
from eqrt.runtime.bench.workload import Timed, Workload

WARM_UP_S = 0.5
WARM_UP_RUNS = 20
_BINS = 60
_STRETCHES = 150
_TURN = 4  # columns of a turn before those of the workloads: number, due, started, waited
_CHUNK = 65_536


@dataclass(frozen=True, slots=True)
class Measurement:
    """Every sample of one case: R turns."""

    turns: Int64
    """(R, 4) number, due, started (ns), whether it waited."""
    stages_ns: tuple[Int64, ...]
    """(R, stages) of each workload."""
    cpu_ns: tuple[Int64, ...]
    """(R,) of each workload."""

    def __len__(self) -> int:
        return len(self.turns)


def warm_up(workloads: Sequence[Workload], clock: Clock = CLOCK) -> float:
    """Run until lazily made things are made; seconds that one turn takes now.

    At least WARM_UP_RUNS turns, and WARM_UP_S.
    """
    started_ns = now_ns = clock()
    number = 0
    while number < WARM_UP_RUNS or now_ns - started_ns < 1e9 * WARM_UP_S:
        for workload in workloads:
            workload.run(number)
        number += 1
        before_ns, now_ns = now_ns, clock()
    return (now_ns - before_ns) / 1e9


def measure(
    workloads: Sequence[Workload],
    turns: Iterable[Turn],
    expected: int,
    *,
    between: Callable[[], None],
    should_stop: Callable[[], bool],
    rotating: bool = False,
) -> Measurement:
    """Make the turns, or as many as come before `should_stop`; `between` is called after each.

    `rotating`: another workload begins in every turn, instead of always the first.

    `expected`: about how many turns there will be; room for them is made first, so that keeping
    samples does not look like growing memory.
    """
    samples = Samples(_TURN + sum(len(w.stages) + 1 for w in workloads), expected)
    for turn in turns:
        first = turn.number % len(workloads) if rotating else 0
        parts = [_run(workload, turn.number) for workload in workloads[first:]]
        parts[:0] = [_run(workload, turn.number) for workload in workloads[:first]]
        samples.append(
            [turn.number, turn.due_ns, turn.started_ns, int(turn.waited), *chain(*parts)]
        )
        between()
        if should_stop():
            break
    return taken_apart(samples.rows(), workloads)


def _run(workload: Workload, number: int) -> list[int]:
    """Its stages, and its CPU time."""
    before_ns = cpu_ns()
    stages_ns = workload.run(number)
    return [*stages_ns, cpu_ns() - before_ns]


def results(workloads: Sequence[Timed], measured: Measurement) -> tuple[WorkloadResult, ...]:
    """The samples of each workload, summed up. Needs one turn at least."""
    started_ns = measured.turns[:, 2]
    return tuple(
        _result(workload, stages_ns, spent_ns, started_ns)
        for workload, stages_ns, spent_ns in zip(
            workloads, measured.stages_ns, measured.cpu_ns, strict=True
        )
    )


def punctuality(measured: Measurement, rate_hz: float) -> Punctuality:
    """How the ticks were kept, by the workload that is judged."""
    number, due_ns, started_ns, waited = measured.turns.T
    answered_ns = started_ns + measured.stages_ns[0].sum(axis=1)
    skipped = int(number[-1]) + 1 - len(number)
    late = int(np.count_nonzero(answered_ns > due_ns + round(1e9 / rate_hz)))
    jitter_ns = (started_ns - due_ns)[waited == 1]
    return Punctuality(
        ticks=int(number[-1]) + 1,
        misses=late + skipped,
        skipped=skipped,
        wake_up=distribution(jitter_ns) if len(jitter_ns) else None,
    )


def clock_went_back(measured: Measurement) -> bool:
    """Whether anything took less than no time."""
    backwards = np.any(np.diff(measured.turns[:, 2]) < 0)
    return bool(backwards or any(np.any(stages < 0) for stages in measured.stages_ns))


def distribution(samples_ns: Int64) -> Distribution:
    """Of (n,) samples, at least one."""
    return Distribution(
        mean_ns=round(float(samples_ns.mean())),
        min_ns=int(samples_ns.min()),
        max_ns=int(samples_ns.max()),
        percentiles=estimates(samples_ns),
    )


def histogram(samples_ns: Int64) -> Histogram:
    """At most 60 bins between the fastest and the slowest."""
    low, high = max(1, int(samples_ns.min())), max(1, int(samples_ns.max())) + 1
    edges = np.unique(np.round(np.geomspace(low, high, _BINS + 1)).astype(np.int64))
    counts, _ = np.histogram(np.clip(samples_ns, low, None), edges)
    return Histogram(edges_ns=tuple(edges.tolist()), counts=tuple(counts.tolist()))


def course(started_ns: Int64, samples_ns: Int64) -> Course:
    """At most 150 stretches of equal length."""
    away_s = (started_ns - started_ns[0]) / 1e9
    width_s = max(away_s[-1], 1e-9) / _STRETCHES
    stretch = np.minimum((away_s / width_s).astype(np.intp), _STRETCHES - 1)
    first = np.flatnonzero(np.diff(stretch, prepend=-1))
    parts = np.split(samples_ns, first[1:])
    return Course(
        start_s=tuple(round(float(width_s * stretch[at]), 6) for at in first),
        median_ns=tuple(int(np.median(part)) for part in parts),
        max_ns=tuple(int(part.max()) for part in parts),
    )


def _result(
    workload: Timed, stages_ns: Int64, spent_ns: Int64, started_ns: Int64
) -> WorkloadResult:
    total_ns = stages_ns.sum(axis=1)
    return WorkloadResult(
        name=workload.name,
        samples=len(total_ns),
        total=distribution(total_ns),
        stages={
            name: distribution(samples)
            for name, samples in zip(workload.stages, stages_ns.T, strict=True)
        },
        cpu_mean_ns=round(float(spent_ns.mean())),
        histogram=histogram(total_ns),
        course=course(started_ns, total_ns),
    )


def taken_apart(rows: Int64, workloads: Sequence[Timed]) -> Measurement:
    """Rows of a turn (number, due, started, waited), then stages and CPU time of each workload."""
    parts = list(_columns(rows[:, _TURN:], workloads))
    return Measurement(
        rows[:, :_TURN], tuple(part[:, :-1] for part in parts), tuple(part[:, -1] for part in parts)
    )


def _columns(rows: Int64, workloads: Sequence[Timed]) -> Iterator[Int64]:
    at = 0
    for workload in workloads:
        width = len(workload.stages) + 1
        yield rows[:, at : at + width]
        at += width


class Samples:
    """Rows of whole numbers, in memory that has been touched before it is needed."""

    def __init__(self, width: int, expected: int) -> None:
        self._chunks = [np.full((max(1, expected), width), -1, np.int64)]
        self._used = 0

    def append(self, row: Sequence[int]) -> None:
        """One more."""
        if self._used == len(self._chunks[-1]):
            self._chunks.append(np.full((_CHUNK, len(row)), -1, np.int64))
            self._used = 0
        self._chunks[-1][self._used] = row
        self._used += 1

    def rows(self) -> Int64:
        """(n, width)"""
        return np.concatenate([*self._chunks[:-1], self._chunks[-1][: self._used]])
