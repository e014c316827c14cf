"""The service's log: one line for every event, as text for people or as JSON for machines.

The same event is said a few times a minute at most; how often it was left out is said with the
next one. So whatever happens on a bus cannot fill a disk. Whoever reads the log cannot hold up the
service either: lines that are not taken are left out, and that is said later.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum
from typing import Any, TextIO

from eqrt.runtime.operation.outlet import Outlet

PER_MINUTE = 6
"""Lines of one event at most."""
FORMATS = ("text", "json")
_WINDOW_S = 60.0


class Level(IntEnum):
    """How bad; the numbers are syslog's, which the journal knows."""

    ERROR = 3
    WARNING = 4
    INFO = 6


LEVELS = {level.name.lower(): level for level in Level}
"""By the names on the command line."""


@dataclass(slots=True)
class _Window:
    """The minute of one event."""

    ends_s: float
    said: int = 0
    left_out: int = 0


class EventLog:
    """Writes events to a stream, standard output unless told otherwise."""

    def __init__(
        self,
        form: str = "text",
        level: Level = Level.INFO,
        *,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        """`form`: one of FORMATS. Events less bad than `level` are not written.

        Under systemd, text lines carry their level the way that the journal reads it (sd-daemon(3):
        `<4>`).
        """
        self.is_json = form == "json"
        self._level = level
        self._outlet = Outlet(sys.stdout if stream is None else stream)
        self._untaken = 0
        self._clock = clock
        self._for_journal = "JOURNAL_STREAM" in environment
        self._windows: dict[str, _Window] = {}

    def say(self, level: Level, event: str, text: str, **fields: Any) -> bool:
        """One event: `event` is its name, by which it is counted; `fields` are for JSON alone.

        Whether it was written: it was bad enough, and had not been said too often.
        """
        if level > self._level:
            return False
        left_out = self._admit(event)
        if left_out is None:
            return False
        if left_out:
            fields["left_out"] = left_out
            text += f" ({left_out} more like it left out)"
        self._write(level, event, text, fields)
        return True

    def goes_to(self, stream: TextIO) -> bool:
        """Whether what is written to that stream stands among the log's lines."""
        return self._outlet.leads_to(stream)

    def line(self, event: str, text: str, **fields: Any) -> None:
        """A line that is always said: the status of a second, the first and the last one."""
        if self.is_json:
            self._write(Level.INFO, event, text, fields)
        else:
            self._put(text)

    def _admit(self, event: str) -> int | None:
        """How many were left out before this one; None = this one is left out, too."""
        now_s = self._clock()
        window = self._windows.get(event)
        if window is None or now_s >= window.ends_s:
            left_out = window.left_out if window else 0
            self._windows[event] = _Window(now_s + _WINDOW_S, said=1)
            return left_out
        if window.said >= PER_MINUTE:
            window.left_out += 1
            return None
        window.said += 1
        return 0

    def _write(self, level: Level, event: str, text: str, fields: dict[str, Any]) -> None:
        self._put(self._formed(level, event, text, fields))

    def _put(self, line: str) -> None:
        """Nobody is waited for: what is not taken is counted, and said when lines are again."""
        if self._untaken:
            text = f"{self._untaken} lines are missing here: nobody took them"
            fields = {"untaken": self._untaken}
            if not self._outlet.put(self._formed(Level.WARNING, "log", text, fields)):
                self._untaken += 1
                return
            self._untaken = 0
        if not self._outlet.put(line):
            self._untaken += 1

    def _formed(self, level: Level, event: str, text: str, fields: dict[str, Any]) -> str:
        if self.is_json:
            now = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
            told = {"time": now, "level": level.name.lower(), "event": event, "text": text}
            return json.dumps(told | fields, ensure_ascii=False)
        prefix = f"<{level:d}>" if self._for_journal else f"{time.strftime('%H:%M:%S')} "
        said = "" if level is Level.INFO else f"{level.name.lower()}: "
        return f"{prefix}{said}{text}"
