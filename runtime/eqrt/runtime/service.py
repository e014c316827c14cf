"""The loop of `eqrt serve`: receive, predict, publish; once a second, say how it goes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import can
import numpy as np

from eqrt.runtime.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline

_NAP_S = 0.01  # the longest wait for a message: unfinished cycles are closed that promptly
_REPORT_S = 1.0
_MAX_QUEUED_S = 1.0  # a kernel stamp older than this was made before the wall clock was set


class Receiver(Protocol):
    """Where messages come from: a python-can bus, or a reader over several."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message, or None after `timeout` seconds."""


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
    ) -> None:
        self._pipeline = pipeline
        self._receiver = receiver
        self._publishers = publishers
        self._report = report
        self._second = Report()
        self.messages = 0
        """Received so far."""

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Serve until told to stop."""
        report_due_s = time.monotonic() + _REPORT_S
        while not should_stop():
            message = self._receiver.recv(_NAP_S)
            now_s = time.monotonic()
            if message is not None:
                self._second.messages += 1
                arrived_s = arrival_s(message.timestamp, now_s, time.time())
                self._publish(self._pipeline.feed(message, arrived_s), arrived_s)
            self._publish(self._pipeline.poll(now_s), now_s)
            if now_s >= report_due_s:
                report_due_s = self._say(now_s, report_due_s)

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
        self.messages += self._second.messages
        self._second = Report()
        return max(due_s + _REPORT_S, now_s)


def arrival_s(stamp_s: float, now_s: float, wall_s: float) -> float:
    """When a message arrived, on the monotonic clock.

    The driver's stamp (wall clock, `stamp_s`) tells how long the message has been waiting in the
    queue. A stamp from the future or from long ago tells that the wall clock was set, and nothing
    else: then the message arrived now.
    """
    waited_s = wall_s - stamp_s
    return now_s - waited_s if 0.0 <= waited_s <= _MAX_QUEUED_S else now_s
