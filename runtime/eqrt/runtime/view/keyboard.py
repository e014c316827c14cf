"""Single keys from a terminal, and the terminal as it was afterwards."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from typing import Self


class Keyboard:
    """Standard input, a key at a time, for as long as its `with` block."""

    def __enter__(self) -> Self:
        self._file = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._file)
        tty.setcbreak(self._file)
        return self

    def __exit__(self, *_: object) -> None:
        termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)

    def fileno(self) -> int:
        """For `select`."""
        return self._file

    def read(self) -> list[str]:
        """What has been typed since, without waiting; an escape sequence (an arrow) is one key."""
        text = ""
        while select.select([self._file], [], [], 0.0)[0]:
            typed = os.read(self._file, 64)
            if not typed:
                return ["q"]  # the terminal has gone
            text += typed.decode(errors="ignore")
        return [text] if text.startswith("\x1b") and len(text) > 1 else list(text)
