"""What a channel has still to take of a cycle's messages.

A network interface has room for 10 messages unless told otherwise, and refuses the others until the
bus has carried some. Nobody says when: select(2) calls a socket writable all the time. So what was
refused is offered again, every two milliseconds, by whoever waits for messages anyway.
"""

from __future__ import annotations

import errno
import math
import time
from collections import deque
from collections.abc import Iterable

import can

from eqrt.runtime.bus.buses import Sender, carries_fd

AGAIN_S = 0.002
"""Between offers; ten classic messages take longer at 500 kbit/s, so the bus is kept busy."""
_GONE = {errno.ENETDOWN, errno.ENODEV, errno.ENXIO}  # what is said now would be old when it is back


class Outbox:
    """Messages in the order in which they are to be sent, without ever waiting for the bus."""

    def __init__(self, bus: Sender) -> None:
        self._bus = bus
        self._waiting: deque[can.Message] = deque()
        self._due_s = math.inf
        self.sent = 0
        """Messages that the bus took."""
        self.failed = 0
        """Messages that were given up: it had no room for them, or was down."""

    @property
    def is_fd(self) -> bool:
        """Whether the bus carries CAN FD; that may change while it is down."""
        return carries_fd(self._bus)

    def give_up(self) -> list[can.Message]:
        """Forget what has not been sent yet, and tell what that was."""
        left = [*self._waiting]
        self._waiting.clear()
        self.failed += len(left)
        return left

    def put(self, messages: Iterable[can.Message]) -> None:
        """Send these after all others: now, as many as the bus takes."""
        self._waiting.extend(messages)
        self._due_s = -math.inf
        self.push(time.monotonic())

    def push(self, now_s: float) -> float:
        """Send what the bus takes by now; the seconds until this wants a call."""
        if now_s >= self._due_s:
            self._due_s = now_s + self._offer()
        return self._due_s - now_s

    def _offer(self) -> float:
        while self._waiting:
            try:
                self._bus.send(self._waiting[0])
            except OSError as error:
                return math.inf if error.errno in _GONE else AGAIN_S
            except can.CanError as error:
                return math.inf if error.error_code in _GONE else AGAIN_S
            self._waiting.popleft()
            self.sent += 1
        return math.inf
