"""`eqrt demo`: recorded traffic over a CAN bus, predicted by the service and scored as it happens.

    eqrt play  --messages-->  eqrt serve  --datagrams-->  this process: scores and draws
                                          --datagrams-->  eqrt view: a page in a browser

Processes and no CAN hardware: the bus is `eqrt_local`. Nothing here knows the future; the
truth of a prediction is where the same track is measured a little later.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eqrt.core.errors import EqrtError, UsageError
from eqrt.core.files import write_whole
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.demo.picture import render
from eqrt.runtime.demo.programs import eqrt, running
from eqrt.runtime.demo.score import VELOCITY_S, Scoreboard
from eqrt.runtime.demo.snapshots import BestMoment
from eqrt.runtime.demo.viewing import watched
from eqrt.runtime.output.datagrams import Datagram, decode_datagram
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.prediction.tiles import load_tile

DATA = Path(__file__).parent / "data"
_START_S = 20.0  # a service that has not said that it runs by then never will
_SILENT_S = 3.0  # after the player has ended


_ABOUT_LINES = """\
A line a second. Errors come after 4 s, when what was predicted has happened: how far cars were from
where eqrt said that they would be, on average over 3 s (ADE) and at their end (FDE), over all that
was scored so far. Modes: RUN predicts with the map, NO_MAP without one; NO_POSE at first is normal
(nothing has told yet how the car moves); LATE: this machine had too much else to do.
"""
_HEAD = (
    f"  {'time':>6}  {'mode':8} {'':11}  {'compute':>8}   "
    "in brackets: had everybody kept speed and course (constant velocity)"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One recording, and how the service reads it."""

    name: str
    about: str
    log: Path
    serve: tuple[str, ...]
    tile: Path | None


PARTS = (
    Part(
        name="ngsim",
        about=(
            "A minute of US traffic (NGSIM; none of it seen in training) on its real lanes:\n"
            "one recorded car plays ego, the cars around it come as a CAN object list."
        ),
        log=DATA / "ngsim.log.gz",
        serve=("--profile", "generic", "--tile", str(DATA / "ngsim.tile")),
        tile=DATA / "ngsim.tile",
    ),
    Part(
        name="rav4",
        about=(
            "Raw CAN of a Toyota RAV4 on a motorway (comma2k19): its radar, wheel speeds and yaw\n"
            "rate, as the car sent them. No map; most radar tracks live less than a second,\n"
            "and the model has never been trained on a radar: this is what it is worth there."
        ),
        log=DATA / "rav4.log.gz",
        serve=("--profile", "toyota-rav4"),
        tile=None,
    ),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt demo`."""
    parser.add_argument(
        "--part", choices=[part.name for part in PARTS], help="show only this one (default: both)"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help="stop each part after that long; scores begin after 4 s (default: play all of it)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        metavar="FOLDER",
        help="where to write a picture of each part, eqrt-demo-PART.svg (default: here)",
    )
    parser.add_argument(
        "--view",
        action=argparse.BooleanOptionalAction,
        help="let it be watched in a browser, or not (default: if the extra `view` is installed)",
    )


def run(args: argparse.Namespace) -> int:
    """Play, predict, score and draw each part."""
    if args.seconds is not None and not args.seconds > 0.0:
        raise UsageError(f"--seconds is {args.seconds}; give a number above 0, 10 shows something")
    _make_folder(args.out)
    parts = [part for part in PARTS if args.part in (None, part.name)]
    with watched(args.view) as viewers:
        print(f"\n{_ABOUT_LINES}", end="", flush=True)
        for index, part in enumerate(parts):
            print(f"\n== Part {index + 1} of {len(parts)}: {part.name}\n{part.about}\n", flush=True)
            result = play_part(part, args.seconds, viewers)
            result.print_summary()
            picture = result.write_picture(args.out / f"eqrt-demo-{part.name}.svg")
            print(f"  picture    {picture if picture else 'none: nothing could be scored'}")
    print("\nnext: with your own radar, docs/start-radar.md")
    return 0


@dataclass(slots=True)
class PartResult:
    """What one part came to."""

    part: Part
    board: Scoreboard
    moment: BestMoment
    latencies_s: list[float]

    def print_summary(self) -> None:
        """The figures, beside constant velocity's."""
        if not self.board.count:
            print("  no prediction could be scored: too short")
            return
        ours, baseline = self.board.tables()
        print(f"\n  {self.board.count} predictions scored, mean errors in metres")
        print(f"  {'':18}" + "".join(f"{name.replace('_', ' ').upper():>9}" for name in ours))
        for label, table in (("eqrt", ours), ("constant velocity", baseline)):
            print(f"  {label:18}" + "".join(f"{value:9.2f}" for value in table.values()))
        p50, p99 = 1e3 * np.quantile(self.latencies_s, [0.5, 0.99])
        print(f"  time to predict all objects of a cycle: p50 {p50:.1f} ms, p99 {p99:.1f} ms")
        if self.board.too_young:
            print(f"  left out   {self.board.too_young} of tracks younger than {VELOCITY_S:g} s")
        print(f"  verdict    {_verdict(ours['fde_3s'], baseline['fde_3s'])}")

    def write_picture(self, path: Path) -> Path | None:
        """One moment of the part as SVG, or None if none could be scored. Raises EqrtError."""
        moment = self.moment.picture(load_tile(self.part.tile) if self.part.tile else None)
        if moment is None:
            return None
        try:
            write_whole(path, render(moment).encode())
        except OSError as error:
            raise EqrtError(f"{path}: cannot be written ({error.strerror})") from error
        return path.resolve()


def play_part(part: Part, seconds: float | None, viewers: Sequence[str] = ()) -> PartResult:
    """Run one part to its end, a line a second. `viewers`: where datagrams go besides."""
    result = PartResult(part, Scoreboard(), BestMoment(), [])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.2)
        address = f"127.0.0.1:{receiver.getsockname()[1]}"
        channel = f"eqrt-demo-{os.getpid()}"
        to = [address, *viewers]
        with _service(part, channel, to), _player(part, channel) as player:
            print(_HEAD)
            started_s = time.monotonic()
            line_due_s = started_s + 1.0
            for forecast in _forecasts(receiver, player, seconds):
                _take(result, forecast)
                if time.monotonic() >= line_due_s:
                    print(_line(result, forecast, time.monotonic() - started_s), flush=True)
                    line_due_s += 1.0
            if player.poll() is not None:
                print("  (end of recording)", flush=True)
    return result


def _verdict(ours_m: float, baseline_m: float) -> str:
    difference = ours_m / baseline_m - 1.0
    than = "nearer to" if difference < 0.0 else "farther from"
    return (
        f"after 3 s, eqrt is {abs(difference):.0%} {than} what happened than constant velocity: "
        f"{ours_m:.2f} m instead of {baseline_m:.2f} m"
    )


def _make_folder(folder: Path) -> None:
    """Now, because a minute later the pictures would be lost."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise EqrtError(
            f"cannot write pictures to {folder.resolve()} ({error.strerror}); "
            "give --out a folder that can be written"
        ) from error


def _take(result: PartResult, forecast: ForecastSet) -> None:
    if forecast.num_targets:
        result.latencies_s.append(forecast.compute_s)
    result.moment.add(forecast, result.board.add(forecast))


def _line(result: PartResult, forecast: ForecastSet, seconds: float) -> str:
    text = f"  {seconds:4.0f} s  {forecast.mode.name:<8} {forecast.num_targets:3d} objects"
    if result.latencies_s:
        text += f"  {1e3 * np.median(result.latencies_s[-10:]):5.1f} ms"
    if result.board.count:
        ours, baseline = result.board.tables()
        text += (
            f"   ADE 3 s {ours['ade_3s']:5.2f} m (constant velocity {baseline['ade_3s']:5.2f})"
            f"   FDE 3 s {ours['fde_3s']:5.2f} m ({baseline['fde_3s']:5.2f})"
        )
    return text


def _forecasts(
    receiver: socket.socket, player: subprocess.Popen[str], seconds: float | None
) -> Iterator[ForecastSet]:
    """What the service says, until the player has ended and nothing more comes.

    `seconds` count from the first prediction, however long the processes take to start.
    """
    end_s = math.inf
    while time.monotonic() < end_s:
        if player.poll() is not None:
            end_s = min(end_s, time.monotonic() + _SILENT_S)
        with contextlib.suppress(TimeoutError):
            heard = decode_datagram(receiver.recv(65_535))
            if not isinstance(heard, Datagram):
                continue
            forecast = heard.forecasts
            if forecast.mode is Mode.SILENT and player.poll() is not None:
                return
            if seconds is not None and forecast.num_targets:
                end_s = min(end_s, time.monotonic() + seconds)
            yield forecast


@contextlib.contextmanager
def _service(part: Part, channel: str, addresses: Sequence[str]) -> Iterator[None]:
    """`eqrt serve` in a process of its own, from when it listens until the end of the block."""
    command = [*eqrt("serve"), "--can", channel, "--can-interface", LOCAL, *part.serve]
    command += [f"--datagrams={address}" for address in addresses]
    with running([*command, "--out-can", channel, "--quiet"]) as service:
        _wait_until_ready(service)
        yield


def _wait_until_ready(service: subprocess.Popen[str]) -> None:
    assert service.stdout is not None
    too_late = threading.Timer(_START_S, service.kill)
    too_late.start()
    said = []
    for line in service.stdout:
        if line.startswith("eqrt serve:"):
            too_late.cancel()
            return
        said.append(line.strip())
    too_late.cancel()
    raise EqrtError(f"the service did not start: {said[-1] if said else 'it said nothing'}")


@contextlib.contextmanager
def _player(part: Part, channel: str) -> Iterator[subprocess.Popen[str]]:
    """`eqrt play` in a process of its own."""
    command = [*eqrt("play"), str(part.log), "--can", channel, "--can-interface", LOCAL]
    with running(command) as player:
        yield player
