"""One service is heard at a time, whoever else sends there. Real sockets, a clock by hand."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace

import pytest

from crowd import crowd
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.view.hearing import SILENT_S, Ear, listen

Say = Callable[[ForecastSet], None]


class Hearer:
    """An ear on a free port, and services that send to it."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self.receiver = stack.enter_context(listen("127.0.0.1:0"))
        self.now_s = 100.0
        self.ear = Ear(self.receiver, lambda: self.now_s)

    def service(self) -> Say:
        port = self.receiver.getsockname()[1]
        return self._stack.enter_context(DatagramPublisher([f"127.0.0.1:{port}"])).publish

    def heard(self) -> list[str]:
        """The models of the cycles that have come."""
        found = list(self.ear.records())
        assert all(isinstance(record, ForecastSet) for record in found)
        return [record.model_id for record in found if isinstance(record, ForecastSet)]


@pytest.fixture
def hearer() -> Iterator[Hearer]:
    with ExitStack() as stack:
        yield Hearer(stack)


def cycle(number: int, model: str, agents: int = 3) -> ForecastSet:
    return replace(crowd(number, agents), model_id=model)


def test_a_second_service_is_left_out_and_said(hearer: Hearer) -> None:
    first, second = hearer.service(), hearer.service()
    for number in range(20):
        hearer.now_s += 0.1
        first(cycle(number, "first"))
        second(cycle(700 + number, "second", agents=200))  # in several datagrams
        assert hearer.heard() == ["first"]
    assert "a second service (127.0.0.1:" in hearer.ear.trouble
    assert "--datagrams" in hearer.ear.trouble
    assert len(hearer.ear.refused) == 1
    assert hearer.ear.lost_cycles == 0
    hearer.now_s += SILENT_S
    assert hearer.ear.trouble == ""


def test_a_service_that_starts_again_is_heard_when_the_one_before_is_silent(hearer: Hearer) -> None:
    before = hearer.service()
    before(cycle(500, "before"))
    assert hearer.heard() == ["before"]
    after = hearer.service()
    heard = []
    for number in range(30):
        hearer.now_s += 0.125
        after(cycle(900 + number, "after"))
        heard += hearer.heard()
        assert hearer.ear.trouble == ""  # there is but one
    assert heard == ["after"] * 19  # all but those of less than SILENT_S
    assert hearer.ear.lost_cycles == 0
    assert not hearer.ear.refused


def test_strangers_that_make_no_sense_are_no_service(hearer: Hearer) -> None:
    service = hearer.service()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for number in range(3):
            service(cycle(number, "service"))
            stranger.sendto(b"\x00garbage", hearer.receiver.getsockname())
            hearer.now_s += 0.1
            assert hearer.heard() == ["service"]
            assert hearer.ear.trouble
    service(cycle(3, "service"))
    assert hearer.heard() == ["service"]
    assert hearer.ear.trouble == ""
