"""`eqrt top`: the tracks of a running service as a table in the terminal."""

from __future__ import annotations

import argparse
import math
import select
import sys
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import accumulate, islice
from typing import Literal

import numpy as np
from rich.console import Console, ConsoleDimensions, Group, RenderableType
from rich.live import Live as LiveDisplay
from rich.table import Table
from rich.text import Text

from eqrt.core.errors import UsageError
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.signals import until_told_to_stop
from eqrt.runtime.view.command import add_datagram_argument
from eqrt.runtime.view.hearing import Ear, Record, listen
from eqrt.runtime.view.hindsight import Ghosts, Score
from eqrt.runtime.view.keyboard import Keyboard
from eqrt.runtime.view.updates import ego_pose
from eqrt.runtime.view.watch import Watch
from eqrt.runtime.view.words import (
    AGENT_BRIEF,
    AGENT_LEVELS,
    BAD,
    GOOD,
    LEVELS,
    class_words,
    drops,
    mode_words,
)

_REDRAW_S = 0.2
_SILENT_S = 2.0
_ESCAPE, _ENTER, _ERASE = "\x1b", ("\r", "\n"), ("\x7f", "\b")
_MARKS = {GOOD: ("OK", "bold green"), "limited": ("!", "bold yellow"), BAD: ("X", "bold red")}
_COLUMNS = (  # heading, alignment, width
    ("track", "right", 7),
    ("class", "left", 10),
    ("range m", "right", 9),
    ("speed m/s", "right", 11),
    ("mode", "left", 13),
    ("age ms", "right", 6),
    ("off 1s", "right", 6),
    ("2s", "right", 5),
    ("3s", "right", 5),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt top`."""
    parser.epilog = "keys: q quit, p pause, f or / filter, s sort, Esc all tracks again"
    add_datagram_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Show until `q`, Ctrl-C or SIGTERM."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise UsageError(
            "eqrt top needs a terminal; without one, `eqrt serve` prints a line a second"
        )
    state = State(address=args.datagrams)
    with listen(args.datagrams) as receiver, until_told_to_stop() as should_stop:
        ear = Ear(receiver)
        console = Console()
        with (
            Keyboard() as keyboard,
            LiveDisplay(console=console, screen=True, auto_refresh=False) as display,
        ):
            due_s = 0.0
            while not (state.ended or should_stop()):
                select.select([receiver.fileno(), keyboard.fileno()], [], [], _REDRAW_S)
                for record in ear.records():
                    state.take(record, time.monotonic())
                state.lost_cycles, state.trouble = ear.lost_cycles, ear.trouble
                typed = keyboard.read()
                for key in typed:
                    state.press(key)
                if typed or time.monotonic() >= due_s:
                    display.update(render(state, console.size, time.monotonic()), refresh=True)
                    due_s = time.monotonic() + _REDRAW_S
    return 0


@dataclass(slots=True)
class Track:
    """A row of the table."""

    track_id: int
    kind: str
    range_m: float
    speed_mps: float
    how: str
    level: str
    age_s: float
    errors_m: list[float]
    """Where it is from where it was predicted to be, 1, 2 and 3 s ago."""

    @property
    def words(self) -> str:
        """What a filter is looked for in."""
        return f"{self.track_id} {self.kind} {self.how}"


SORTS = {
    "range": lambda track: (math.isnan(track.range_m), track.range_m),
    "track": lambda track: track.track_id,
    "speed": lambda track: -(0.0 if math.isnan(track.speed_mps) else track.speed_mps),
}
"""What the key `s` goes through -> the order."""


@dataclass(slots=True)
class State:
    """What is known, and what the keys have set."""

    address: str
    watch: Watch = field(default_factory=Watch)
    cycle: ForecastSet | None = None
    tracks: list[Track] = field(default_factory=list)
    score: Score | None = None
    status: ServiceStatus | None = None
    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=600))
    heard_s: float = -math.inf
    lost_cycles: int = 0
    trouble: str = ""
    paused: bool = False
    ended: bool = False
    typing: bool = False
    """A filter is being typed."""
    pattern: str = ""
    sort: str = "range"

    def take(self, record: Record, now_s: float) -> None:
        """Something that was heard; while paused it is heard, but not shown."""
        if isinstance(record, ServiceStatus):
            self.latencies_s.extend(record.latencies_s)
            if not self.paused:
                self.status = record
            return
        self.heard_s = now_s
        ghosts, score = self.watch.add(record)
        if not self.paused:
            self.cycle, self.score = record, score
            self.tracks = _tracks(record, ghosts)

    def press(self, key: str) -> None:
        """A key, as `Keyboard.read` gives it."""
        if self.typing:
            self._type(key)
        elif key == "q":
            self.ended = True
        elif key in {"p", " "}:
            self.paused = not self.paused
        elif key in {"f", "/"}:
            self.typing, self.pattern = True, ""
        elif key == "s":
            names = list(SORTS)
            self.sort = names[(names.index(self.sort) + 1) % len(names)]
        elif key == _ESCAPE:
            self.pattern = ""

    def _type(self, key: str) -> None:
        if key in _ENTER:
            self.typing = False
        elif key == _ESCAPE:
            self.typing, self.pattern = False, ""
        elif key in _ERASE:
            self.pattern = self.pattern[:-1]
        elif key.isprintable():
            self.pattern += key

    def shown(self) -> list[Track]:
        """The tracks that pass the filter, in order."""
        wanted = self.pattern.lower()
        chosen = [track for track in self.tracks if wanted in track.words.lower()]
        return sorted(chosen, key=SORTS[self.sort])


def render(state: State, size: ConsoleDimensions, now_s: float) -> RenderableType:
    """The whole screen."""
    head = [*_head(state, now_s), Text()]
    for line in head:
        line.no_wrap, line.overflow = True, "ellipsis"
    if state.cycle is None:
        return Group(*head, Text("q quit", "dim"))
    foot = _foot(state)
    room = max(1, size.height - len(head) - 5)
    return Group(*head, _table(state.shown(), room, size.width, sort=state.sort), foot)


def _head(state: State, now_s: float) -> list[Text]:
    if state.cycle is None:
        return [
            Text.assemble(("Waiting for predictions at ", "bold"), state.address),
            Text(f"start the service with: eqrt serve ... --datagrams {state.address}"),
            *([Text(state.trouble, "red")] if state.trouble else []),
        ]
    mark, style = _MARKS[LEVELS[state.cycle.mode]]
    words = mode_words(state.cycle.mode, state.cycle.num_targets)
    for_s = state.watch.time_s - state.watch.mode_since_s
    if LEVELS[state.cycle.mode] != GOOD and not state.paused:
        words += f", for {for_s:.0f} s"
    if not state.paused and now_s - state.heard_s > _SILENT_S:
        mark, style = _MARKS[BAD]
        words = f"Nothing heard of the service for {now_s - state.heard_s:.0f} s; before that:"
    lines = [Text.assemble((f" {mark} ", f"{style} reverse"), " ", (words, "bold"))]
    if state.paused:
        lines[0].append("   paused", "bold magenta")
    lines += _service_lines(state)
    if state.score is not None:
        lines.append(_score_line(state.score))
    if state.trouble:
        lines.append(Text(state.trouble, "red"))
    return lines


def _service_lines(state: State) -> list[Text]:
    status = state.status
    if status is None:
        return [Text("The service has said nothing about itself yet", "dim")]
    per_s = 1.0 / status.seconds if status.seconds > 0.0 else math.nan
    rate = f"{_number(len(status.latencies_s) * per_s, 1)} predictions/s"
    up = "".join(f" on {bus.channel}" for bus in status.buses if bus.state == "UP")
    text = f"{_number(status.messages * per_s, 0)} messages/s in{up}, {rate}"
    if state.latencies_s:
        p50, p99 = 1e3 * np.quantile(list(state.latencies_s), [0.5, 0.99])
        text += f", latency {p50:.1f} ms (99 % within {p99:.1f})"
    lines = [Text(f"{text}, {state.lost_cycles} cycles missed here")]
    lines += [
        Text(f"CAN {bus.channel}: {bus.state}, for {bus.since_s:.0f} s", "red")
        for bus in status.buses
        if bus.state != "UP"
    ]
    lines += [
        Text(f"{source.name}: {source.reason}, for {source.since_s:.0f} s", "yellow")
        for source in status.sources
        if not source.valid
    ]
    if found := drops(status.totals):
        lines.append(
            Text(
                "Since the start: " + ", ".join(f"{words}: {n}" for words, n in found.items()),
                "yellow",
            )
        )
    return lines


def _score_line(score: Score) -> Text:
    """ADE at the longest horizon."""
    name = next(reversed([name for name in score.eqrt if name.startswith("ade")]))
    return Text(
        f"mean error over {name.removeprefix('ade_').removesuffix('s')} s in the last minute: "
        f"{score.eqrt[name]:.2f} m, constant velocity {score.constant_velocity[name]:.2f} m"
    )


def _table(tracks: list[Track], room: int, width: int, *, sort: str) -> Table:
    """As many of the columns as have room beside each other."""
    ends = accumulate(wide + 1 for _, _, wide in _COLUMNS)
    columns = [column for column, end in zip(_COLUMNS, ends, strict=True) if end <= width + 1]
    table = Table(box=None, header_style="bold", padding=(0, 1, 0, 0), expand=False)
    for name, side, wide in columns:
        mark = " v" if name.startswith(sort) else ""
        justify: Literal["left", "right"] = "right" if side == "right" else "left"
        table.add_column(name + mark, justify=justify, width=wide, no_wrap=True)
    for track in tracks[:room]:
        style = {GOOD: "", BAD: "red"}.get(track.level, "dim")
        table.add_row(*islice(_cells(track), len(columns)), style=style)
    if len(tracks) > room:
        table.add_row("...", f"{len(tracks) - room} more")
    return table


def _cells(track: Track) -> Iterable[str]:
    yield str(track.track_id)
    yield track.kind
    yield _number(track.range_m, 1)
    yield _number(track.speed_mps, 1)
    yield track.how
    yield f"{1e3 * track.age_s:.0f}"
    for error_m in track.errors_m:
        yield _number(error_m, 2)


def _foot(state: State) -> Text:
    if state.typing:
        return Text.assemble(("filter: ", "bold"), state.pattern, ("_", "blink"), "   Enter, Esc")
    of = f"{len(state.shown())} of {len(state.tracks)} tracks"
    filtered = f' with "{state.pattern}"' if state.pattern else ""
    keys = "q quit  p pause  f filter  s sort"
    words = f"{of}{filtered}; off: metres from where it was predicted to be\n{keys}"
    return Text(words, "dim", no_wrap=True, overflow="ellipsis")


def _tracks(now: ForecastSet, ghosts: Ghosts) -> list[Track]:
    ego = ego_pose(now) or (math.nan, math.nan)
    range_m = np.linalg.norm(now.position - ego[:2], axis=-1)
    speed_mps = np.linalg.norm(now.velocity, axis=-1)
    modes = [Mode(number) for number in now.agent_mode.tolist()]
    return [
        Track(
            track_id=track_id,
            kind=class_words(int(now.object_class[row])),
            range_m=float(range_m[row]),
            speed_mps=float(speed_mps[row]),
            how=AGENT_BRIEF.get(modes[row], modes[row].name),
            level=AGENT_LEVELS.get(modes[row], GOOD),
            age_s=float(now.age_s[row]),
            errors_m=ghosts.error_m[row].tolist(),
        )
        for row, track_id in enumerate(now.track_id.tolist())
    ]


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
