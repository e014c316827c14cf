"""`eqrt replay`: run the service on a recorded log, offline, on the log's own clock.

As fast as the machine can, and repeatable: the same log, profile, tile and model give the same
bytes. Writes one JSON line per prediction (docs/output.md).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import can

from eqrt.core.errors import UsageError
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.serve import load_pipeline
from eqrt.runtime.serve_options import add_pipeline_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt replay`."""
    parser.epilog = "example: eqrt replay drive.log --profile ars408 --out predictions.jsonl"
    parser.add_argument(
        "log", type=Path, metavar="LOG", help="candump .log, .asc, .blf or .trc, also with .gz"
    )
    add_pipeline_arguments(parser)
    parser.add_argument(
        "--can",
        action="append",
        default=[],
        metavar="[ROLE=]NAME",
        help="read only the log's channel NAME; with ROLE= for one of the profile's buses "
        "(repeatable; default: all channels for everything)",
    )
    parser.add_argument(
        "--out",
        required=True,
        metavar="FILE",
        help="where to write a JSON line per prediction (docs/output.md); - = standard output",
    )


def run(args: argparse.Namespace) -> int:
    """Replay, and say in one line how it went."""
    log = read_log(args.log)
    profile = load_profile(args.profile)
    channels = parse_channels(args.can, profile.roles)
    pipeline = load_pipeline(args, profile, channels or None, clock=None)
    started_s = time.perf_counter()
    with output(args.out) as out:
        for forecast in replay(pipeline, log):
            out.write(json_lines(forecast))
    seconds = time.perf_counter() - started_s
    if log.remark:
        print(f"eqrt: {log.remark}", file=sys.stderr)
    counters, decoded = pipeline.counters, pipeline.decoder.counters
    print(
        f"eqrt replay: {log.messages} messages, {decoded.cycles} cycles, "
        f"{decoded.objects} objects, {counters.targets} predictions in {seconds:.1f} s",
        file=sys.stderr,
    )
    return 0


def replay(pipeline: Pipeline, messages: Iterable[can.Message]) -> Iterator[ForecastSet]:
    """Every prediction the service would have made, on the clock of the messages' stamps."""
    now_s = None
    for message in messages:
        now_s = message.timestamp
        yield from pipeline.poll(now_s)
        yield from pipeline.feed(message, now_s)
    if now_s is not None:
        yield from pipeline.finish(now_s)


@contextlib.contextmanager
def output(name: str) -> Iterator[BinaryIO]:
    """Standard output, or a file that appears when it is whole."""
    if name == "-":
        yield sys.stdout.buffer
        return
    path = Path(name)
    in_place = path.exists() and not path.is_file()  # a device or a pipe
    written = path if in_place else path.parent / f"{path.name}.part"
    try:
        with written.open("wb") as stream:
            yield stream
        if not in_place:
            os.replace(written, path)
    except OSError as error:
        raise UsageError(
            f"cannot write {path} ({error.strerror}); give --out a file that can be written"
        ) from error
    finally:
        if not in_place:
            with contextlib.suppress(OSError):
                written.unlink(missing_ok=True)
