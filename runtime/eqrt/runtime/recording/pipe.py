"""The way to the writer: bounded, and never waited for."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import time
from collections import deque

MAX_WAITING_BYTES = 8 << 20
"""What waits in this process while the writer, most often its disk, is busy: some seconds."""
_PIPE_BYTES = 1 << 20  # asked for; what Linux grants everybody


class PipeEnd:
    """The writing end of a pipe that takes what fits, and keeps some more."""

    def __init__(self, descriptor: int, max_waiting_bytes: int = MAX_WAITING_BYTES) -> None:
        self._descriptor = descriptor
        self._max_bytes = max_waiting_bytes
        self._waiting: deque[memoryview] = deque()
        self.waiting_bytes = 0
        """Not yet taken by the pipe."""
        self.is_open = True
        """Whether somebody still reads at the other end."""
        os.set_blocking(descriptor, False)
        with contextlib.suppress(OSError):  # a system that allows less
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def offer(self, piece: bytes) -> bool:
        """Send it when there is room; False = it was not taken, whole or in part."""
        self.push()
        if not self.is_open or self.waiting_bytes + len(piece) > self._max_bytes:
            return False
        self._waiting.append(memoryview(piece))
        self.waiting_bytes += len(piece)
        self.push()
        return self.is_open

    def push(self) -> None:
        """Send what the pipe takes now."""
        try:
            while self._waiting and self.is_open:
                first = self._waiting[0]
                taken = os.write(self._descriptor, first)
                self.waiting_bytes -= taken
                if taken < len(first):
                    self._waiting[0] = first[taken:]
                    return
                self._waiting.popleft()
        except BlockingIOError:
            return
        except OSError:  # EPIPE: the writer has ended
            self._give_up()

    def drain(self, give_up_s: float) -> None:
        """Send what waits, as far as it is taken before `give_up_s` on the monotonic clock."""
        while self._waiting and self.is_open and (left_s := give_up_s - time.monotonic()) > 0.0:
            select.select([], [self._descriptor], [], left_s)
            self.push()

    def close(self, give_up_s: float) -> None:
        """Send the rest, as far as it is taken before `give_up_s`, and say that this was all."""
        self.drain(give_up_s)
        self._give_up()
        os.close(self._descriptor)

    def _give_up(self) -> None:
        self.is_open = False
        self._waiting.clear()
        self.waiting_bytes = 0
