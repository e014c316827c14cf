"""Several channels read as one, by one thread, for as long as the service lives."""

from __future__ import annotations

import heapq
import math
import selectors
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from operator import attrgetter

import can

from eqrt.runtime.bus.connection import Connection
from eqrt.runtime.bus.health import BusHealth, BusState, BusWord
from eqrt.runtime.bus.ids import Ids
from eqrt.runtime.bus.kernel_queue import BATCH
from eqrt.runtime.bus.links import OpenLink

_MOST_AT_ONCE = 50_000  # messages; more than the queues of several channels hold


class Receiver:
    """Reads every channel; one that is lost is opened again while the others go on."""

    def __init__(
        self,
        open_link: OpenLink,
        channels: Mapping[str, Ids | None],
        say: Callable[[BusWord], None],
        *,
        wait: bool = False,
    ) -> None:
        """`say` is told when a channel is lost and when it is back.

        `wait`: a channel that is not there yet is waited for. Else it raises AbsentBusError; what
        time cannot mend is a BusError in any case.
        """
        self._selector = selectors.DefaultSelector()
        self._pending: deque[can.Message] = deque()
        self._connections = {
            channel: Connection(channel, partial(open_link, channel, ids), self._selector, say)
            for channel, ids in channels.items()
        }
        try:
            for connection in self._connections.values():
                connection.open(wait=wait)
        except BaseException:
            self.shutdown()
            raise

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message of any channel, or None after `timeout` seconds. Never raises."""
        if not self._pending:
            self._wait(math.inf if timeout is None else timeout)
        return self._pending.popleft() if self._pending else None

    def _wait(self, timeout_s: float) -> None:
        """Until there are messages, or that many seconds have passed."""
        now_s = time.monotonic()
        end_s = now_s + timeout_s
        while True:
            again_s = min(one.try_again(now_s) for one in self._connections.values())
            self._read(max(0.0, min(end_s - now_s, again_s)))
            now_s = time.monotonic()
            if self._pending or now_s >= end_s:
                return

    def _read(self, wait_s: float) -> None:
        """What each channel has, after waiting for the first."""
        ready = self._selector.select(None if wait_s == math.inf else wait_s)
        heard: dict[str, list[can.Message]] = {channel: [] for channel in self._connections}
        total = 0
        while ready:
            batches = [(key.data.channel, key.data.read()) for key, _ in ready]
            for channel, batch in batches:
                heard[channel] += batch
            count = sum(len(batch) for _, batch in batches)
            total += count
            # A batch of a busy channel reaches less far than one of a quiet channel: both are read
            # to their ends, but for the few messages that came meanwhile.
            if len(self._connections) == 1 or count < BATCH or total > _MOST_AT_ONCE:
                break
            ready = self._selector.select(0.0)
        # Channels that were read one after the other spoke at the same time. Merged, not sorted:
        # where the wall clock was set back meanwhile, each channel keeps its own order.
        self._pending.extend(heapq.merge(*heard.values(), key=attrgetter("timestamp")))

    def connection(self, channel: str) -> Connection:
        """What sends on a channel, whether or not it is there at the moment."""
        return self._connections[channel]

    def health(self) -> list[BusHealth]:
        """How every channel is now, in the order in which they were given."""
        return [connection.health() for connection in self._connections.values()]

    def counts(self) -> dict[str, int]:
        """Of all channels together, by name; `bus_not_up` is how many are not, now."""
        health = self.health()
        return {
            "bus_not_up": sum(one.state is not BusState.UP for one in health),
            "bus_losses": sum(one.losses for one in health),
            "bus_reconnects": sum(one.reconnects for one in health),
            "bus_offs": sum(one.bus_offs for one in health),
            "bus_error_frames": sum(one.error_frames for one in health),
            "bus_dropped": sum(one.dropped or 0 for one in health),
            "bus_overruns": sum(one.overruns for one in health),
        }

    def shutdown(self) -> None:
        """Close every channel."""
        for connection in self._connections.values():
            connection.shutdown()
        self._selector.close()

    def __enter__(self) -> Receiver:
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
