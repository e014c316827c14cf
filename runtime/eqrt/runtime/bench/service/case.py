"""One case of a service benchmark: traffic of so many objects, and the service that answers."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.cold_start import STARTS, ColdStart, medians
from eqrt.runtime.bench.environment import Environment
from eqrt.runtime.bench.json_form import parse
from eqrt.runtime.bench.measure import Measurement, clock_went_back, results, taken_apart
from eqrt.runtime.bench.percentiles import Int64
from eqrt.runtime.bench.report import SERVICE, Case, Punctuality, Settings
from eqrt.runtime.bench.resources import Resources
from eqrt.runtime.bench.schedule import CLOCK
from eqrt.runtime.bench.service.journal import STAGES, WIDTH
from eqrt.runtime.bench.service.measured import WARM_UP
from eqrt.runtime.bench.service.orders import BusOrder, ServiceOrder, TrafficOrder
from eqrt.runtime.bench.service.programs import PATIENCE_S, Program
from eqrt.runtime.bench.verdict import advice, reasons

_MAX_EXPECTED = 1_000_000  # samples to make room for: beyond, room is made on the way
_ANSWERS_PER_S = 1_000.0  # back-to-back, rather too many
_COLD_PERIOD_S = 0.1
_MAX_LATE = 0.05  # of a period: traffic that is later is not what was asked for


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """The service and its traffic, the same for all cases."""

    bus: BusOrder
    profile: str
    model: Path
    tile: Path | None
    stationary: bool
    log: Path | None
    """None = generated traffic."""
    traffic_cores: tuple[int, ...]


class _Service:
    """What the samples are of."""

    name = SERVICE
    stages = STAGES


def measure_service(
    setup: Setup,
    objects: int,
    settings: Settings,
    environment: Environment,
    should_stop: Callable[[], bool],
) -> Case | None:
    """Start both processes, measure, sum up; None if told to stop before anything was measured."""
    with tempfile.TemporaryDirectory(prefix="eqrt-bench-") as folder:
        rows = Path(folder) / "rows.npy"
        order = _service_order(setup, settings, environment, rows)
        with Program(order, should_stop) as serving:
            serving.wait_for("ready")
            sent = _traffic_order(setup, objects, settings.rate_hz)
            with Program(sent, should_stop) as traffic:
                told = _watched(serving, traffic, settings)
        samples: Int64 = np.load(rows) if told is not None else np.zeros((0, WIDTH), np.int64)
    if told is None or not len(samples):
        return None
    if not set(setup.traffic_cores) & set(environment.cores_allowed):
        told["traffic_cpu_s"] = 0.0  # not of these cores
    return _case(objects, settings, environment, samples, told)


def measure_service_start(
    setup: Setup, settings: Settings, environment: Environment, should_stop: Callable[[], bool]
) -> ColdStart:
    """Start the service STARTS times beside traffic that never stops.

    Raises EqrtError if told to stop meanwhile.
    """
    order = replace(
        _service_order(setup, settings, environment, Path("unused")), seconds=86_400.0, expected=1
    )
    order = replace(order, answered_clock=False)
    sent = _traffic_order(setup, min(settings.targets), 1.0 / _COLD_PERIOD_S)
    with Program(sent, should_stop) as traffic:
        traffic.wait_for("ready")
        return medians([_start(order, should_stop) for _ in range(STARTS)])


def _start(order: ServiceOrder, should_stop: Callable[[], bool]) -> dict[str, float]:
    with Program(order, should_stop) as serving:
        ready, first = serving.wait_for("ready"), serving.wait_for("first")
        if ready is None or first is None:
            raise EqrtError("stopped before anything was measured")
        return {
            "total_ns": CLOCK() - serving.started_ns,
            **{key: ready[key] for key in ("import_ns", "load_ns", "bare_mib")},
            **{key: first[key] for key in ("first_ns", "rss_mib")},
        }


def _watched(serving: Program, traffic: Program, settings: Settings) -> dict[str, Any] | None:
    """What service and traffic said in the end, and the CPU time that the traffic took."""
    if traffic.wait_for("ready") is None:
        return None
    if serving.wait_for("measuring", PATIENCE_S + WARM_UP / (settings.rate_hz or 10.0)) is None:
        return None
    before_s = traffic.cpu_s()
    told = serving.wait_for("measured", PATIENCE_S + settings.seconds)
    spent_s = traffic.cpu_s() - before_s
    traffic.stop()
    ended = traffic.wait_for("ended") or {}
    return None if told is None else {**ended, **told, "traffic_cpu_s": spent_s}


def _service_order(
    setup: Setup, settings: Settings, environment: Environment, rows: Path
) -> ServiceOrder:
    rate_hz = settings.rate_hz or _ANSWERS_PER_S
    return ServiceOrder(
        bus=setup.bus,
        cores=environment.cores_allowed,
        profile=setup.profile,
        model=str(setup.model),
        tile=str(setup.tile) if setup.tile else None,
        stationary=setup.stationary,
        threads=settings.threads,
        seconds=settings.seconds,
        expected=min(_MAX_EXPECTED, round(1.1 * rate_hz * settings.seconds) + 10),
        answered_clock=settings.rate_hz is None,
        rows=str(rows),
    )


def _traffic_order(setup: Setup, objects: int, rate_hz: float | None) -> TrafficOrder:
    return TrafficOrder(
        bus=setup.bus,
        cores=setup.traffic_cores,
        objects=objects,
        period_s=None if rate_hz is None else 1.0 / rate_hz,
        log=str(setup.log) if setup.log else None,
    )


def _case(
    objects: int,
    settings: Settings,
    environment: Environment,
    rows: Int64,
    told: dict[str, Any],
) -> Case:
    measured = taken_apart(rows, [_Service()])
    found = results([_Service()], measured)
    kept = None if settings.rate_hz is None else _punctuality(measured, settings)
    resources = _without_traffic(
        parse(Resources, told["resources"]), told, environment.cores_allowed
    )
    back = clock_went_back(measured)
    return Case(
        targets=objects,
        seconds=round(told["seconds"], 3),
        workloads=found,
        punctuality=kept,
        resources=resources,
        reasons=(
            *reasons(settings, found[0], resources, told["seconds"], clock_went_back=back),
            *_traffic_reasons(told, settings),
        ),
        advice=(
            *advice(settings, environment, found[0], kept, resources),
            *_traffic_advice(told, objects),
        ),
    )


def _punctuality(measured: Measurement, settings: Settings) -> Punctuality:
    """Of the cycles by when their last messages came; a log's are all answered, or not there."""
    assert settings.rate_hz is not None
    period_ns = round(1e9 / settings.rate_hz)
    came_ns, totals_ns = measured.turns[:, 1], measured.stages_ns[0].sum(axis=1)
    ticks = len(came_ns)
    if settings.log is None:
        ticks = max(ticks, round(int(came_ns[-1] - came_ns[0]) / period_ns) + 1)
    skipped = ticks - len(came_ns)
    late = int(np.count_nonzero(totals_ns > period_ns))
    return Punctuality(ticks=ticks, misses=late + skipped, skipped=skipped, wake_up=None)


def _without_traffic(
    resources: Resources, told: dict[str, Any], cores: tuple[int, ...]
) -> Resources:
    """The traffic's process is ours, not another program."""
    share = told["traffic_cpu_s"] / max(told["seconds"] * len(cores), 1e-9)
    return replace(resources, others_share=round(max(0.0, resources.others_share - share), 4))


def _traffic_reasons(told: dict[str, Any], settings: Settings) -> Iterator[str]:
    late_s = told.get("late_p99_s", 0.0)
    if settings.rate_hz is not None and late_s > _MAX_LATE / settings.rate_hz:
        yield f"the traffic itself came up to {1e3 * late_s:.1f} ms late (p99)"
    if told.get("lost"):
        yield f"{told['lost']:,} cycles were not answered"
    if told["incomplete"]:
        yield f"{told['incomplete']:,} cycles lacked messages when they were closed"


def _traffic_advice(told: dict[str, Any], objects: int) -> Iterator[str]:
    if abs(told["targets"] - objects) > 0.1 * objects + 0.5:
        yield f"{told['targets']:.1f} objects were predicted in a cycle, on average"
    if told["fallbacks"]:
        yield f"{told['fallbacks']:,} predictions were refused by the guard"
