"""`eqrt simulate`: traffic driven by SUMO, recorded as a car with sensors would have seen it.

Every run has its own drivers, demand and traffic; what comes out depends on the seed and the
options, not on how many processes worked on it.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import math
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np

from eqrt.core.errors import EqrtError, LogError, UsageError
from eqrt.training.recordings.formats import forbids_commerce
from eqrt.training.recordings.recording import Source
from eqrt.training.simulation.drivers import STEP_S
from eqrt.training.simulation.run import OBSERVERS, Run, Tally, simulate
from eqrt.training.simulation.scenario import Scenario, read_scenario
from eqrt.training.simulation.sensor import SENSORS
from eqrt.training.simulation.traffic import Demand

MAX_MINUTES = 1e6
"""Two years of traffic: more is a slip of the pen."""
RECORDINGS_PER_RUN = 4 * OBSERVERS
"""More runs differ more; fewer spend less time on filling the network."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt simulate`."""
    parser.epilog = "example: eqrt simulate acosta/run.sumocfg --out acosta-data --minutes 60"
    parser.add_argument(
        "scenarios",
        nargs="+",
        type=Path,
        metavar="SUMOCFG",
        help="SUMO scenarios; the runs take turns on them",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FOLDER", help="a new folder for the recordings"
    )
    _add_amount_arguments(parser)
    _add_traffic_arguments(parser)
    parser.add_argument(
        "--credit", default="", metavar="TEXT", help="added to the credits: whose the scenarios are"
    )
    parser.add_argument(
        "--license",
        default="CC0-1.0",
        metavar="SPDX",
        help="of the recordings, which hold the scenarios' lanes (default CC0-1.0)",
    )
    parser.add_argument("--jobs", type=_count_of(1), default=1, help="processes (default 1)")


def _add_amount_arguments(parser: argparse.ArgumentParser) -> None:
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument(
        "--minutes", type=_above(0.0, MAX_MINUTES), metavar="M", help="recorded, in total"
    )
    amount.add_argument(
        "--recordings", type=_count_of(1), metavar="N", help="in total (default 40)"
    )
    parser.add_argument(
        "--seconds", type=_above(1.0), default=30.0, help="length of a recording (default 30)"
    )
    parser.add_argument("--seed", type=_count_of(0), default=1, help="(default 1)")


def _add_traffic_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--begin",
        type=_from(0.0),
        default=0.0,
        metavar="SECONDS",
        help="the scenario's time of day to start from (default 0)",
    )
    parser.add_argument(
        "--warmup",
        type=_from(0.0),
        default=200.0,
        metavar="SECONDS",
        help="driven before recording; every run adds up to half as much (default 200)",
    )
    parser.add_argument(
        "--scale",
        type=_above(0.0),
        default=0.8,
        help="demand, relative to the scenario's; runs spread from half to one and a half of it "
        "(default 0.8)",
    )
    parser.add_argument(
        "--speed",
        type=_above(0.0),
        default=1.05,
        help="of the limit, what drivers want on average; runs spread by 15 %% (default 1.05)",
    )
    parser.add_argument(
        "--radius", type=_above(0.0), default=100.0, metavar="M", help="of sight (default 100)"
    )
    parser.add_argument(
        "--sensor", choices=SENSORS, default="good", help="how well others are seen (default good)"
    )


def run(args: argparse.Namespace) -> int:
    """Simulate, and say what was recorded."""
    if importlib.util.find_spec("libsumo") is None:
        raise UsageError(
            "eqrt simulate needs the package 'libsumo', which is not installed; "
            "install it with: pip install 'eqrt[sim]'"
        )
    scenarios = _scenarios(args.scenarios)
    started_s = time.perf_counter()
    with _new_folder(args.out) as folder:
        runs = _plan(args, scenarios, folder)
        tally = _simulate_all(runs, args.jobs)
        if not tally.recordings:
            raise LogError(
                f"{args.scenarios[0]}: no car drives for {args.seconds:g} s on end, so there is "
                "nothing to record; give more traffic (--scale) or shorter recordings (--seconds)"
            )
    seconds = time.perf_counter() - started_s
    print(_summary(tally, sum(each.recordings for each in runs), args, seconds))
    return 0


def _scenarios(paths: Sequence[Path]) -> list[Scenario]:
    scenarios = [read_scenario(path) for path in paths]
    names = [scenario.name for scenario in scenarios]
    if len(set(names)) < len(names):
        raise UsageError(f"two scenarios share a name ({', '.join(names)}); rename a file")
    return scenarios


@contextlib.contextmanager
def _new_folder(path: Path) -> Iterator[Path]:
    """A folder that appears at `path` when everything in it is whole."""
    part = path.parent / f".{path.name}.{os.getpid()}.part"
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise UsageError(f"{path} is there already; give --out a new folder")
        part.mkdir(parents=True)
        yield part
        if path.exists():
            path.rmdir()
        part.rename(path)
    except OSError as error:
        raise EqrtError(f"cannot write {path} ({error.strerror}); give another --out") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _plan(args: argparse.Namespace, scenarios: Sequence[Scenario], folder: Path) -> list[Run]:
    total = args.recordings or 40
    if args.minutes is not None:
        total = math.ceil(args.minutes * 60.0 / args.seconds)
    source = _source(args, scenarios)
    rng = np.random.default_rng(args.seed)
    runs = []
    for index in range(-(-total // RECORDINGS_PER_RUN)):
        scenario = scenarios[index % len(scenarios)]
        demand = Demand(
            seed=int(rng.integers(2**31)),
            begin_s=args.begin,
            warmup_s=args.warmup * rng.uniform(1.0, 1.5),
            scale=args.scale * rng.uniform(0.5, 1.5),
            speed_factor=args.speed * rng.uniform(0.85, 1.15),
        )
        runs.append(
            Run(
                name=f"{scenario.name}-{args.seed}-{index:04d}",
                scenario=scenario,
                demand=demand,
                recordings=min(RECORDINGS_PER_RUN, total - RECORDINGS_PER_RUN * index),
                steps=round(args.seconds / STEP_S),
                sensor=dataclasses.replace(SENSORS[args.sensor], radius_m=args.radius),
                source=source,
                folder=str(folder),
            )
        )
    return runs


def _source(args: argparse.Namespace, scenarios: Sequence[Scenario]) -> Source:
    names = ", ".join(scenario.name for scenario in scenarios)
    version = importlib.metadata.version("libsumo")
    credit = f"Traffic simulated by eqrt with Eclipse SUMO {version} on the scenarios: {names}."
    return Source(
        name=f"SUMO {names}",
        credits=f"{credit} {args.credit}".strip(),
        license=args.license,
        non_commercial=forbids_commerce(args.license),
    )


def _simulate_all(runs: Sequence[Run], jobs: int) -> Tally:
    """Every run in a process of its own: SUMO keeps state, prints, and might crash."""
    pool = concurrent.futures.ProcessPoolExecutor(
        jobs, multiprocessing.get_context("spawn"), _put_streams_away, max_tasks_per_child=1
    )
    tally = Tally()
    try:
        futures = [pool.submit(simulate, each) for each in runs]
        for done, future in enumerate(concurrent.futures.as_completed(futures), 1):
            tally += future.result()
            _progress(done, len(runs), tally)
    except BrokenProcessPool as error:
        names = ", ".join(sorted({each.scenario.name for each in runs}))
        raise LogError(
            f"{names}: a SUMO process died; try `sumo -c` on the scenario, or fewer --jobs"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)
    return tally


def _put_streams_away() -> None:
    """SUMO prints its errors, which come to the user as one line from us."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)


def _progress(done: int, total: int, tally: Tally) -> None:
    line = f"eqrt simulate: {done} of {total} runs, {tally.recordings} recordings"
    if sys.stderr.isatty():
        print(f"\r{line}", end="\n" if done == total else "", file=sys.stderr, flush=True)
    elif done * 10 // total > (done - 1) * 10 // total:  # every tenth of the way
        print(line, file=sys.stderr, flush=True)


def _summary(tally: Tally, asked: int, args: argparse.Namespace, seconds: float) -> str:
    recorded = f"{tally.recordings}" + (f" of {asked}" if tally.recordings < asked else "")
    size_mb = sum(file.stat().st_size for file in args.out.iterdir()) / 1e6
    moving = max(1, tally.sightings - tally.standing)
    return (
        f"{args.out}: {recorded} recordings ({tally.recordings * args.seconds / 60.0:.1f} min), "
        f"{tally.tracks} tracks, {size_mb:.1f} MB in {seconds:.0f} s\n"
        f"{tally.standing / max(1, tally.sightings):.0%} of the time standing; of those who move: "
        f"{tally.driven_m / moving / STEP_S:.1f} m/s, {tally.turning / moving:.0%} turning"
    )


def _above(bound: float, most: float = math.inf) -> Callable[[str], float]:
    def number(text: str) -> float:
        value = _from(bound)(text)
        if value == bound:
            raise argparse.ArgumentTypeError(f"{text} is not above {bound:g}")
        if value > most:
            raise argparse.ArgumentTypeError(f"{text} is above {most:g}")
        return value

    return number


def _from(least: float) -> Callable[[str], float]:
    def number(text: str) -> float:
        value = float(text)
        if not (math.isfinite(value) and value >= least):
            raise argparse.ArgumentTypeError(f"{text} is not a number from {least:g} on")
        return value

    return number


def _count_of(least: int) -> Callable[[str], int]:
    def count(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{text} is below {least}")
        return value

    return count
