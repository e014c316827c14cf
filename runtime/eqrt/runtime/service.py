"""The loop of `eqrt serve`: receive, predict, publish; once a second, say how it goes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import can
import numpy as np

from eqrt.core.errors import BusError
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline

_NAP_S = 0.01  # the longest wait for a message: unfinished cycles are closed that promptly
_REPORT_S = 1.0
MAX_QUEUED_S = 10.0  # a longer wait is not a queue, but a wall clock that was set


class Receiver(Protocol):
    """Where messages come from: a python-can bus, or a reader over several."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message, or None after `timeout` seconds."""


class Clock(Protocol):
    """The pipeline's time while serving."""

    def now_s(self, monotonic_s: float, stamp_s: float | None, wall_s: float) -> float:
        """When the message stamped `stamp_s` arrived; None = no message came, and it is now."""


class Publisher(Protocol):
    """Where predictions go."""

    def publish(self, forecast: ForecastSet) -> None:
        """Send one cycle's predictions; never raises on a full or closed destination."""


@dataclass(slots=True)
class Report:
    """What happened since the last report."""

    messages: int = 0
    latencies_s: list[float] = field(default_factory=list)
    """From the arrival of a cycle's last message to its predictions having been sent."""
    newest: ForecastSet | None = None

    def line(self, seconds: float) -> str:
        """One line for the terminal."""
        if self.newest is None:
            return f"no object cycle ({self.messages / seconds:.0f} messages/s)"
        mode, count = self.newest.mode.name, self.newest.num_targets
        text = f"{mode:<8} {count:3d} objects {len(self.latencies_s) / seconds:5.1f} predictions/s"
        if self.latencies_s:
            middle, worst = 1e3 * np.median(self.latencies_s), 1e3 * max(self.latencies_s)
            text += f"  latency {middle:5.1f} ms (worst {worst:5.1f})"
        return f"{text}  {self.messages / seconds:5.0f} messages/s"


class Service:
    """One pipeline between a receiver and its publishers."""

    def __init__(
        self,
        pipeline: Pipeline,
        receiver: Receiver,
        publishers: list[Publisher],
        report: Callable[[str], None],
        clock: Clock | None = None,
    ) -> None:
        """`clock`: None = when messages arrive."""
        self._pipeline = pipeline
        self._receiver = receiver
        self._publishers = publishers
        self._report = report
        self._clock = clock or ArrivalClock()
        self._second = Report()

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Serve until told to stop. Raises BusError if the bus goes away."""
        report_due_s = time.monotonic() + _REPORT_S
        while not should_stop():
            message = self._receive()
            stamp_s = None if message is None else message.timestamp
            now_s = self._clock.now_s(time.monotonic(), stamp_s, time.time())
            self._publish(self._pipeline.poll(now_s), now_s)
            if message is not None:
                self._second.messages += 1
                self._publish(self._pipeline.feed(message, now_s), now_s)
            if (monotonic_s := time.monotonic()) >= report_due_s:
                report_due_s = self._say(monotonic_s, report_due_s)

    def _receive(self) -> can.Message | None:
        try:
            return self._receiver.recv(_NAP_S)
        except (can.CanError, OSError) as error:
            raise BusError(
                f"the CAN channel can no longer be read ({error}); when it is back, start again"
            ) from error

    def _publish(self, forecasts: list[ForecastSet], arrived_s: float) -> None:
        for forecast in forecasts:
            for publisher in self._publishers:
                publisher.publish(forecast)
            self._second.newest = forecast
            if forecast.num_targets:
                self._second.latencies_s.append(time.monotonic() - arrived_s)

    def _say(self, now_s: float, due_s: float) -> float:
        """Report the second that has passed; returns when the next one ends."""
        self._report(self._second.line(_REPORT_S + now_s - due_s))
        self._second = Report()
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
