"""Measures the model alone.

for each number of targets:  warm up -> turns by a schedule -> samples -> verdict
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.cold_start import measure_cold_start
from eqrt.runtime.bench.environment import Environment, ModelIdentity, read_environment
from eqrt.runtime.bench.measure import (
    Measurement,
    clock_went_back,
    measure,
    punctuality,
    results,
    warm_up,
)
from eqrt.runtime.bench.predictors import (
    ModelWorkload,
    TimedPredictor,
    load_timed,
    physics,
)
from eqrt.runtime.bench.report import Case, Report, Settings, report_now
from eqrt.runtime.bench.resources import Watch
from eqrt.runtime.bench.scenes import ScenePool, record_scenes
from eqrt.runtime.bench.schedule import CLOCK, Turn, back_to_back, periodic, ticks_in
from eqrt.runtime.bench.slow_scenes import slow_scenes
from eqrt.runtime.bench.table import case_lines, closing_lines, heading_lines
from eqrt.runtime.bench.verdict import advice, alone_advice, reasons
from eqrt.runtime.bench.workload import Workload
from eqrt.runtime.signals import until_told_to_stop

Say = Callable[[Sequence[str]], None]
"""Is given lines as soon as they are known."""

_MAX_EXPECTED = 2_000_000  # turns to make room for: beyond, room is made on the way
_ALONE_RUNS = 50  # of one thread, beside several


def bench_model(artifact: Path, settings: Settings, say: Say) -> Report:
    """Measure every case.

    A first Ctrl-C ends it early: what was measured until then is reported, as INVALID. Raises
    EqrtError if the artifact cannot be used, or not a single case was measured.
    """
    environment = read_environment()
    predictor = load_noticed(artifact, settings.threads)
    model, pool = identity(predictor), record_scenes(artifact)
    cold_start = measure_cold_start(artifact, settings.threads)
    say(heading_lines(settings, environment, model, cold_start))
    cases: list[Case] = []
    with until_told_to_stop() as should_stop:
        for targets in settings.targets:
            judged = ModelWorkload(predictor, pool, targets)
            loads: list[Workload] = [judged, *physics(predictor.contract, pool, targets)]
            recurring = len(pool) if targets == 1 else None
            case = measure_case(
                targets, loads, settings, environment, should_stop, recurring=recurring
            )
            if case is None:
                break
            cases.append(case)
            say(case_lines(case))
    if not cases:
        raise EqrtError("stopped before anything was measured")
    if settings.threads > 1:
        cases = list(_beside_one_thread(artifact, pool, settings, cases, say))
    report = report_now(settings, environment, model, cold_start, cases)
    say(closing_lines(report))
    return report


def load_noticed(artifact: Path, threads: int) -> TimedPredictor:
    """Load an artifact; a licence that forbids commercial use is said. Raises ContractError."""
    predictor = load_timed(artifact, threads)
    if predictor.license_notice:
        print(f"eqrt: {predictor.license_notice}", file=sys.stderr)
    return predictor


def identity(predictor: TimedPredictor) -> ModelIdentity:
    """What a report calls it."""
    contract = predictor.contract
    return ModelIdentity(name=contract.name, version=contract.version, sha256=predictor.sha256)


def measure_case(
    targets: int,
    loads: Sequence[Workload],
    settings: Settings,
    environment: Environment,
    should_stop: Callable[[], bool],
    *,
    rotating: bool = False,
    recurring: int | None = None,
) -> Case | None:
    """Warm up, measure, sum up; None if told to stop before the first turn.

    `recurring`: after so many runs their input comes again; None = never the same.
    """
    turn_s = warm_up(loads)
    if should_stop():
        return None
    gc.collect()
    gc.freeze()  # as `eqrt serve` does: what is loaded now stays
    watch = Watch(environment.cores_allowed)
    started_ns = CLOCK()
    measured = measure(
        loads,
        _turns(settings),
        _expected(settings, turn_s),
        between=watch.look,
        should_stop=should_stop,
        rotating=rotating,
    )
    seconds = (CLOCK() - started_ns) / 1e9
    resources = watch.finish()
    found = results(loads, measured)
    kept = None if settings.rate_hz is None else punctuality(measured, settings.rate_hz)
    slow = _slow_scenes(measured, recurring) if recurring else ()
    return Case(
        targets=targets,
        seconds=round(seconds, 3),
        workloads=found,
        punctuality=kept,
        resources=resources,
        reasons=reasons(
            settings, found[0], resources, seconds, clock_went_back=clock_went_back(measured)
        ),
        advice=(*advice(settings, environment, found[0], kept, resources), *slow),
    )


def _slow_scenes(measured: Measurement, scenes: int) -> Iterator[str]:
    """Of the workload that is judged."""
    return slow_scenes(measured.turns[:, 0], measured.stages_ns[0].sum(axis=1), scenes)


def _beside_one_thread(
    artifact: Path, pool: ScenePool, settings: Settings, cases: Sequence[Case], say: Say
) -> Iterator[Case]:
    """Whether the threads are worth it; at the end, so that no case has this in its memory."""
    alone = load_timed(artifact, 1)
    for case in cases:
        one_ns = _median_ns(ModelWorkload(alone, pool, case.targets))
        found = alone_advice(settings, case.judged, one_ns)
        say([f"{case.title}: {line}" for line in found])
        yield case.advised(found)


def _median_ns(load: Workload) -> int:
    """Of some runs, warmed up."""
    warm_up([load])
    return int(np.median([sum(load.run(number)) for number in range(_ALONE_RUNS)]))


def _turns(settings: Settings) -> Iterator[Turn]:
    if settings.rate_hz is None:
        return back_to_back(settings.seconds, CLOCK)
    return periodic(settings.rate_hz, settings.seconds, CLOCK)


def _expected(settings: Settings, turn_s: float) -> int:
    """About how many turns there will be, rather too many."""
    if settings.rate_hz is not None:
        return ticks_in(settings.rate_hz, settings.seconds)
    return min(_MAX_EXPECTED, int(1.5 * settings.seconds / max(turn_s, 1e-6)) + 1)
