"""sd_notify(3): tells systemd, or whoever speaks its protocol, how the service is.

A datagram of lines `NAME=value` to the Unix socket in $NOTIFY_SOCKET; where there is none, nothing
is said. The watchdog is fed by completed turns of the service's loop and by nothing else: a bus
that is silent does not end the service, a model or a loop that hangs does.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import time
from collections.abc import Callable, Mapping
from typing import Self

from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.status_book import status_line


class ServiceManager:
    """The other end of $NOTIFY_SOCKET."""

    def __init__(
        self,
        address: str | None,
        watchdog_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`address`: a path, or `@` and an abstract name; None = nobody listens.

        `watchdog_s`: how often it wants to hear that the service lives; None = never.
        """
        self._socket = None
        self._clock = clock
        self._feed_s = watchdog_s / 4 if watchdog_s else math.inf
        self._feed_due_s = 0.0 if watchdog_s else math.inf
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
            self._address = f"\0{address[1:]}" if address.startswith("@") else address

    @classmethod
    def of(cls, environment: Mapping[str, str] = os.environ) -> Self:
        """The one that started this process."""
        usec = environment.get("WATCHDOG_USEC", "")
        is_ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_s = int(usec) / 1e6 if usec.isdecimal() and is_ours else None
        return cls(environment.get("NOTIFY_SOCKET"), watchdog_s or None)

    def ready(self) -> None:
        """It serves; also said when a reload has ended."""
        self._say("READY=1")

    def stopping(self) -> None:
        """It has been told to end."""
        self._say("STOPPING=1")

    def reload(self, is_loading: bool) -> None:
        """A reload begins, or has ended."""
        if is_loading:
            usec = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
            self._say(f"RELOADING=1\nMONOTONIC_USEC={usec}")
        else:
            self.ready()

    def report(self, status: ServiceStatus) -> None:
        """The line that `systemctl status` shows."""
        self._say(f"STATUS={status_line(status)}")

    def __call__(self) -> None:
        """A turn of the loop is complete (`service.Chore`)."""
        now_s = self._clock()
        if now_s >= self._feed_due_s:
            self._feed_due_s = now_s + self._feed_s
            self._say("WATCHDOG=1")

    def _say(self, lines: str) -> None:
        if self._socket is None:
            return
        with contextlib.suppress(OSError):  # its queue is full, or it is gone: we serve the bus
            self._socket.sendto(lines.encode(), self._address)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._socket is not None:
            self.stopping()
            self._socket.close()
