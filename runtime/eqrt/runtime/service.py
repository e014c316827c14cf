"""The loop of `eqrt serve`: receive, predict, publish; once a second, say how it goes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import can

from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.status_book import Channels, StatusBook

_NAP_S = 0.01  # the longest wait for a message: unfinished cycles are closed that promptly
_REPORT_S = 1.0
MAX_QUEUED_S = 10.0
"""A message hardly waits longer: what seems to have was perhaps stamped before the wall clock was
set."""
_SET_S = 0.05  # a wall clock that moves by more was set; NTP slews by less than 1 ms a second
_ROUNDED_S = 1e-3  # by which a stamp may lie ahead of now, because it has a coarser clock
_TOGETHER_S = 1e-3  # two looks at a clock take some 0.1 us, where each is a system call 60 us
_LOOKS = 3  # who is held up each time must go on nevertheless
_MOST_WALLS = 8  # more than anybody sets it within MAX_QUEUED_S; bounds the work of each message


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
            message, now_s = self._receive()
            if self._witness:
                self._witness.begin(message, now_s)
            self._publish(self._pipeline.poll(now_s))
            if message is not None:
                self._book.received()
                self._publish(self._pipeline.feed(message, now_s))
            if self._witness:
                self._witness.end()
            if (monotonic_s := time.monotonic()) >= report_due_s:
                report_due_s = self._report(monotonic_s, report_due_s)
            for chore in self._chores:
                chore()

    def _receive(self) -> tuple[can.Message | None, float]:
        """The next message and when it arrived; None and a time by which all have been received.

        Whoever is held up while waiting is told that the time is over, and nothing of what came
        meanwhile. That the queue is empty is only true of a time before it was looked at.
        """
        message = self._receiver.recv(_NAP_S)
        if message is None:
            monotonic_s, wall_s = both_clocks()
            message = self._receiver.recv(0.0)
            if message is None:
                return None, self._clock.now_s(monotonic_s, None, wall_s)
        monotonic_s, wall_s = both_clocks()
        return message, self._clock.now_s(monotonic_s, message.timestamp, wall_s)

    def _publish(self, forecasts: list[ForecastSet]) -> None:
        for forecast in forecasts:
            for publisher in self._publishers:
                publisher.publish(forecast)
            self._book.published(forecast)

    def _report(self, now_s: float, due_s: float) -> float:
        """Say how the second was that has passed; returns when the next one ends."""
        status = self._book.close(now_s)
        for observe in self._observers:
            observe(status)
        return max(due_s + _REPORT_S, now_s)


def both_clocks() -> tuple[float, float]:
    """The monotonic clock and the wall clock, seconds, at one moment.

    A program that loses its processor between two looks looks again: else the one would seem to
    have been set against the other, and what arrived to be older by as much.
    """
    for _ in range(_LOOKS):
        monotonic_s, wall_s = time.monotonic(), time.time()
        if time.monotonic() - monotonic_s < _TOGETHER_S:
            break
    return monotonic_s, wall_s


class ArrivalClock:
    """The pipeline's time while serving: when things arrived, on the monotonic clock.

    Messages wait in the driver's queue while the service is busy. Their stamps (wall clock) tell
    how long, and the pipeline's time follows them, so that a queue full of messages does not look
    like a bus that has fallen silent. Where the wall clock was set meanwhile, those that were
    stamped before are read by the clock as it was then. Who was held up for longer than is
    remembered of it takes messages for old rather than for new. The time told never goes back.
    """

    def __init__(self) -> None:
        self._told_s = -math.inf
        self._walls: list[_WallClock] = []
        """Those that a message which still waits may be stamped by, the present one first."""

    def now_s(self, monotonic_s: float, stamp_s: float | None, wall_s: float) -> float:
        """When the message stamped `stamp_s` arrived; None = the queue is empty, and it is now."""
        self._look(wall_s - monotonic_s, monotonic_s)
        arrived_s = monotonic_s if stamp_s is None else self._arrival(stamp_s, monotonic_s)
        self._told_s = max(self._told_s, arrived_s)
        return self._told_s

    def _look(self, ahead_s: float, monotonic_s: float) -> None:
        """Notice that the wall clock was set; one that runs a little fast or slow was not."""
        walls = self._walls
        if walls and abs(walls[0].ahead_s - ahead_s) < _SET_S:
            walls[0].ahead_s, walls[0].seen_s = ahead_s, monotonic_s
        else:
            walls.insert(0, _WallClock(ahead_s, monotonic_s))
            del walls[_MOST_WALLS:]
        while monotonic_s - walls[-1].seen_s > MAX_QUEUED_S:
            walls.pop()

    def _arrival(self, stamp_s: float, monotonic_s: float) -> float:
        """The stamp on the monotonic clock, by the newest wall clock that makes sense of it.

        Messages come in the order of their arrival: a clock by which one would have come before
        what was told already is not the one that stamped it.
        """
        possible_s = [
            min(arrived_s, monotonic_s)
            for wall in self._walls
            if -_ROUNDED_S <= monotonic_s - (arrived_s := stamp_s - wall.ahead_s) <= MAX_QUEUED_S
        ]
        if possible_s:
            in_order_s = (arrived_s for arrived_s in possible_s if arrived_s >= self._told_s)
            return next(in_order_s, possible_s[0])
        if self._told_s == -math.inf:
            return monotonic_s  # the first of all: it has not waited
        arrived_s = stamp_s - self._walls[0].ahead_s
        return arrived_s if arrived_s < monotonic_s else self._told_s


@dataclass(slots=True)
class _WallClock:
    """The wall clock as it was set for some time."""

    ahead_s: float
    """Of the monotonic clock."""
    seen_s: float
    """When it was last so, on the monotonic clock."""
