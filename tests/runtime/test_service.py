"""The service's clock, its loop on a real bus, and what it says every second."""

from __future__ import annotations

import itertools
import math
import re
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import replace

import can
import msgspec
import numpy as np
import pytest

from drives import DRIVES, Car, cycle, first_seconds, shipped_predictor
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.bus.health import BusHealth, BusWord
from eqrt.runtime.bus.links import opener
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.play import OTHERS, Player
from eqrt.runtime.service import MAX_QUEUED_S, ArrivalClock, Service, both_clocks
from eqrt.runtime.status_book import StatusBook, status_line
from forecast_sets import many, nobody, one_car


def never_said(word: BusWord) -> None:
    """Where no channel is lost."""
    pytest.fail(str(word))


CHANNELS = (f"service-{number}-{time.monotonic_ns()}" for number in itertools.count())
WALL_S = 1.7e9  # any wall-clock time
CYCLE_S = 0.073  # of the recorded radar


# --- the clock


def test_a_message_that_did_not_wait_arrived_now() -> None:
    assert ArrivalClock().now_s(50.0, WALL_S, WALL_S) == 50.0


def test_an_empty_queue_means_now() -> None:
    clock = ArrivalClock()
    assert [clock.now_s(t, None, WALL_S + t) for t in (50.0, 50.1)] == [50.0, 50.1]


def test_a_message_that_waited_arrived_that_much_earlier() -> None:
    """Ten messages, 0.1 s apart, are read at once a second after the first came."""
    clock = ArrivalClock()
    told = [clock.now_s(51.0, WALL_S + k / 10, WALL_S + 1.0) for k in range(10)]
    np.testing.assert_allclose(told, 50.0 + np.arange(10) / 10, atol=1e-6)


@pytest.mark.parametrize("set_by_s", [3600.0, -3600.0, 30.0, -5.0])
def test_a_wall_clock_that_is_set_changes_nothing(set_by_s: float) -> None:
    """Between two messages, and between a message's stamp and its being read."""
    clock = ArrivalClock()
    wall_s = WALL_S
    told = [clock.now_s(50.0, wall_s, wall_s)]
    told.append(clock.now_s(50.1, wall_s + 0.1, wall_s + 0.1 + set_by_s))
    wall_s += set_by_s
    told.append(clock.now_s(50.2, wall_s + 0.2, wall_s + 0.2))
    np.testing.assert_allclose(told, [50.0, 50.1, 50.2], atol=1e-6)


@pytest.mark.parametrize("set_by_s", [3600.0, -3600.0, 5.0, -5.0])
def test_messages_that_waited_while_the_wall_clock_was_set_arrived_when_they_did(
    set_by_s: float,
) -> None:
    """Ten of them, 0.1 s apart, are read at once; the clock was set after the fifth had come."""
    clock = ArrivalClock()
    clock.now_s(50.0, None, WALL_S)
    arrived_s = [50.1 + k / 10 for k in range(10)]
    stamps_s = [WALL_S + t - 50.0 + (set_by_s if t > 50.55 else 0.0) for t in arrived_s]
    told = [clock.now_s(51.1, stamp_s, WALL_S + 1.1 + set_by_s) for stamp_s in stamps_s]
    np.testing.assert_allclose(told, arrived_s, atol=1e-6)


def test_a_wall_clock_that_is_set_again_and_again_is_not_remembered_for_ever() -> None:
    """By how it was set last, and shortly before: another second is no reason to look far back."""
    clock = ArrivalClock()
    for k in range(1000):
        clock.now_s(50.0 + k, None, WALL_S + 3600.0 * (-1) ** k)
    waited = clock.now_s(1050.0, WALL_S + 3600.0 - 0.5, WALL_S + 3600.0)
    assert waited == pytest.approx(1049.5, abs=1e-6)


@pytest.mark.parametrize("waited_s", [MAX_QUEUED_S + 1.0, 60.0, 3600.0])
def test_messages_that_waited_very_long_are_as_old_as_they_are(waited_s: float) -> None:
    """While a debugger held the service up, say, or the machine was suspended."""
    clock = ArrivalClock()
    clock.now_s(50.0, None, WALL_S)
    now_s = 50.0 + waited_s
    told = [clock.now_s(now_s, WALL_S + k / 10, WALL_S + waited_s) for k in range(10)]
    np.testing.assert_allclose(told, 50.0 + np.arange(10) / 10, atol=1e-6)


@pytest.mark.parametrize("set_by_s", [3600.0, -3600.0])
def test_messages_that_waited_very_long_while_the_clock_was_set_are_not_new(
    set_by_s: float,
) -> None:
    """How old they are can no longer be known: as old as can be."""
    clock = ArrivalClock()
    clock.now_s(50.0, None, WALL_S)
    told = [clock.now_s(80.0, WALL_S + k, WALL_S + 30.0 + set_by_s) for k in range(3)]
    assert told == [50.0, 50.0, 50.0]
    assert clock.now_s(80.0, None, WALL_S + 30.0 + set_by_s) == 80.0


@pytest.mark.parametrize("stamp_s", [0.0, WALL_S - MAX_QUEUED_S - 1.0, WALL_S + 0.5])
def test_the_first_of_all_messages_has_not_waited(stamp_s: float) -> None:
    assert ArrivalClock().now_s(50.0, stamp_s, WALL_S) == 50.0


def test_the_time_told_never_goes_back() -> None:
    """Whatever the stamps say."""
    clock, random = ArrivalClock(), np.random.default_rng(0)
    monotonic_s = 50.0 + np.cumsum(random.exponential(0.01, 3000))
    stamps = [None if random.random() < 0.1 else WALL_S + random.normal(0, 5) for _ in monotonic_s]
    told = [clock.now_s(m, s, WALL_S) for m, s in zip(monotonic_s.tolist(), stamps, strict=True)]
    assert (np.diff(told) >= 0.0).all()
    assert (np.array(told) <= monotonic_s).all()


# --- the loop


class HeldUp:
    """Two clocks, and a program that loses its processor after these of its looks at one."""

    def __init__(self, after: set[int]) -> None:
        self.now_s, self.looks, self._after = 50.0, 0, after

    def monotonic(self) -> float:
        return self._look()

    def time(self) -> float:
        return 1000.0 + self._look()

    def _look(self) -> float:
        seen_s = self.now_s
        self.now_s += 0.25 if self.looks in self._after else 2.0**-20
        self.looks += 1
        return seen_s


@pytest.mark.parametrize(("after", "looks"), [(set(), 3), ({0}, 6), ({1}, 6), ({0, 3}, 9)])
def test_both_clocks_are_of_one_moment(
    monkeypatch: pytest.MonkeyPatch, after: set[int], looks: int
) -> None:
    clocks = HeldUp(after)
    monkeypatch.setattr("eqrt.runtime.service.time", clocks)
    monotonic_s, wall_s = both_clocks()
    assert wall_s - monotonic_s == 1000.0 + 2.0**-20
    assert clocks.looks == looks


def test_who_is_held_up_at_every_look_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = HeldUp(set(range(1000)))
    monkeypatch.setattr("eqrt.runtime.service.time", clocks)
    both_clocks()
    assert clocks.looks == 9


class Said:
    """A publisher that keeps what it gets."""

    def __init__(self) -> None:
        self.forecasts: list[ForecastSet] = []

    def publish(self, forecast: ForecastSet) -> None:
        self.forecasts.append(forecast)

    def counts(self) -> dict[str, int]:
        return {"said": len(self.forecasts)}


class Queue:
    """What a driver holds for a service that was busy: the recorded radar's messages, stamped as
    they came until now. Then nothing comes any more, until `then_s` have passed.
    """

    def __init__(self, seconds: float, then_s: float = 0.0) -> None:
        lines = first_seconds(DRIVES["ars408"].log, seconds).splitlines()
        self.messages = deque(map(candump_message, lines))
        later_s = time.time() - self.messages[-1].timestamp
        for message in self.messages:
            message.timestamp += later_s
        self._then_s = then_s
        self._end_s = math.inf

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.messages:
            self._end_s = time.monotonic() + self._then_s
            return self.messages.popleft()
        time.sleep(timeout or 0.0)
        return None

    def health(self) -> list[BusHealth]:
        return []

    def counts(self) -> dict[str, int]:
        return {"left": len(self.messages)}

    def is_over(self) -> bool:
        return not self.messages and time.monotonic() >= self._end_s


@pytest.fixture
def radar() -> Pipeline:
    return Pipeline(load_profile("ars408"), shipped_predictor(), clock=time.monotonic)


def test_a_busy_service_does_not_take_a_full_queue_for_silence(radar: Pipeline) -> None:
    """Of what came while it was held up, it predicts every cycle, at the cycle's own time."""
    said, queue = Said(), Queue(3.0)
    Service(radar, queue, [said]).run(queue.is_over)
    assert Mode.SILENT not in {forecast.mode for forecast in said.forecasts}
    assert len(said.forecasts) == radar.decoder.counters.cycles > 35
    spacing_s = np.diff([forecast.timestamp_s for forecast in said.forecasts])
    np.testing.assert_allclose(spacing_s, CYCLE_S, atol=0.02)


def test_silence_is_said_when_the_radar_has_stopped_and_not_before(radar: Pipeline) -> None:
    said, queue = Said(), Queue(1.5, then_s=0.7)
    Service(radar, queue, [said]).run(queue.is_over)
    modes = [forecast.mode for forecast in said.forecasts]
    first_silent = modes.index(Mode.SILENT)
    assert first_silent == radar.decoder.counters.cycles > 15
    assert set(modes[first_silent:]) == {Mode.SILENT}
    silent = said.forecasts[first_silent]
    assert silent.made_s - said.forecasts[first_silent - 1].timestamp_s >= 0.3


def test_the_latency_of_a_cycle_that_lacks_a_message_counts_from_the_last_one_that_came() -> None:
    """The sensor's timeout of 50 ms is a part of it."""
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), clock=time.monotonic)
    statuses: list[ServiceStatus] = []
    queue = Queue(0.1, then_s=1.5)
    cars = [Car(object_id=n, x_m=20.0 + n, y_m=0.0) for n in range(2)]
    queue.messages = deque(cycle(cars, 0.0, start_s=time.time())[:-1])
    Service(pipeline, queue, [Said()], [statuses.append]).run(queue.is_over)
    (latency_s,) = statuses[0].latencies_s
    assert 0.05 < latency_s < 1.0


def test_every_second_there_is_a_line_while_a_bus_is_served(radar: Pipeline) -> None:
    """On the local bus, on which the recorded radar is played."""
    channel = next(CHANNELS)
    statuses: list[ServiceStatus] = []
    lines = first_seconds(DRIVES["ars408"].log, 2.3).splitlines()
    with (
        open_bus(channel, LOCAL) as car,
        Receiver(opener(LOCAL, fd=None), {channel: None}, never_said) as receiver,
    ):
        play = Player({OTHERS: car}).play
        player = threading.Thread(
            target=play, args=(list(map(candump_message, lines)), lambda: False)
        )
        player.start()
        Service(radar, receiver, [Said()], [statuses.append]).run(lambda: not player.is_alive())
        player.join()
    assert len(statuses) == 2
    for status in statuses:
        assert re.fullmatch(
            r"(NO_MAP|LATE)\s+[12] objects +\d+\.\d predictions/s  latency +\d+\.\d ms "
            r"\(worst +\d+\.\d\) +\d+ messages/s",
            status_line(status),
        )
    first, last = statuses
    assert last.time_s - first.time_s == pytest.approx(last.seconds)
    assert last.uptime_s - first.uptime_s == pytest.approx(last.seconds)
    assert (first.profile, first.model, first.tile) == ("ars408", "eqrt-free", "")
    assert first.totals["decoder_messages"] == first.messages
    assert last.totals["decoder_messages"] == first.messages + last.messages
    assert last.totals["said"] == last.totals["pipeline_cycles"] > first.totals["said"] > 0
    assert (last.totals["bus_losses"], last.totals["bus_dropped"]) == (0, 0)
    (bus,) = last.buses
    assert (bus.channel, bus.state, bus.losses, bus.overflow) == (channel, "UP", 0, 0)
    assert 2.0 <= bus.since_s < 60.0
    assert [one.name for one in last.sources] == [
        "ars408",
        "ego SpeedInformation",
        "ego YawRateInformation",
    ]
    assert all(one.valid and not one.reason and one.since_s > 0.0 for one in last.sources)
    assert set(first.stages_s) == {"tracks", "scene", "infer", "guard"}


# --- what is said


def book(pipeline: Pipeline, forecasts: Iterable[ForecastSet]) -> StatusBook:
    """Of a service that has said these, each 12 ms after its last message came."""
    found = StatusBook(pipeline, Queue(0.1), [])
    for forecast in forecasts:
        found.published(replace(forecast, received_s=time.monotonic() - 0.012))
        pipeline.counters.cycles += 1
    return found


def test_the_status_is_one_line(radar: Pipeline) -> None:
    pages = book(radar, [many(32)] * 3)
    for _ in range(900):
        pages.received()
    status = msgspec.structs.replace(pages.close(time.monotonic()), seconds=1.0)
    latencies_s = [0.010, 0.012, 0.030]
    status = msgspec.structs.replace(status, latencies_s=latencies_s)
    assert status_line(status) == (
        "RUN       32 objects   3.0 predictions/s  latency  12.0 ms (worst  30.0)    900 messages/s"
    )
    slower = status_line(msgspec.structs.replace(status, seconds=2.0))
    assert "  1.5 predictions/s" in slower
    assert "    450 messages/s" in slower


def test_latency_counts_from_the_arrival_of_the_last_message(radar: Pipeline) -> None:
    (latency_s,) = book(radar, [one_car()]).close(time.monotonic()).latencies_s
    assert 0.012 <= latency_s < 1.0


def test_the_status_says_since_when_the_mode_holds(radar: Pipeline) -> None:
    """And before the first cycle, that nothing has been said yet."""
    pages = book(radar, [])
    begun_s = time.monotonic()
    status = pages.close(begun_s + 5.0)
    assert (status.mode, status.objects) == (Mode.SILENT, 0)
    assert status.mode_s == pytest.approx(5.0, abs=0.5)
    pages.published(one_car())
    status = pages.close(begun_s + 7.0)
    assert (status.mode, status.objects) == (Mode.NO_MAP, 1)
    assert status.mode_s == pytest.approx(7.0, abs=0.5)
    pages.published(one_car())
    assert pages.close(begun_s + 9.0).mode_s == pytest.approx(9.0, abs=0.5)


def test_the_status_line_says_what_is_missing(radar: Pipeline) -> None:
    pages = book(radar, [])
    for _ in range(120):
        pages.received()
    status = msgspec.structs.replace(pages.close(time.monotonic()), seconds=1.0)
    assert status_line(status) == "no object cycle (120 messages/s)"
    silent = status_line(book(radar, [nobody()]).close(time.monotonic() + 1.0))
    assert silent.startswith("SILENT     0 objects   0.0 predictions/s")
    assert "latency" not in silent
