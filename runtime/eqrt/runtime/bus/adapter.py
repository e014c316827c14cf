"""Adapters that python-can drives, each read by a thread: its driver may wait as it likes."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque

import can

from eqrt.core.errors import in_one_line

_NOTICE_END_S = 0.1  # how often the thread looks whether it is to end
_MOST_HEARD = 1 << 14  # messages kept; three seconds of a full 500 kbit/s bus are 12,000
_MOST_QUEUED_S = 10.0  # in a driver; a stamp from before is another clock's
_END_S = 1.0  # a driver whose device is gone may never come back from reading


class Adapter:
    """An open channel."""

    def __init__(self, bus: can.BusABC, channel: str) -> None:
        """The bus is closed with this. Its messages get `channel`, whatever its driver calls it.

        Some drivers stamp messages with a clock of their own, which counts from when the adapter
        was plugged in. What cannot be the wall clock's becomes the time at which the message came
        out of the driver.
        """
        self._bus = bus
        self._channel = channel
        self._heard: deque[can.Message] = deque(maxlen=_MOST_HEARD)
        self._dropped = 0
        self._failure: Exception | None = None
        self._is_ending = False
        self._bell, self._ringer = socket.socketpair()
        self._bell.setblocking(False)
        self._ringer.setblocking(False)
        self._thread = threading.Thread(target=self._listen, name=f"eqrt {channel}", daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        try:
            while not self._is_ending:
                if (message := self._bus.recv(_NOTICE_END_S)) is not None:
                    message.channel = self._channel
                    message.timestamp = _wall_clock(message.timestamp)
                    self._dropped += len(self._heard) == _MOST_HEARD  # the oldest goes
                    self._heard.append(message)
                    self._ring()
        except Exception as error:  # a driver may raise anything
            self._failure = error
            self._ring()

    def _ring(self) -> None:
        with contextlib.suppress(OSError):  # full: it rings already; closed: nobody listens
            self._ringer.send(b"\0")

    @property
    def protocol(self) -> can.CanProtocol:
        """Whether it carries CAN FD."""
        return self._bus.protocol

    def fileno(self) -> int:
        """For select: readable when something has come, or the channel is lost."""
        return self._bell.fileno()

    def read(self) -> list[can.Message]:
        """What has come, oldest first. Never waits; can.CanOperationError if the bus is lost."""
        with contextlib.suppress(BlockingIOError):
            self._bell.recv(4096)
        messages = [self._heard.popleft() for _ in range(len(self._heard))]
        if self._failure is not None and not messages:
            raise can.CanOperationError(in_one_line(self._failure)) from self._failure
        if self._failure is not None:
            self._ring()
        return messages

    def send(self, msg: can.Message) -> None:
        """Hand a message to the driver; whatever it raises becomes a can.CanOperationError."""
        try:
            self._bus.send(msg, timeout=0.0)
        except (can.CanError, OSError):
            raise
        except Exception as error:
            raise can.CanOperationError(f"{error}") from error

    def drops(self) -> int | None:
        """How many found no room here; python-can's drivers do not tell how many before."""
        return self._dropped or None

    def shutdown(self) -> None:
        """End the thread and close the bus."""
        self._is_ending = True
        self._thread.join(_END_S)
        with contextlib.suppress(Exception):  # what a driver says of a device that is gone
            self._bus.shutdown()
        self._bell.close()
        self._ringer.close()


def _wall_clock(stamp_s: float) -> float:
    """The stamp, if the wall clock can have been so while the message was in the driver."""
    now_s = time.time()
    return stamp_s if 0.0 <= now_s - stamp_s <= _MOST_QUEUED_S else now_s
