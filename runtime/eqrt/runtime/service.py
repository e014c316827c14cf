"""The loop of `eqrt serve`: receive, predict, publish; once a second, say how it goes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import can

from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.status_book import Channels, StatusBook

_NAP_S = 0.01  # the longest wait for a message: unfinished cycles are closed that promptly
_REPORT_S = 1.0
MAX_QUEUED_S = 10.0  # a longer wait is not a queue, but a wall clock that was set


class Receiver(Channels, Protocol):
    """Where messages come from: channels that may be lost and come back, while it goes on."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message, or None after `timeout` seconds; never raises."""


class Clock(Protocol):
    """The pipeline's time while serving."""

    def now_s(self, monotonic_s: float, stamp_s: float | None, wall_s: float) -> float:
        """When the message stamped `stamp_s` arrived; None = no message came, and it is now."""


class Publisher(Protocol):
    """Where predictions go."""

    def publish(self, forecast: ForecastSet) -> None:
        """Send one cycle's predictions; never raises on a full or closed destination."""

    def counts(self) -> dict[str, int]:
        """Since the start, by name."""


Observer = Callable[[ServiceStatus], None]
"""Hears once a second how the service is."""

Chore = Callable[[], None]
"""Is done between two messages, when whatever they completed has been sent: must be quick."""


class Witness(Protocol):
    """Sees all that the pipeline is told, so that it can be told the same again."""

    def begin(self, message: can.Message | None, now_s: float) -> None:
        """The pipeline is about to be told this: `poll(now_s)`, then `feed`, if there is a
        message.
        """

    def end(self) -> None:
        """It has been, and what came of it is published."""


class Service:
    """One pipeline between a receiver and its publishers."""

    def __init__(
        self,
        pipeline: Pipeline,
        receiver: Receiver,
        publishers: Sequence[Publisher],
        observers: Sequence[Observer] = (),
        *,
        clock: Clock | None = None,
        chores: Sequence[Chore] = (),
        witness: Witness | None = None,
    ) -> None:
        """`clock`: None = when messages arrive."""
        self._pipeline = pipeline
        self._receiver = receiver
        self._publishers = publishers
        self._observers = observers
        self._clock = clock or ArrivalClock()
        self._chores = chores
        self._witness = witness
        self._book = StatusBook(pipeline, receiver, publishers)

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Serve until told to stop."""
        report_due_s = time.monotonic() + _REPORT_S
        while not should_stop():
            message = self._receiver.recv(_NAP_S)
            stamp_s = None if message is None else message.timestamp
            now_s = self._clock.now_s(time.monotonic(), stamp_s, time.time())
            if self._witness:
                self._witness.begin(message, now_s)
            self._publish(self._pipeline.poll(now_s), now_s)
            if message is not None:
                self._book.received()
                self._publish(self._pipeline.feed(message, now_s), now_s)
            if self._witness:
                self._witness.end()
            if (monotonic_s := time.monotonic()) >= report_due_s:
                report_due_s = self._report(monotonic_s, report_due_s)
            for chore in self._chores:
                chore()

    def _publish(self, forecasts: list[ForecastSet], arrived_s: float) -> None:
        for forecast in forecasts:
            for publisher in self._publishers:
                publisher.publish(forecast)
            self._book.published(forecast, arrived_s)

    def _report(self, now_s: float, due_s: float) -> float:
        """Say how the second was that has passed; returns when the next one ends."""
        status = self._book.close(now_s)
        for observe in self._observers:
            observe(status)
        return max(due_s + _REPORT_S, now_s)


class ArrivalClock:
    """The pipeline's time while serving: when things arrived, on the monotonic clock.

    Messages wait in the driver's queue while the service is busy. Their stamps (wall clock) tell
    how long, and the pipeline's time follows them, so that a queue full of messages does not look
    like a bus that has fallen silent. A stamp that is not from the last seconds says that the wall
    clock was set, and nothing else. The time told never goes back.
    """

    def __init__(self) -> None:
        self._told_s = -math.inf

    def now_s(self, monotonic_s: float, stamp_s: float | None, wall_s: float) -> float:
        """When the message stamped `stamp_s` arrived; None = the queue is empty, and it is now."""
        waited_s = 0.0 if stamp_s is None else wall_s - stamp_s
        if not 0.0 <= waited_s <= MAX_QUEUED_S:
            waited_s = 0.0
        self._told_s = max(self._told_s, monotonic_s - waited_s)
        return self._told_s
