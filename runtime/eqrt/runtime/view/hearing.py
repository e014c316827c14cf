"""Hearing a running service: its datagrams, whole cycles of them. Needs no extra."""

from __future__ import annotations

import math
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator

from eqrt.core.errors import UsageError
from eqrt.runtime.output.datagrams import Datagram, decode_datagram
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.view.joining import Joiner

SILENT_S = 1.5
"""A service says how it is once a second: one that is silent for longer has ended."""
_RECEIVE_BYTES = 1 << 20  # 5 s of 64 objects with one mode: what comes while the viewer is busy
_LARGEST_BYTES = 65_535
_MOST_REASONS = 16  # a stranger may give any number of them

Record = ForecastSet | ServiceStatus


def listen(address: str) -> socket.socket:
    """A socket that hears what `eqrt serve --datagrams ADDRESS` says. Raises UsageError."""
    host, _, port = address.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
        family, _, _, _, target = found[0]
        receiver = socket.socket(family, socket.SOCK_DGRAM)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"cannot listen at {address!r} ({error}); give HOST:PORT, such as 127.0.0.1:47310"
        ) from error
    receiver.setblocking(False)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
    try:
        receiver.bind(target)
    except OSError as error:
        receiver.close()
        raise UsageError(
            f"cannot listen at {address} ({error.strerror}); if another viewer does, give both "
            "the service and this one a second address: --datagrams HOST:PORT"
        ) from error
    return receiver


class Ear:
    """Hears datagrams, gives whole records: those of one service at a time.

    Where several send to one address, it is the first that is heard, until it has said nothing for
    SILENT_S; whoever starts again sends from another port.
    """

    def __init__(
        self, receiver: socket.socket, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`clock`: seconds."""
        self._receiver = receiver
        self._clock = clock
        self._joiner = Joiner()
        self._speaker, self._heard_s = "", -math.inf
        self._stranger = ""  # heard since the speaker was
        self._other, self._other_s = "", -math.inf
        self._unreadable = ""
        self.refused: Counter[str] = Counter()
        """Since the start: why datagrams were left out, and how many."""

    @property
    def lost_cycles(self) -> int:
        """That were sent and did not come whole."""
        return self._joiner.lost_cycles

    @property
    def trouble(self) -> str:
        """What is wrong now: what came last could not be read, or two services send; else empty."""
        other = self._other if self._clock() - self._other_s < SILENT_S else ""
        return "; ".join(filter(None, (self._unreadable, other)))

    def records(self) -> Iterator[Record]:
        """What has come since, cycles joined from their parts; never waits."""
        for _, heard in self.datagrams():
            if not isinstance(heard, Datagram):
                yield heard
            elif (whole := self._joiner.add(heard)) is not None:
                yield whole

    def datagrams(self) -> Iterator[tuple[bytes, Datagram | ServiceStatus]]:
        """What has come since as it came, with what it says; nothing that cannot be read."""
        while True:
            try:
                payload, sender = self._receiver.recvfrom(_LARGEST_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            try:
                heard = decode_datagram(payload)
            except ValueError as error:
                self._unreadable = str(error)
                self._refuse(self._unreadable)
                continue
            self._unreadable = ""
            if self._listens_to(f"{sender[0]}:{sender[1]}"):
                yield payload, heard

    def _listens_to(self, sender: str) -> bool:
        now_s = self._clock()
        if sender != self._speaker and now_s - self._heard_s < SILENT_S:
            self._stranger = sender  # a second one, or the same that has started again
            return False
        if sender != self._speaker:
            self._joiner.begin_anew()
        elif self._stranger:  # both are there
            self._other_s = now_s
            self._other = (
                f"a second service ({self._stranger}) sends to this address and is left out: "
                "give it one of its own, --datagrams HOST:PORT"
            )
            self._refuse(self._other)
        self._speaker, self._heard_s, self._stranger = sender, now_s, ""
        return True

    def _refuse(self, reason: str) -> None:
        if reason in self.refused or len(self.refused) < _MOST_REASONS:
            self.refused[reason] += 1
