"""Hooks at the rims of a service that keep when each prediction passed them.

The service and its pipeline are those of the car, unchanged: a receiver that notes when a message
was there, a publisher that notes when the predictions were on the bus, and between the two the
times that the pipeline tells anyway (`Pipeline.times`, `ForecastSet.compute_s`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import can

from eqrt.runtime.bench.measure import Samples
from eqrt.runtime.bench.percentiles import Int64
from eqrt.runtime.bench.resources import cpu_ns
from eqrt.runtime.bench.schedule import CLOCK
from eqrt.runtime.bus.health import BusHealth
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.service import MAX_QUEUED_S, Publisher, Receiver

STAGES = ("wake-up", "decode", "tracks", "scene", "infer", "guard", "publish", "rest")
"""What the time from the last message of a cycle to its last prediction on the bus is made of."""
WIDTH = 4 + len(STAGES) + 1
"""Columns of a row: number, when the last message came and when the service had it (ns), 1; the
stages; CPU time since the row before."""


class Journal:
    """A row for every cycle that is predicted."""

    def __init__(self, pipeline: Pipeline, expected: int, answered: Callable[[], None]) -> None:
        """`expected`: about how many rows to keep. `answered` is called after every prediction."""
        self.answers = 0
        """Cycles predicted so far, whether they are kept or not."""
        self._samples = Samples(WIDTH, expected)
        self._keeping = False
        self._pipeline = pipeline
        self._answered = answered
        self._waited_ns = self._had_ns = 0
        self._cpu_ns = cpu_ns()

    def keep(self) -> None:
        """From the next prediction on."""
        self._keeping = True
        self._cpu_ns = cpu_ns()

    def rows(self) -> Int64:
        """(n, WIDTH)"""
        return self._samples.rows()

    def had(self, message: can.Message) -> None:
        """The service has this message now."""
        self._had_ns = CLOCK()
        waited_ns = time.time_ns() - round(1e9 * message.timestamp)
        is_wall_clock = abs(waited_ns) <= 1e9 * MAX_QUEUED_S
        self._waited_ns = waited_ns if is_wall_clock else 0

    def published(self, forecast: ForecastSet, begun_ns: int) -> None:
        """Its predictions are on the bus; publishing them began at `begun_ns`."""
        ended_ns = CLOCK()
        if not forecast.num_targets:
            return
        self.answers += 1
        if self._keeping:
            self._samples.append(self._row(forecast, begun_ns, ended_ns))
        self._answered()

    def _row(self, forecast: ForecastSet, begun_ns: int, ended_ns: int) -> Sequence[int]:
        """The pipeline's clock is `time.monotonic`, on Linux the same as CLOCK."""
        times = self._pipeline.times
        started_ns = round(1e9 * (forecast.made_s - forecast.compute_s))
        inside = [times.tracks_s, times.scene_s, times.infer_s, times.guard_s]
        stages = [started_ns - self._had_ns, *(round(1e9 * spent_s) for spent_s in inside)]
        stages.append(ended_ns - begun_ns)
        rest_ns = ended_ns - self._had_ns - sum(stages)
        before_ns, self._cpu_ns = self._cpu_ns, cpu_ns()
        came_ns = self._had_ns - self._waited_ns
        turn = [self.answers, came_ns, self._had_ns, 1]
        return [*turn, self._waited_ns, *stages, rest_ns, self._cpu_ns - before_ns]


class NotingReceiver:
    """A receiver whose messages are noted."""

    def __init__(self, receiver: Receiver, journal: Journal) -> None:
        self._receiver = receiver
        self._journal = journal

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """As the receiver's own."""
        message = self._receiver.recv(timeout)
        if message is not None:
            self._journal.had(message)
        return message

    def health(self) -> Sequence[BusHealth]:
        """As the receiver's own."""
        return self._receiver.health()

    def counts(self) -> dict[str, int]:
        """As the receiver's own."""
        return self._receiver.counts()


class NotingPublisher:
    """A publisher whose predictions are noted."""

    def __init__(self, publisher: Publisher, journal: Journal) -> None:
        self._publisher = publisher
        self._journal = journal

    def publish(self, forecast: ForecastSet) -> None:
        """As the publisher's own."""
        begun_ns = CLOCK()
        self._publisher.publish(forecast)
        self._journal.published(forecast, begun_ns)

    def counts(self) -> dict[str, int]:
        """As the publisher's own."""
        return self._publisher.counts()
