"""The options of `eqrt bench`, and what they ask for.

One command measures four things: the model, the service, the model's operators, several models
side by side. An option that the chosen one cannot keep is refused.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path

from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bench.percentiles import samples_needed
from eqrt.runtime.bench.report import (
    BACK_TO_BACK,
    MODEL,
    PERIODIC,
    SCHEDULES,
    SERVICE,
    Settings,
)
from eqrt.runtime.bench.verdict import WANTED
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT

COMPARISON, OPERATORS = "compare", "operators"
RATE_HZ = 10.0
_SECONDS = {MODEL: 20.0, SERVICE: 20.0, OPERATORS: 5.0, COMPARISON: 20.0}
_MAX_TARGETS, _MAX_OBJECTS, _MAX_THREADS, _MAX_SECONDS = 1024, 64, 256, 86_400.0
_MAX_RATE_HZ = {MODEL: 10_000.0, SERVICE: 16.0}
"""The service lets cycles that are closer than 60 ms share a prediction."""
_DEFAULT_COUNTS = {MODEL: "1,8,32", SERVICE: "1,8,32,64", OPERATORS: "1,32", COMPARISON: "1,32"}
_ONLY: Mapping[str, tuple[str, ...]] = {
    "model": (MODEL, SERVICE, OPERATORS),
    "targets": (MODEL, OPERATORS, COMPARISON),
    "objects": (SERVICE,),
    "schedule": (MODEL, SERVICE),
    "rate": (MODEL, SERVICE),
    "html": (MODEL, SERVICE),
    "budget": (MODEL, SERVICE),
    "baseline": (MODEL, SERVICE),
    "can": (SERVICE,),
    "can_interface": (SERVICE,),
    "fd": (SERVICE,),
    "log": (SERVICE,),
    "profile": (SERVICE,),
    "tile": (SERVICE,),
    "stationary": (SERVICE,),
    "markdown": (COMPARISON,),
    "plot": (COMPARISON,),
    "accuracy": (COMPARISON,),
}
"""Option -> what it is for, where that is not everything."""
_ASKED_BY = {
    MODEL: "the model alone",
    SERVICE: "--service",
    OPERATORS: "--operators",
    COMPARISON: "--compare",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt bench`."""
    parser.epilog = (
        "example: eqrt bench --schedule periodic --json now.json --budget deploy/budgets.toml"
    )
    what = parser.add_argument_group("what to measure (default: the model)")
    chosen = what.add_mutually_exclusive_group()
    chosen.add_argument(
        "--service",
        action="store_true",
        help="the whole service, from the last message of a cycle to its last prediction on a bus",
    )
    chosen.add_argument(
        "--operators",
        action="store_true",
        help="where the model's time goes: by kind of operator, and beside the machine's limits",
    )
    chosen.add_argument(
        "--compare",
        type=Path,
        nargs="+",
        metavar="DIR",
        help="several models side by side; ratios are to the first",
    )
    _add_load(parser)
    _add_service(parser.add_argument_group("with --service"))
    _add_results(parser)
    _add_comparison(parser.add_argument_group("with --compare"))


def _add_load(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model",
        type=Path,
        metavar="DIR",
        help="an artifact's folder (default: the model that comes with eqrt)",
    )
    parser.add_argument(
        "--targets",
        metavar="LIST",
        help="how many targets in one prediction, a case each (default: "
        f"{_DEFAULT_COUNTS[MODEL]}; with --operators and --compare {_DEFAULT_COUNTS[COMPARISON]})",
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
        help="one prediction after the other, or at --rate as in the car (default: "
        f"{BACK_TO_BACK}; with --service {PERIODIC})",
    )
    parser.add_argument(
        "--rate",
        type=float,
        metavar="HZ",
        help=f"predictions per second, with --schedule periodic (default: {RATE_HZ:g})",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help=f"how long each case runs (default: {_SECONDS[MODEL]:g}, with --operators "
        f"{_SECONDS[OPERATORS]:g}; periodic and --compare: at least what a {WANTED} takes)",
    )


def _add_service(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--objects",
        metavar="LIST",
        help="how many objects in each cycle of the traffic, a case each "
        f"(default: {_DEFAULT_COUNTS[SERVICE]})",
    )
    group.add_argument(
        "--can",
        metavar="CHANNEL",
        help="the bus, such as vcan0 (default: one of this machine's own, without CAN in the "
        "kernel); nothing else may send on it",
    )
    group.add_argument("--can-interface", metavar="IF", help="python-can's name; else socketcan")
    group.add_argument(
        "--fd",
        action=argparse.BooleanOptionalAction,
        help="open the bus for CAN FD, or not; else if the channel can",
    )
    group.add_argument(
        "--log",
        type=Path,
        metavar="LOG",
        help="play this recorded log instead of generated traffic; with --profile",
    )
    group.add_argument("--profile", metavar="NAME|FILE", help="of the log's sensor")
    group.add_argument("--tile", type=Path, metavar="FILE", help="the map around the log's drive")
    group.add_argument(
        "--stationary",
        action="store_const",
        const=True,
        help="the log's sensor stands still, and no message tells its motion",
    )


def _add_results(parser: argparse.ArgumentParser) -> None:
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


def _add_comparison(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--markdown", type=Path, metavar="FILE", help="write the table there")
    group.add_argument(
        "--plot", type=Path, metavar="FILE", help="draw error over latency there, as SVG"
    )
    group.add_argument(
        "--accuracy",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="reports of eqrt eval --json, for models without errors in their cards or on other "
        "data than theirs",
    )


def benchmark_of(args: argparse.Namespace) -> str:
    """What is to be measured. Raises UsageError for an option that is not for that."""
    benchmark = MODEL
    if args.service:
        benchmark = SERVICE
    elif args.operators:
        benchmark = OPERATORS
    elif args.compare is not None:
        benchmark = COMPARISON
    for name, benchmarks in _ONLY.items():
        if getattr(args, name) is not None and benchmark not in benchmarks:
            fitting = ", ".join(_ASKED_BY[one] for one in benchmarks)
            raise UsageError(
                f"--{name.replace('_', '-')} is for {fitting}, not for {_ASKED_BY[benchmark]}"
            )
    return benchmark


def settings_of(args: argparse.Namespace, benchmark: str) -> Settings:
    """What is asked for. Raises UsageError for values that cannot be."""
    schedule = args.schedule or (PERIODIC if benchmark == SERVICE else BACK_TO_BACK)
    rate_hz = _rate(args, benchmark, schedule)
    _check_range("--threads", args.threads, 1, _MAX_THREADS)
    _check_range("--seconds", args.seconds, 0.1, _MAX_SECONDS)
    seconds = args.seconds
    if seconds is None:
        seconds = max(
            _SECONDS[benchmark], round(1.05 * samples_needed(WANTED) / rate_hz) if rate_hz else 0.0
        )
    return Settings(
        benchmark=benchmark,
        targets=_counts(args, benchmark),
        seconds=seconds,
        schedule=schedule,
        rate_hz=rate_hz,
        threads=args.threads,
        log=args.log.name if args.log else None,
    )


def artifact_of(args: argparse.Namespace) -> Path:
    """The model to measure."""
    chosen: Path = args.model or DEFAULT_ARTIFACT
    return chosen


def check_writable(*paths: Path | None) -> None:
    """Now, because minutes later a report would be lost. Raises EqrtError."""
    given = [path for path in paths if path is not None]
    for path in given:
        if path.is_dir() or not path.parent.is_dir():
            raise EqrtError(f"{path}: cannot be written; give a file in a folder that exists")
    files = [path.resolve() for path in given if path.is_file() or not path.exists()]
    for path in files:
        if files.count(path) > 1:
            raise UsageError(f"{path} is to be two reports at once; give each a file of its own")
        try:
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        except OSError as error:
            raise EqrtError(f"{path}: cannot be written ({error.strerror})") from error


def _rate(args: argparse.Namespace, benchmark: str, schedule: str) -> float | None:
    if args.rate is not None and schedule != PERIODIC:
        raise UsageError(f"--rate {args.rate:g} needs --schedule {PERIODIC}")
    if args.log is not None and (args.rate is not None or schedule != PERIODIC):
        raise UsageError("--log is played as it was recorded: leave out --rate and --schedule")
    if schedule != PERIODIC:
        return None
    rate_hz: float = RATE_HZ if args.rate is None else args.rate
    _check_range("--rate", rate_hz, 0.1, _MAX_RATE_HZ[benchmark])
    return rate_hz


def _counts(args: argparse.Namespace, benchmark: str) -> tuple[int, ...]:
    option, most = "targets", _MAX_TARGETS
    if benchmark == SERVICE:
        option, most = "objects", _MAX_OBJECTS
    text = getattr(args, option) or _DEFAULT_COUNTS[benchmark]
    counts = [int(part) if part.strip().isdecimal() else 0 for part in text.split(",")]
    if not all(1 <= count <= most for count in counts) or len({*counts}) < len(counts):
        raise UsageError(
            f"--{option} {text!r}: give different numbers from 1 to {most}, as in 1,8,32"
        )
    return tuple(counts)


def _check_range(option: str, value: float | None, low: float, high: float) -> None:
    if value is not None and not low <= value <= high:
        raise UsageError(f"{option} is {value:g}; give {low:g} to {high:g}")
