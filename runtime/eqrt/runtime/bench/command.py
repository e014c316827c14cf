"""`eqrt bench`: how fast the model answers on this machine, and whether it stays within a budget.

    for each number of targets:  warm up -> turns by a schedule -> samples -> verdict

Exit status: 0 measured (VALID or not), 3 a budget is broken or the baseline was faster.
"""

from __future__ import annotations

import argparse
import datetime
import gc
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bench.baseline import Comparison, compare, load_baseline
from eqrt.runtime.bench.budget import Budget, broken, check_duty, load_budget
from eqrt.runtime.bench.cold_start import measure_cold_start
from eqrt.runtime.bench.environment import (
    Environment,
    ModelIdentity,
    allow_cores,
    parse_cores,
    read_environment,
    require_linux,
)
from eqrt.runtime.bench.json_form import to_json
from eqrt.runtime.bench.measure import clock_went_back, measure, punctuality, results, warm_up
from eqrt.runtime.bench.page import render_page
from eqrt.runtime.bench.percentiles import samples_needed
from eqrt.runtime.bench.predictors import load_timed, workloads
from eqrt.runtime.bench.report import (
    BACK_TO_BACK,
    PERIODIC,
    SCHEDULES,
    SCHEMA,
    Case,
    Report,
    Settings,
    counted,
)
from eqrt.runtime.bench.resources import Watch
from eqrt.runtime.bench.scenes import record_scenes
from eqrt.runtime.bench.schedule import CLOCK, Turn, back_to_back, periodic, ticks_in
from eqrt.runtime.bench.table import case_lines, closing_lines, comparison_lines, heading_lines
from eqrt.runtime.bench.verdict import WANTED, advice, reasons
from eqrt.runtime.bench.workload import Workload
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.signals import until_told_to_stop

BROKEN = 3
"""Exit status of a broken budget and of a regression."""
_SECONDS = 20.0
_RATE_HZ = 10.0
_MAX_TARGETS, _MAX_THREADS, _MAX_RATE_HZ, _MAX_SECONDS = 1024, 256, 10_000.0, 86_400.0
_MAX_EXPECTED = 2_000_000  # turns to make room for: beyond, room is made on the way


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt bench`."""
    parser.epilog = (
        "example: eqrt bench --schedule periodic --json now.json --budget deploy/budgets.toml"
    )
    parser.add_argument(
        "--model",
        type=Path,
        default=DEFAULT_ARTIFACT,
        metavar="DIR",
        help="an artifact's folder (default: the model that comes with eqrt)",
    )
    parser.add_argument(
        "--targets",
        default="1,8,32",
        metavar="LIST",
        help="how many targets in one prediction, a case each (default: 1,8,32)",
    )
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="of onnxruntime (default: 1)"
    )
    parser.add_argument(
        "--cpus", metavar="LIST", help="stay on these cores, as in 0 or 0,2-3 (default: any)"
    )
    parser.add_argument(
        "--schedule",
        choices=SCHEDULES,
        default=BACK_TO_BACK,
        help="one prediction after the other, or at --rate as in the car (default: back-to-back)",
    )
    parser.add_argument(
        "--rate",
        type=float,
        metavar="HZ",
        help=f"predictions per second, with --schedule periodic (default: {_RATE_HZ:g})",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help=f"how long each case runs (default: {_SECONDS:g}; periodic: what a {WANTED} takes)",
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write the report there (docs/benchmarks.md)"
    )
    parser.add_argument("--html", type=Path, metavar="FILE", help="write it as a page with plots")
    parser.add_argument(
        "--budget", type=Path, metavar="FILE", help="limits (TOML); exit status 3 if one is broken"
    )
    parser.add_argument(
        "--baseline",
        type=Path,
        metavar="FILE",
        help="an older --json: what changed; exit status 3 if something is slower",
    )


def run(args: argparse.Namespace) -> int:
    """Measure, print, write, judge."""
    require_linux()
    settings = _settings(args)
    _check_writable(args.json, args.html)
    budget = _budget(args.budget, settings)
    baseline = load_baseline(args.baseline, settings) if args.baseline else None
    if args.cpus is not None:
        allow_cores(parse_cores(args.cpus))
    report = run_bench(args.model, settings, _say)
    comparison = compare(baseline, report) if baseline else None
    if comparison is not None:
        _say(comparison_lines(comparison))
    _write(args.json, to_json(report))
    _write(args.html, render_page(report, comparison))
    return _judge(report, budget, comparison)


def run_bench(artifact: Path, settings: Settings, say: Callable[[Sequence[str]], None]) -> Report:
    """Measure every case; `say` is given lines as soon as they are known.

    A first Ctrl-C ends it early: what was measured until then is reported, as INVALID. Raises
    EqrtError if the artifact cannot be used, or not a single case was measured.
    """
    environment = read_environment()
    predictor = load_timed(artifact, settings.threads)
    if predictor.license_notice:
        print(f"eqrt: {predictor.license_notice}", file=sys.stderr)
    contract = predictor.contract
    model = ModelIdentity(name=contract.name, version=contract.version, sha256=predictor.sha256)
    pool = record_scenes(artifact)
    cold_start = measure_cold_start(artifact, settings.threads)
    say(heading_lines(settings, environment, model, cold_start))
    cases: list[Case] = []
    with until_told_to_stop() as should_stop:
        for targets in settings.targets:
            loads = workloads(predictor, pool, targets)
            case = measure_case(targets, loads, settings, environment, should_stop)
            if case is None:
                break
            cases.append(case)
            say(case_lines(case))
    if not cases:
        raise EqrtError("stopped before anything was measured")
    report = Report(
        schema=SCHEMA,
        measured_at=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        settings=settings,
        environment=environment,
        model=model,
        cold_start=cold_start,
        cases=tuple(cases),
    )
    say(closing_lines(report))
    return report


def measure_case(
    targets: int,
    loads: Sequence[Workload],
    settings: Settings,
    environment: Environment,
    should_stop: Callable[[], bool],
) -> Case | None:
    """Warm up, measure, sum up; None if told to stop before the first turn."""
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
    )
    seconds = (CLOCK() - started_ns) / 1e9
    resources = watch.finish()
    found = results(loads, measured)
    kept = None if settings.rate_hz is None else punctuality(measured, settings.rate_hz)
    return Case(
        targets=targets,
        seconds=round(seconds, 3),
        workloads=found,
        punctuality=kept,
        resources=resources,
        reasons=reasons(
            settings, found[0], resources, seconds, clock_went_back=clock_went_back(measured)
        ),
        advice=advice(settings, environment, found[0], kept, resources),
    )


def _turns(settings: Settings) -> Iterator[Turn]:
    if settings.rate_hz is None:
        return back_to_back(settings.seconds, CLOCK)
    return periodic(settings.rate_hz, settings.seconds, CLOCK)


def _expected(settings: Settings, turn_s: float) -> int:
    """About how many turns there will be, rather too many."""
    if settings.rate_hz is not None:
        return ticks_in(settings.rate_hz, settings.seconds)
    return min(_MAX_EXPECTED, int(1.5 * settings.seconds / max(turn_s, 1e-6)) + 1)


def _judge(report: Report, budget: Budget | None, comparison: Comparison | None) -> int:
    """The exit status, with a line for everything that is not as it should be."""
    faults = [f"OVER BUDGET {line}" for line in broken(budget, report)] if budget else []
    if comparison is not None:
        faults += [
            f"REGRESSION {counted(change.targets)}: {change.percentile} is {change.ratio:.2f} x "
            f"the baseline's"
            for change in comparison.regressions
        ]
    _say(faults)
    if budget and not faults:
        _say([f"within the budget {budget.path}"])
    return BROKEN if faults else 0


def _settings(args: argparse.Namespace) -> Settings:
    periodically = args.schedule == PERIODIC
    if args.rate is not None and not periodically:
        raise UsageError(f"--rate {args.rate:g} needs --schedule {PERIODIC}")
    rate_hz = (_RATE_HZ if args.rate is None else args.rate) if periodically else None
    _check_range("--rate", rate_hz, 0.1, _MAX_RATE_HZ)
    _check_range("--threads", args.threads, 1, _MAX_THREADS)
    _check_range("--seconds", args.seconds, 0.1, _MAX_SECONDS)
    seconds = args.seconds
    if seconds is None:
        seconds = max(_SECONDS, round(1.05 * samples_needed(WANTED) / rate_hz) if rate_hz else 0.0)
    return Settings(
        benchmark="model",
        targets=_parse_targets(args.targets),
        seconds=seconds,
        schedule=args.schedule,
        rate_hz=rate_hz,
        threads=args.threads,
    )


def _parse_targets(text: str) -> tuple[int, ...]:
    counts = [int(part) if part.strip().isdecimal() else 0 for part in text.split(",")]
    if not all(1 <= count <= _MAX_TARGETS for count in counts) or len({*counts}) < len(counts):
        raise UsageError(
            f"--targets {text!r}: give different numbers from 1 to {_MAX_TARGETS}, as in 1,8,32"
        )
    return tuple(counts)


def _check_range(option: str, value: float | None, low: float, high: float) -> None:
    if value is not None and not low <= value <= high:
        raise UsageError(f"{option} is {value:g}; give {low:g} to {high:g}")


def _budget(path: Path | None, settings: Settings) -> Budget | None:
    if path is None:
        return None
    budget = load_budget(path)
    check_duty(budget, settings)
    return budget


def _check_writable(*paths: Path | None) -> None:
    """Now, because minutes later a report would be lost."""
    for path in paths:
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            raise UsageError(f"{path}: cannot be written; give a file in a folder that exists")


def _write(path: Path | None, text: str) -> None:
    if path is None:
        return
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror})") from error


def _say(lines: Sequence[str]) -> None:
    for line in lines:
        print(line, flush=True)
