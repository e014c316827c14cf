"""`eqrt eval`: measure a model on recorded traffic.

An artifact is run as the car runs it, so what is measured is what ships. Several --data are
measured side by side, and counted together.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from eqrt.export.cluster import add_worker_arguments, run_pieces
from eqrt.export.evaluation.measure import Measured, Piece, Settings, measure_piece
from eqrt.export.evaluation.report import as_json, as_text, write_json
from eqrt.export.evaluation.selection import Choice
from eqrt.export.formats import add_reader_arguments
from eqrt.export.profiles import absolute_profile
from eqrt.training.dataset.split import SIDES
from eqrt.training.dataset.windows import TARGETS
from eqrt.training.recordings.formats import ReaderOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt eval`."""
    add_shared_arguments(parser)
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        nargs="+",
        metavar="PATH",
        help="prepared folders (`eqrt prepare`) or raw datasets",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number there")
    parser.add_argument(
        "--rotate",
        type=_finite,
        default=0.0,
        metavar="DEGREES",
        help="turn the world by so much first: an equivariant model's errors stay the same",
    )
    add_worker_arguments(parser)


def add_shared_arguments(parser: argparse.ArgumentParser) -> None:
    """What `eqrt eval` and `eqrt plot` have in common."""
    parser.add_argument(
        "--model", type=Path, required=True, help="folder of an artifact, or a checkpoint"
    )
    parser.add_argument("--split", choices=SIDES, default="all", help="default all")
    parser.add_argument(
        "--targets",
        choices=TARGETS,
        help="the dataset's own, every complete track that drives, or also those that stand "
        "(default: the dataset's own where it names any, else complete)",
    )
    parser.add_argument(
        "--stride",
        type=positive,
        metavar="STEPS",
        help="steps between windows of raw data (default: where the data says now, else 5)",
    )
    parser.add_argument(
        "--batch", type=positive, default=256, metavar="N", help="windows at a time (default 256)"
    )
    parser.add_argument("--threads", type=positive, default=1, help="CPU threads (default 1)")
    add_reader_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, print, write."""
    settings = settings_of(args, rotate_deg=args.rotate)
    pieces = [
        Piece(model=args.model, data=data, base=Path.cwd(), settings=settings) for data in args.data
    ]
    parts = measure_all(pieces, min(args.jobs, len(pieces)), args.scheduler)
    if args.json is not None:
        write_json(args.json, as_json(parts, settings))
    print(as_text(parts, settings), end="")
    return 0


def measure_all(pieces: Sequence[Piece], jobs: int, scheduler: str | None) -> list[Measured]:
    """Every dataset, in the order given whichever is done first. Raises the first one's error."""
    done: dict[int, Measured] = {}
    for outcome in run_pieces(measure_piece, pieces, jobs=jobs, scheduler=scheduler):
        if outcome.error is not None:
            raise outcome.error
        if outcome.value is not None:
            done[outcome.index] = outcome.value
    return [done[index] for index in range(len(pieces))]


def settings_of(args: argparse.Namespace, rotate_deg: float = 0.0) -> Settings:
    """The options of `add_shared_arguments` as settings."""
    reader_options = ReaderOptions(
        maps=args.maps,
        profile=args.profile and absolute_profile(args.profile),
        tile=args.tile,
        can=tuple(args.can),
        stationary=args.stationary,
    )
    choice = Choice(
        split=args.split,
        targets=args.targets,
        stride=args.stride,
        reader_options=reader_options.absolute(),
    )
    return Settings(choice=choice, rotate_deg=rotate_deg, batch=args.batch, threads=args.threads)


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return number


def positive(text: str) -> int:
    """A whole number of 1 or more. Raises ArgumentTypeError, which argparse prints."""
    number = int(text) if text.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return number
