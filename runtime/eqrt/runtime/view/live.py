"""A running service: its datagrams, as they come, to every page."""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec

from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.view.hearing import Ear
from eqrt.runtime.view.server import SERVER_ID, Outbox, ViewServer, Wanted
from eqrt.runtime.view.updates import encode_status, encode_text
from eqrt.runtime.view.watch import Lanes, LastMinute, Watch

_STATUSES = 61  # a minute


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
        for place, lanes in enumerate(self._lanes.recent):
            outbox.tell(f"lanes {place}", lanes)
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
        update = self._watch.update(forecast, lanes=self._lanes.number)
        self._minute.add(self._watch.time_s, update)
        server.show(update)

    def _take_status(self, status: ServiceStatus, server: ViewServer) -> None:
        text = encode_status(status, lost_cycles=self._ear.lost_cycles)
        self._statuses.append(msgspec.Raw(text.encode()))
        server.tell("status", text)
        self._lanes_trouble = self._lanes.hear(status)

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
