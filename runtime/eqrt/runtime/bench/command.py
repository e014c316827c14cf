"""`eqrt bench`: how fast eqrt answers on this machine, and whether it stays within a budget.

Exit status: 0 measured (VALID or not), 3 a budget is broken or the baseline was faster.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from eqrt.core.errors import EqrtError
from eqrt.core.files import write_whole
from eqrt.runtime.bench import options
from eqrt.runtime.bench.baseline import Comparison, compare, load_baseline
from eqrt.runtime.bench.budget import Budget, broken, check_duty, load_budget
from eqrt.runtime.bench.environment import allow_cores, allowed_cores, parse_cores, require_linux
from eqrt.runtime.bench.json_form import to_json
from eqrt.runtime.bench.model import bench_model
from eqrt.runtime.bench.page import render_page
from eqrt.runtime.bench.report import SERVICE, Report, Settings
from eqrt.runtime.bench.table import comparison_lines

BROKEN = 3
"""Exit status of a broken budget and of a regression."""

add_arguments = options.add_arguments


def run(args: argparse.Namespace) -> int:
    """Measure, print, write, judge."""
    require_linux()
    benchmark = options.benchmark_of(args)
    settings = options.settings_of(args, benchmark)
    options.check_writable(args.json, args.html, args.markdown, args.plot)
    budget = _budget(args.budget, settings)
    baseline = load_baseline(args.baseline, settings) if args.baseline else None
    before = allowed_cores()
    if args.cpus is not None:
        allow_cores(parse_cores(args.cpus))
    if benchmark == options.OPERATORS:
        return _operators(args, settings)
    if benchmark == options.COMPARISON:
        return _side_by_side(args, settings)
    report = _measured(args, settings, before)
    comparison = compare(baseline, report) if baseline else None
    if comparison is not None:
        _say(comparison_lines(comparison))
    _write(args.json, to_json(report))
    _write(args.html, render_page(report, comparison))
    return _judge(report, budget, comparison)


def _measured(args: argparse.Namespace, settings: Settings, before: Sequence[int]) -> Report:
    if settings.benchmark != SERVICE:
        return bench_model(options.artifact_of(args), settings, _say)
    from eqrt.runtime.bench.service.bench import (  # noqa: PLC0415 (CAN is not the model's memory)
        bench_service,
        setup_of,
    )

    return bench_service(setup_of(args, before, allowed_cores()), settings, _say)


def _operators(args: argparse.Namespace, settings: Settings) -> int:
    from eqrt.runtime.bench.operators.bench import bench_operators  # noqa: PLC0415 (seldom used)

    found = bench_operators(options.artifact_of(args), settings, _say)
    _write(args.json, to_json(found))
    return 0


def _side_by_side(args: argparse.Namespace, settings: Settings) -> int:
    from eqrt.runtime.bench.side_by_side import accuracy, bench, pareto, report  # noqa: PLC0415

    evals = [accuracy.read_eval(path) for path in args.accuracy or ()]
    stretch = args.seconds is None
    found = bench.bench_side_by_side(args.compare, evals, settings, _say, stretch=stretch)
    _write(args.json, to_json(found))
    _write(args.markdown, report.markdown(found))
    if args.plot is not None:
        _write(args.plot, pareto.draw(found))
    return 0


def _judge(report: Report, budget: Budget | None, comparison: Comparison | None) -> int:
    """The exit status, with a line for everything that is not as it should be."""
    faults = [f"OVER BUDGET {line}" for line in broken(budget, report)] if budget else []
    if comparison is not None:
        faults += [
            f"REGRESSION {change.title}: {change.percentile} is {change.ratio:.2f} x the baseline's"
            for change in comparison.regressions
        ]
    _say(faults)
    if budget and not faults:
        _say([f"within the budget {budget.path}"])
    return BROKEN if faults else 0


def _budget(path: Path | None, settings: Settings) -> Budget | None:
    if path is None:
        return None
    budget = load_budget(path, settings.benchmark)
    check_duty(budget, settings)
    return budget


def _write(path: Path | None, text: str) -> None:
    if path is None:
        return
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise EqrtError(f"{path}: cannot be written ({error.strerror})") from error


def _say(lines: Sequence[str]) -> None:
    for line in lines:
        print(line, flush=True)
