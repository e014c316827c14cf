"""A running service: its datagrams, as they come, to every page."""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec

from eqrt.core.errors import UsageError
from eqrt.runtime.output.datagrams import Datagram, decode_datagram
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.view.joining import Joiner
from eqrt.runtime.view.server import SERVER_ID, Outbox, ViewServer, Wanted
from eqrt.runtime.view.updates import encode_status, encode_text
from eqrt.runtime.view.watch import Lanes, LastMinute, Watch

_RECEIVE_BYTES = 1 << 20  # 5 s of 64 objects with one mode: what comes while the viewer is busy
_LARGEST_BYTES = 65_535
_STATUSES = 61  # a minute

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
        """What came that could not be read."""

    @property
    def lost_cycles(self) -> int:
        """That were sent and did not come whole."""
        return self._joiner.lost_cycles

    def records(self) -> Iterator[Record]:
        """What has come since; never waits."""
        while True:
            try:
                payload = self._receiver.recv(_LARGEST_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            try:
                heard = decode_datagram(payload)
            except ValueError as error:
                self.trouble = str(error)
                continue
            self.trouble = ""
            if isinstance(heard, Datagram):
                if (whole := self._joiner.add(heard)) is not None:
                    yield whole
            else:
                yield heard


class Live:
    """What pages are told of a running service."""

    def __init__(self, ear: Ear, address: str, tile: Path | None) -> None:
        """`tile`: shown whatever the service uses; None = the service's own, where it is known."""
        self._ear = ear
        self._address = address
        self._watch, self._minute = Watch(), LastMinute()
        self._lanes = Lanes(tile)
        self._statuses: deque[msgspec.Raw] = deque(maxlen=_STATUSES)
        self._lanes_trouble = ""
        self._said = ""

    def greet(self, outbox: Outbox) -> None:
        """The last minute, and what is known by now."""
        outbox.tell(
            "hello", encode_text("hello", mode="live", server=SERVER_ID, address=self._address)
        )
        if self._lanes.message:
            outbox.tell("lanes", self._lanes.message)
        outbox.tell("statuses", encode_text("statuses", statuses=list(self._statuses)))
        if self._said:
            outbox.tell("trouble", encode_text("trouble", words=self._said))
        outbox.fill_in(self._minute.newest_first())

    def find(self, wanted: Wanted) -> Iterator[str | bytes]:
        """A live page asks for nothing."""
        del wanted
        return iter(())

    def hear(self, server: ViewServer) -> None:
        """Pass on what has come."""
        for record in self._ear.records():
            if isinstance(record, ServiceStatus):
                self._take_status(record, server)
            else:
                self._take_cycle(record, server)
        self._say(server)

    def _take_cycle(self, forecast: ForecastSet, server: ViewServer) -> None:
        if (lanes := self._lanes.near(forecast)) is not None:
            server.tell("lanes", lanes)
        update = self._watch.update(forecast)
        self._minute.add(forecast.timestamp_s, update)
        server.show(update)

    def _take_status(self, status: ServiceStatus, server: ViewServer) -> None:
        text = encode_status(status, lost_cycles=self._ear.lost_cycles)
        self._statuses.append(msgspec.Raw(text.encode()))
        server.tell("status", text)
        self._lanes_trouble = self._lanes.hear(status) or self._lanes_trouble

    def _say(self, server: ViewServer) -> None:
        """What is wrong now, when it has changed."""
        trouble = "; ".join(filter(None, (self._ear.trouble, self._lanes_trouble)))
        if trouble != self._said:
            self._said = trouble
            server.tell("trouble", encode_text("trouble", words=trouble))


async def follow(live: Live, receiver: socket.socket, server: ViewServer) -> None:
    """Hear until cancelled."""
    loop = asyncio.get_running_loop()
    hear: Callable[[], None] = lambda: live.hear(server)  # noqa: E731
    loop.add_reader(receiver, hear)
    try:
        await asyncio.Event().wait()
    finally:
        loop.remove_reader(receiver)
