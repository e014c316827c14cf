"""The service as `eqrt serve` runs it, which keeps a sample of every cycle.

It says when it is ready and when its first prediction is on the bus; then it warms up, measures
for as long as it is told, and ends.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from eqrt.core.errors import BusError
from eqrt.runtime.bench.resources import Watch, resident_mib
from eqrt.runtime.bench.schedule import CLOCK
from eqrt.runtime.bench.service.journal import Journal, NotingPublisher, NotingReceiver
from eqrt.runtime.bench.service.orders import ServiceOrder, read_order, say, while_wanted
from eqrt.runtime.bus.health import BusWord
from eqrt.runtime.bus.links import opener
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.publish_can import CanPublisher
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.service import ArrivalClock, Service

WARM_UP = 30
"""Predictions that are not counted: histories fill up, and lazily made things are made."""


def serve(import_ns: int, bare_mib: float) -> None:
    """Carry out the order of this process."""
    begun_ns = CLOCK()
    order = read_order(ServiceOrder)
    profile, predictor = (
        load_profile(order.profile),
        Predictor.load(Path(order.model), order.threads),
    )
    pipeline = Pipeline(
        profile,
        predictor,
        load_tile(Path(order.tile)) if order.tile else None,
        stationary=order.stationary,
        clock=time.monotonic,
    )
    bus = order.bus
    with (
        Receiver(opener(bus.interface, fd=bus.fd), {bus.channel: profile.ids}, _lost) as receiver,
        while_wanted() as should_stop,
    ):
        ready_ns = CLOCK()
        say("ready", import_ns=import_ns, load_ns=ready_ns - begun_ns, bare_mib=bare_mib)
        run = _Run(order, pipeline, ready_ns)
        run.serve(receiver, predictor.contract.dt_s, should_stop)
        run.tell()


def _lost(word: BusWord) -> None:
    """A channel that comes and goes makes no figures."""
    raise BusError(str(word))


class AnsweredClock:
    """A service's clock for traffic that waits for every answer: with each, a step has passed.

    So histories are as long and as dense as at the model's rate, however fast the answers come.
    """

    def __init__(self, journal: Journal, dt_s: float) -> None:
        self._journal = journal
        self._dt_s = dt_s
        self._started_s = time.monotonic()

    def now_s(self, _monotonic_s: float, _stamp_s: float | None, _wall_s: float) -> float:
        """As ArrivalClock's."""
        return self._started_s + self._journal.answers * self._dt_s


class _Run:
    """One service, from its first prediction to its last."""

    def __init__(self, order: ServiceOrder, pipeline: Pipeline, ready_ns: int) -> None:
        self._order = order
        self._pipeline = pipeline
        self._journal = Journal(pipeline, order.expected, self._answered)
        self._ready_ns = ready_ns
        self._watch: Watch | None = None
        self._started_ns = self._end_ns = 0

    def serve(self, receiver: Receiver, dt_s: float, should_stop: Callable[[], bool]) -> None:
        """Between two hooks; ends when told to, or when everything has been measured."""
        journal, outbox = self._journal, receiver.connection(self._order.bus.channel).outbox
        service = Service(
            self._pipeline,
            NotingReceiver(receiver, journal),
            [NotingPublisher(CanPublisher(outbox), journal)],
            clock=AnsweredClock(journal, dt_s) if self._order.answered_clock else ArrivalClock(),
        )
        gc.collect()
        gc.freeze()
        service.run(lambda: should_stop() or (self._end_ns > 0 and CLOCK() >= self._end_ns))

    def _answered(self) -> None:
        if self._watch is not None:
            self._watch.look()
        elif self._journal.answers == 1:
            say("first", first_ns=CLOCK() - self._ready_ns, rss_mib=resident_mib())
        elif self._journal.answers == WARM_UP:
            self._watch = Watch(self._order.cores)
            self._journal.keep()
            say("measuring")
            self._started_ns = CLOCK()
            self._end_ns = self._started_ns + round(1e9 * self._order.seconds)

    def tell(self) -> None:
        """Write the rows, say the rest."""
        if self._watch is None:
            return
        seconds = (CLOCK() - self._started_ns) / 1e9
        resources = self._watch.finish()
        np.save(self._order.rows, self._journal.rows())
        decoded, counters = self._pipeline.decoder.counters, self._pipeline.counters
        say(
            "measured",
            seconds=seconds,
            resources=asdict(resources),
            fallbacks=counters.fallbacks,
            targets=counters.targets / max(self._journal.answers, 1),
            incomplete=decoded.incomplete_cycles,
        )
