"""`eqrt replay-fleet`: run the service on a folder of recorded logs, on all cores or a cluster.

Per log, the output folder gets what `eqrt replay` writes (LOG.jsonl) and, when that is whole, a
page about it (LOG.json): what it was made with and what is in it. A log whose page tells of the
same log, profile, model and tile is not replayed again, so a run that was ended goes on.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import msgspec

from eqrt.core.errors import EqrtError, LogError
from eqrt.export.can_recordings import find_logs
from eqrt.export.cluster import add_worker_arguments, run_pieces
from eqrt.export.profiles import absolute_profile, profile_id
from eqrt.runtime.advice import no_predictions
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.runtime.prediction.tiles import Tile, load_tile
from eqrt.runtime.replay import output, replay
from eqrt.runtime.serve_options import add_pipeline_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt replay-fleet`."""
    parser.epilog = "example: eqrt replay-fleet drives/ --profile ars408 --out predictions/"
    parser.add_argument(
        "folder",
        type=Path,
        metavar="FOLDER",
        help="candump .log, .asc, .blf and .trc, also with .gz, in it and the folders in it",
    )
    add_pipeline_arguments(parser)
    parser.add_argument(
        "--can",
        action="append",
        default=[],
        metavar="[ROLE=]NAME",
        help="read only the logs' channel NAME, as for `eqrt replay` (repeatable)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="where to write a file of JSON lines per log; what is whole there is kept",
    )
    add_worker_arguments(parser)
    parser.add_argument(
        "--keep-going",
        action="store_true",
        help="count logs that cannot be replayed, or that give no prediction, and go on (default: "
        "stop at the first)",
    )


def run(args: argparse.Namespace) -> int:
    """Replay all logs, a line each as they are done, and say how it went."""
    folder, out = args.folder.resolve(), args.out.resolve()
    pieces = [
        LogToReplay(log, out / log.relative_to(folder).parent / log.name)
        for log in find_logs(folder)
    ]
    replayer = Replayer(
        profile=absolute_profile(args.profile),
        model=args.model.resolve(),
        tile=args.tile.resolve() if args.tile else None,
        channels=tuple(args.can),
        stationary=args.stationary,
    )
    replayer.check()
    started_s = time.perf_counter()
    print(_HEAD)
    total, failed = Replayed(), 0
    for outcome in run_pieces(replayer, pieces, jobs=args.jobs, scheduler=args.scheduler):
        name = pieces[outcome.index].log.relative_to(folder)
        if outcome.value is not None:
            total += outcome.value
            print(outcome.value.row(str(name)), flush=True)
        elif outcome.error is not None:
            if not args.keep_going:
                raise outcome.error
            failed += 1
            print(f"eqrt: {outcome.error}", file=sys.stderr, flush=True)
    print(total.row(f"{len(pieces) - failed} logs, {failed} failed"))
    print(f"eqrt replay-fleet: {time.perf_counter() - started_s:.1f} s", file=sys.stderr)
    return 0


@dataclass(frozen=True, slots=True)
class LogToReplay:
    """One log, and where its predictions go. Absolute paths: it crosses machines."""

    log: Path
    out: Path
    """Without the suffix that is added: LOG.jsonl and LOG.json."""

    @property
    def name(self) -> str:
        """How errors call it."""
        return str(self.log)

    @property
    def lines(self) -> Path:
        """The predictions."""
        return self.out.parent / f"{self.out.name}.jsonl"

    @property
    def page(self) -> Path:
        """What they were made with; there when they are whole."""
        return self.out.parent / f"{self.out.name}.json"


@dataclass(frozen=True, slots=True)
class Replayed:
    """What is in the predictions of a log, or of several."""

    messages: int = 0
    cycles: int = 0
    """Sensor cycles decoded."""
    predictions: int = 0
    """JSON lines."""
    fallbacks: int = 0
    """Of them those that the guard refused."""
    unusable: int = 0
    """Messages of the profile that were damaged, cut or out of place."""
    remark: str | None = None
    """What of the log could not be read, None = all could."""

    def __add__(self, other: Replayed) -> Replayed:
        return Replayed(
            self.messages + other.messages,
            self.cycles + other.cycles,
            self.predictions + other.predictions,
            self.fallbacks + other.fallbacks,
            self.unusable + other.unusable,
        )

    def row(self, name: str) -> str:
        """A line of the table."""
        counts = (self.messages, self.cycles, self.predictions, self.fallbacks, self.unusable)
        remark = f"  ({self.remark})" if self.remark else ""
        return "".join(f"{count:>12}" for count in counts) + f"  {name}{remark}"


_HEAD = "".join(
    f"{title:>12}" for title in ("messages", "cycles", "predictions", "fallbacks", "unusable")
)


@dataclass(frozen=True, slots=True)
class _Page:
    """LOG.json."""

    made_with: dict[str, str]
    replayed: Replayed


@dataclass(frozen=True, slots=True, kw_only=True)
class Replayer:
    """Replays one log after the other; the fields are the options of `eqrt replay`."""

    profile: str
    model: Path
    tile: Path | None
    channels: tuple[str, ...]
    stationary: bool

    def check(self) -> None:
        """Raise what any log would: a profile, model, tile or channel that cannot be used."""
        self._pipeline()

    def __call__(self, piece: LogToReplay) -> Replayed:
        """Replay, or find that it was done. Raises LogError, also if no prediction came out, and
        what `check` raises.
        """
        made_with = self._made_with(piece.log)
        known = _read_page(piece)
        if known is not None and known.made_with == made_with:
            return known.replayed
        try:
            piece.out.parent.mkdir(parents=True, exist_ok=True)
            piece.page.unlink(missing_ok=True)
        except OSError as error:
            raise EqrtError(
                f"cannot write into {piece.out.parent} ({error.strerror}); give --out a folder "
                "that can be written"
            ) from error
        replayed = self._replay(piece)
        with output(str(piece.page)) as page:
            page.write(msgspec.json.encode(_Page(made_with, replayed)))
        return replayed

    def _replay(self, piece: LogToReplay) -> Replayed:
        log, pipeline = read_log(piece.log), self._pipeline()
        with output(str(piece.lines)) as lines:
            for forecast in replay(pipeline, log):
                lines.write(json_lines(forecast))
            if not pipeline.counters.targets:
                raise LogError(f"{piece.log}: no predictions: {no_predictions(pipeline)}")
        decoded, counters = pipeline.decoder.counters, pipeline.counters
        return Replayed(
            messages=log.messages,
            cycles=decoded.cycles,
            predictions=counters.targets,
            fallbacks=counters.fallbacks,
            unusable=decoded.not_data + decoded.stray + decoded.short + decoded.bad_checksum,
            remark=log.remark,
        )

    def _pipeline(self) -> Pipeline:
        profile = load_profile(self.profile)
        return Pipeline(
            profile,
            _predictor(self.model),
            _tile(self.tile) if self.tile else None,
            channels=parse_channels(self.channels, profile.roles) or None,
            stationary=self.stationary,
        )

    def _made_with(self, log: Path) -> dict[str, str]:
        """Everything that decides what the predictions are, and the same on every machine."""
        return {
            "log": f"{log.name}, {_bytes_of(log)} bytes",
            "eqrt": importlib.metadata.version("eqrt"),
            "profile": profile_id(self.profile),
            "model": _predictor(self.model).model_id,
            "tile": _tile(self.tile).info.tile_id if self.tile else "",
            "channels": " ".join(self.channels),
            "stationary": str(self.stationary),
        }


@lru_cache(maxsize=1)
def _predictor(model: Path) -> Predictor:
    return Predictor.load(model)


@lru_cache(maxsize=1)
def _tile(path: Path) -> Tile:
    return load_tile(path)


def _bytes_of(log: Path) -> int:
    try:
        return log.stat().st_size
    except OSError as error:
        raise LogError(f"cannot read {log}: {error.strerror or error}") from error


def _read_page(piece: LogToReplay) -> _Page | None:
    """What is known of predictions that are whole; None if there are none."""
    try:
        page = msgspec.json.decode(piece.page.read_bytes(), type=_Page)
    except (OSError, msgspec.DecodeError):
        return None
    return page if piece.lines.is_file() else None
