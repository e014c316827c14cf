"""Measures where the model's time goes, one number of targets after the other."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.environment import Environment, ModelIdentity, read_environment
from eqrt.runtime.bench.measure import warm_up
from eqrt.runtime.bench.model import Say, identity, load_noticed
from eqrt.runtime.bench.operators.limits import Limits, measure_limits
from eqrt.runtime.bench.operators.profile import (
    NodeTimes,
    Work,
    profiled,
    times_by_operator,
    work_of,
)
from eqrt.runtime.bench.predictors import ModelWorkload, TimedPredictor
from eqrt.runtime.bench.report import Settings, counted
from eqrt.runtime.bench.scenes import ScenePool, record_scenes
from eqrt.runtime.bench.schedule import CLOCK, back_to_back
from eqrt.runtime.bench.table import model_lines, ms
from eqrt.runtime.signals import until_told_to_stop

SCHEMA = 1
PROFILED_RUNS = 100
_FEWEST_RUNS = 11  # what a median needs
_SHOWN = 12  # kinds of operators in the terminal's table


@dataclass(frozen=True, slots=True, kw_only=True)
class Operator:
    """All nodes of one kind, in one prediction."""

    name: str
    nodes: float
    """That ran."""
    share: float
    """Of the time in all nodes, by the profiler."""
    time_ns: int
    """So much of the measured time that is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorCase:
    """One number of targets."""

    targets: int
    runs: int
    measured_ns: int
    """Median time in onnxruntime of a prediction, without the profiler."""
    profiled_ns: int
    """The same with it."""
    nodes: float
    """That ran in a prediction, after onnxruntime's own optimisations."""
    flops: int
    """Of a prediction."""
    uncounted: tuple[str, ...]
    """Kinds of operators whose work is missing in `flops`."""
    arithmetic_ns: int
    """What `flops` would take at the machine's peak."""
    overhead_ns: int
    """What so many nodes take that compute next to nothing."""
    ratio: float
    """Measured / (arithmetic + overhead)."""
    operators: tuple[Operator, ...]
    """The slowest first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorReport:
    """Everything."""

    schema: int
    measured_at: str
    """UTC, ISO 8601."""
    settings: Settings
    environment: Environment
    model: ModelIdentity
    limits: Limits
    cases: tuple[OperatorCase, ...]


def bench_operators(artifact: Path, settings: Settings, say: Say) -> OperatorReport:
    """Measure every case. Raises EqrtError if the artifact cannot be used, or none was measured."""
    environment = read_environment()
    predictor = load_noticed(artifact, settings.threads)
    content, pool = (artifact / "model.onnx").read_bytes(), record_scenes(artifact)
    limits = measure_limits(settings.threads)
    say([*model_lines(settings, environment, identity(predictor)), *_limit_lines(limits)])
    cases: list[OperatorCase] = []
    with until_told_to_stop() as should_stop:
        for targets in settings.targets:
            if should_stop():
                break
            load = ModelWorkload(predictor, pool, targets)
            spent = _spent_ns(load, settings.seconds)
            profile = _profile(content, settings.threads, predictor, pool, targets)
            cases.append(_case(targets, spent, profile, limits))
            say(case_lines(cases[-1]))
    if not cases:
        raise EqrtError("stopped before anything was measured")
    return OperatorReport(
        schema=SCHEMA,
        measured_at=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        settings=settings,
        environment=environment,
        model=identity(predictor),
        limits=limits,
        cases=tuple(cases),
    )


@dataclass(frozen=True, slots=True)
class _Profile:
    """What the profiler said."""

    events: list[dict[str, Any]]
    """Of PROFILED_RUNS predictions."""
    median_ns: int
    """Of a prediction."""
    work: Work


def _spent_ns(load: ModelWorkload, seconds: float) -> list[int]:
    """In onnxruntime, run by run, without the profiler."""
    warm_up([load])
    spent = [load.run(turn.number)[1] for turn in back_to_back(seconds, CLOCK)]
    return spent + [load.run(number)[1] for number in range(_FEWEST_RUNS - len(spent))]


def _profile(
    content: bytes, threads: int, predictor: TimedPredictor, pool: ScenePool, targets: int
) -> _Profile:
    spent: list[int] = []

    def ask(session: Any, runs: int) -> None:
        load = ModelWorkload(predictor.with_session(session), pool, targets)
        spent[:] = [load.run(number)[1] for number in range(runs)]

    plain = profiled(content, threads, lambda session: ask(session, 1), prepack=False)
    events = profiled(content, threads, lambda session: ask(session, PROFILED_RUNS))
    return _Profile(events, int(np.median(spent)), work_of(plain))


def _case(targets: int, spent: list[int], profile: _Profile, limits: Limits) -> OperatorCase:
    work, measured_ns = profile.work, int(np.median(spent))
    nodes = len(profile.events) / PROFILED_RUNS
    arithmetic_ns = 1e9 * work.flops / limits.flops_per_s
    overhead_ns = nodes * limits.node_ns
    return OperatorCase(
        targets=targets,
        runs=len(spent),
        measured_ns=measured_ns,
        profiled_ns=profile.median_ns,
        nodes=nodes,
        flops=work.flops,
        uncounted=work.uncounted,
        arithmetic_ns=round(arithmetic_ns),
        overhead_ns=round(overhead_ns),
        ratio=round(measured_ns / max(arithmetic_ns + overhead_ns, 1.0), 3),
        operators=tuple(_shares(times_by_operator(profile.events), measured_ns)),
    )


def _shares(times: list[NodeTimes], measured_ns: int) -> Iterator[Operator]:
    total_us = sum(one.time_us for one in times)
    for one in times:
        share = one.time_us / total_us
        yield Operator(
            name=one.operator,
            nodes=one.calls / PROFILED_RUNS,
            share=round(share, 5),
            time_ns=round(share * measured_ns),
        )


def _limit_lines(limits: Limits) -> list[str]:
    return [
        f"this machine: {limits.flops_per_s / 1e9:.1f} GFLOP/s in a large product, "
        f"{limits.node_ns / 1e3:.2f} us for each node"
    ]


def case_lines(case: OperatorCase) -> list[str]:
    """As a table."""
    lines = ["", f"{counted(case.targets) + ', ms':<28}{'nodes':>8}{'time':>10}{'share':>8}"]
    for one in case.operators[:_SHOWN]:
        lines.append(f"  {one.name:<26}{one.nodes:>8g}{ms(one.time_ns):>10}{one.share:>8.1%}")
    if rest := case.operators[_SHOWN:]:
        share, nodes = sum(one.share for one in rest), sum(one.nodes for one in rest)
        spent_ns = sum(one.time_ns for one in rest)
        name = f"{len(rest)} other kinds"
        lines.append(f"  {name:<26}{nodes:>8g}{ms(spent_ns):>10}{share:>8.1%}")
    what = f"arithmetic, {case.flops / 1e6:.1f} MFLOP at the peak"
    rows = {what: case.arithmetic_ns, f"overhead of {case.nodes:g} nodes": case.overhead_ns}
    lines += [f"{name:<36}{ms(value):>10}" for name, value in rows.items()]
    lines.append(f"{'measured in onnxruntime':<36}{ms(case.measured_ns):>10}")
    lines.append(f"{'measured / (arithmetic + overhead)':<36}{case.ratio:>10.2f}")
    slower = case.profiled_ns / max(case.measured_ns, 1)
    lines.append(
        f"median of {case.runs:,} runs; shares from {PROFILED_RUNS} runs under the profiler, which "
        f"took {slower:.1f} x as long"
    )
    if case.uncounted:
        lines.append(f"the work of {', '.join(case.uncounted)} is not counted")
    return lines
