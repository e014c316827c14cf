"""`eqrt replay`: run the service on a recorded log, offline, on the log's own clock.

As fast as the machine can, and repeatable: the same log, profile, tile and model give the same
bytes. Writes one JSON line per prediction (docs/output.md). A recording of eqrt's own
(docs/recording.md) brings its profile and tile along, and gives the predictions that the service
made, to the last bit.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import can

from eqrt.core.errors import EqrtError, UsageError
from eqrt.core.files import whole
from eqrt.runtime.advice import no_predictions
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.recording.folder import recordings_in
from eqrt.runtime.recording.reader import is_recording, read_recordings
from eqrt.runtime.recording.replaying import Instead, LeftOut, Replay
from eqrt.runtime.run_diff import Difference, compare_runs, table
from eqrt.runtime.serve import load_pipeline
from eqrt.runtime.serve_options import add_pipeline_arguments

DIFFERS = 1
PARTLY = 3
"""Some cycles of the recording cannot be made again; the others are as they should be."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt replay`."""
    parser.epilog = (
        "example: eqrt replay drive.log --profile ars408 --out predictions.jsonl. Exit status: 1 "
        "if no prediction came out (and why is said). With --diff: 0 the runs are identical, 1 "
        "they differ. 3: some cycles of a recording cannot be made again and are left out, because "
        "their model is not here; all else is well"
    )
    parser.add_argument(
        "log",
        type=Path,
        metavar="LOG",
        help="candump .log, .asc, .blf or .trc, also with .gz; or a recording of eqrt serve "
        "--record, a .mcap or the folder of them",
    )
    add_pipeline_arguments(parser, of_recordings=True)
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
        metavar="FILE",
        help="where to write a JSON line per prediction (docs/output.md); - = standard output",
    )
    diff = parser.add_mutually_exclusive_group()
    diff.add_argument(
        "--diff",
        type=Path,
        metavar="RUN",
        help="compare with the predictions in RUN: a recording, a folder of them, or JSON lines",
    )
    diff.add_argument(
        "--diff-model",
        type=Path,
        metavar="FOLDER",
        help="compare with the predictions of another model on the same log",
    )


def run(args: argparse.Namespace) -> int:
    """Replay, and say in one line how it went; compare, and say how the runs differ."""
    if args.out is None and args.diff is None and args.diff_model is None:
        raise UsageError("where should the predictions go? give --out FILE, or --diff RUN")
    replayed = _replay_of(args, args.model)
    out_name = args.out if args.out is not None else os.devnull
    _check_not_read(out_name, args)
    compares = args.diff is not None or args.diff_model is not None
    modes: Counter[Mode] = Counter()
    started_s = time.perf_counter()
    with output(out_name) as out:
        lines = _written(replayed, out, modes)
        compared = _compare(args, lines, replayed) if compares else _exhaust(lines)
        if not (compares or replayed.left_out or _predictions(replayed)):
            _say(replayed, modes, time.perf_counter() - started_s)
            raise EqrtError(f"no predictions: {no_predictions(replayed.pipelines[-1])}")
    status = 0 if compared is None else _tell(args, *compared)
    _say(replayed, modes, time.perf_counter() - started_s)
    return PARTLY if status == 0 and replayed.left_out else status


def _check_not_read(out_name: str, args: argparse.Namespace) -> None:
    """UsageError if the predictions would take the place of what they are made of."""
    out = Path(out_name)
    if out_name == "-" or not out.is_file():
        return
    given = [Path(one) for one in (args.log, args.profile, args.tile, args.diff) if one is not None]
    files = [file for one in given for file in (recordings_in(one) if one.is_dir() else [one])]
    if any(file.is_file() and file.samefile(out) for file in files):
        raise UsageError(f"--out {out} is read here and would be lost; choose another file")


def _exhaust(lines: Iterator[bytes]) -> tuple[Difference, str] | None:
    """There is nothing to compare with."""
    for _ in lines:
        pass
    return None


def _predictions(replayed: _LogReplay | _RecordingReplay) -> int:
    return sum(one.counters.targets for one in replayed.pipelines)


def _say(
    replayed: _LogReplay | _RecordingReplay, modes: Mapping[Mode, int], seconds: float
) -> None:
    """What went in and came out, after what could not be read or made."""
    for remark in filter(None, (replayed.remark, *map(str, replayed.left_out))):
        print(f"eqrt: {remark}", file=sys.stderr)
    decoded = [one.decoder.counters for one in replayed.pipelines]
    text = (
        f"{replayed.messages} messages, {sum(one.cycles for one in decoded)} cycles, "
        f"{sum(one.objects for one in decoded)} objects, {_predictions(replayed)} predictions "
        f"in {seconds:.1f} s"
    )
    if modes:
        counts = (f"{mode.name} {count}" for mode, count in sorted(modes.items()))
        text += f"; cycles by mode: {', '.join(counts)}"
    print(f"eqrt replay: {text}", file=sys.stderr)


def _written(
    replayed: _LogReplay | _RecordingReplay, out: BinaryIO, modes: Counter[Mode]
) -> Iterator[bytes]:
    """The JSON lines of a replay, each written as it is made; counts the modes of its cycles."""
    for forecast in replayed:
        modes[forecast.mode] += 1
        lines = json_lines(forecast)
        out.write(lines)
        yield from lines.splitlines()


def _compare(
    args: argparse.Namespace, lines: Iterator[bytes], replayed: _LogReplay | _RecordingReplay
) -> tuple[Difference, str]:
    """How the replay differs from another run, and what that is called."""
    if args.diff is not None:
        other, name = _lines_of(args.diff), args.diff.name
    else:
        forecasts = _replay_of(args, args.diff_model, everywhere=True)
        other = (line for forecast in forecasts for line in json_lines(forecast).splitlines())
        name = args.diff_model.name
    return compare_runs(lines, other, replayed.is_left_out), name


def _tell(args: argparse.Namespace, found: Difference, name: str) -> int:
    """Print the difference; returns the exit status."""
    text = table(found, "the replay", name)
    print(text, end="", file=sys.stderr if args.out == "-" else sys.stdout)
    if found.is_none:
        return 0
    if not found.cycles:
        print("eqrt: no cycle is in both; are they of the same drive and clock?", file=sys.stderr)
    return DIFFERS


def _lines_of(run: Path) -> Iterator[bytes]:
    """The JSON lines of a run that was made before."""
    if is_recording(run):
        for recording in read_recordings(run):
            for forecast in recording.forecasts():
                yield from json_lines(forecast).splitlines()
        return
    try:
        with run.open("rb") as stream:
            yield from stream
    except OSError as error:
        raise UsageError(
            f"cannot read {run} ({error.strerror}); give --diff a recording or JSON lines"
        ) from error


def _replay_of(
    args: argparse.Namespace, model: Path | None, *, everywhere: bool = False
) -> _LogReplay | _RecordingReplay:
    """`everywhere`: the model predicts all of a recording, even if it was made with it in part."""
    if is_recording(args.log):
        return _RecordingReplay(args, model, everywhere=everywhere)
    return _LogReplay(args, model)


class _LogReplay:
    """A log, on the clock of its stamps."""

    left_out: Sequence[LeftOut] = ()

    def __init__(self, args: argparse.Namespace, model: Path | None) -> None:
        """Raises UsageError, LogError, and what loading profile, model and tile raises."""
        if args.profile is None:
            raise UsageError("a log does not say which sensor sent: add --profile NAME")
        self._log = read_log(args.log)
        profile = load_profile(args.profile)
        channels = parse_channels(args.can, profile.roles)
        args = argparse.Namespace(**vars(args) | {"model": model or DEFAULT_ARTIFACT})
        self.pipelines = [load_pipeline(args, profile, channels or None, clock=None)]

    def __iter__(self) -> Iterator[ForecastSet]:
        return replay(self.pipelines[0], self._log)

    def is_left_out(self, time_s: float) -> bool:
        """A log is replayed whole."""
        del time_s
        return False

    @property
    def remark(self) -> str | None:
        """What could not be read."""
        return self._log.remark

    @property
    def messages(self) -> int:
        """How many were read."""
        return self._log.messages


class _RecordingReplay:
    """Recordings, each on the clock of the service that made it."""

    def __init__(self, args: argparse.Namespace, model: Path | None, *, everywhere: bool) -> None:
        """Raises LogError."""
        self._recordings = read_recordings(args.log)
        self._args = args
        self._model = None if everywhere else model
        self._other_model = model if everywhere else None
        self._replays: list[Replay] = []

    def __iter__(self) -> Iterator[ForecastSet]:
        notices: set[str | None] = {None}
        for recording in self._recordings:
            replayed = Replay(recording, self._instead())
            model = replayed.pipeline.predictor
            notice = model.license_notice if isinstance(model, Predictor) else None
            if notice not in notices:
                print(f"eqrt: {notice}", file=sys.stderr)
                notices.add(notice)
            self._replays.append(replayed)
            yield from replayed

    def _instead(self) -> Instead:
        args = self._args
        return Instead(
            profile=args.profile,
            model=self._model,
            other_model=self._other_model,
            tile=args.tile,
            can=tuple(args.can),
            stationary=args.stationary,
        )

    @property
    def remark(self) -> str | None:
        """What is missing, and why predictions may differ from those that were made."""
        remarks = [remark for one in self._recordings if (remark := one.remark)]
        if not all(one.is_whole for one in self._recordings):
            remarks.append("after what is missing, predictions may differ from those made then")
        return "; ".join(remarks) or None

    @property
    def left_out(self) -> list[LeftOut]:
        """Cycles that cannot be made again, so far."""
        return [part for one in self._replays for part in one.left_out if part.times_s]

    def is_left_out(self, time_s: float) -> bool:
        """Whether a cycle, at that time in JSON lines, is one of them."""
        return any(time_s in part.times_s for part in self.left_out)

    @property
    def messages(self) -> int:
        """How many were read."""
        return sum(one.messages for one in self._recordings)

    @property
    def pipelines(self) -> list[Pipeline]:
        """Of the recordings so far."""
        return [one.pipeline for one in self._replays]


def replay(pipeline: Pipeline, messages: Iterable[can.Message]) -> Iterator[ForecastSet]:
    """Every prediction the service would have made, on the clock of the messages' stamps.

    A message whose stamp is no time (NaN, infinite) is left out; no log reader passes one on.
    """
    now_s = None
    for message in messages:
        if not math.isfinite(message.timestamp):
            continue
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
    try:
        with whole(path) as stream:
            yield stream
    except OSError as error:
        raise EqrtError(
            f"cannot write {path} ({error.strerror}); give --out a file that can be written"
        ) from error
