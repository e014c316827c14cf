"""Lines for somebody who may not read them: a pipe that is full must not stop the predictions."""

from __future__ import annotations

import contextlib
import os
import select
from typing import TextIO


class Outlet:
    """Writes lines to a stream as far as that can be done at once, without ever waiting."""

    def __init__(self, stream: TextIO) -> None:
        """What the stream itself has kept so far is written first."""
        self._stream = stream
        try:
            self._file: int | None = stream.fileno()
        except (OSError, ValueError):  # no file: nobody to wait for
            self._file = None
        with contextlib.suppress(OSError):  # its reader has gone, as `put` will find
            stream.flush()

    def put(self, line: str) -> bool:
        """Write a line; False if nobody takes it now, or ever again."""
        if self._file is None:
            self._stream.write(line + "\n")
            return True
        data = line.encode("utf-8", "backslashreplace") + b"\n"
        try:
            while data and self._has_room(self._file):
                data = data[os.write(self._file, data[: select.PIPE_BUF]) :]
        except OSError:  # the reader has gone, or the disk is full
            return False
        return not data

    def leads_to(self, stream: TextIO) -> bool:
        """Whether what is written to that stream stands among these lines."""
        try:
            return self._file is not None and os.path.sameopenfile(self._file, stream.fileno())
        except (OSError, ValueError):  # it is no file, or closed
            return self._stream is stream

    @staticmethod
    def _has_room(file: int) -> bool:
        """For select.PIPE_BUF bytes, as far as pipes go."""
        poll = select.poll()
        poll.register(file, select.POLLOUT)
        return any(event & select.POLLOUT for _, event in poll.poll(0))
