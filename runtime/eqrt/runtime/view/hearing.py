"""Hearing a running service: its datagrams, whole cycles of them. Needs no extra."""

from __future__ import annotations

import socket
from collections import Counter
from collections.abc import Iterator

from eqrt.core.errors import UsageError
from eqrt.runtime.output.datagrams import Datagram, decode_datagram
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.view.joining import Joiner

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
    """Hears datagrams, gives whole records."""

    def __init__(self, receiver: socket.socket) -> None:
        self._receiver = receiver
        self._joiner = Joiner()
        self.trouble = ""
        """Why what came last could not be read; empty if it could."""
        self.refused: Counter[str] = Counter()
        """Since the start: why datagrams could not be read, and how many."""

    @property
    def lost_cycles(self) -> int:
        """That were sent and did not come whole."""
        return self._joiner.lost_cycles

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
                payload = self._receiver.recv(_LARGEST_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            try:
                heard = decode_datagram(payload)
            except ValueError as error:
                self.trouble = str(error)
                if self.trouble in self.refused or len(self.refused) < _MOST_REASONS:
                    self.refused[self.trouble] += 1
                continue
            self.trouble = ""
            yield payload, heard
