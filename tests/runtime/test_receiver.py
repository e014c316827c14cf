"""Several channels read as one, lost and found again. SocketCAN's own: tests/socketcan."""

from __future__ import annotations

import itertools
import signal
import socket
import threading
import time
from collections.abc import Callable

import can
import numpy as np
import pytest

from eqrt.core.errors import AbsentBusError, BusError
from eqrt.runtime.bus.adapter import _MOST_HEARD, Adapter
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.connection import FIRST_RETRY_S, LONGEST_RETRY_S
from eqrt.runtime.bus.health import BusHealth, BusState, BusWord, in_sum, trouble
from eqrt.runtime.bus.ids import Ids
from eqrt.runtime.bus.kernel_queue import BATCH, RECEIVE_BYTES, enlarge
from eqrt.runtime.bus.links import Link, open_link, opener
from eqrt.runtime.bus.local_bus import LocalBus
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.output.publish_can import CanPublisher
from forecast_sets import many


def never_said(word: BusWord) -> None:
    """Where no channel is lost."""
    pytest.fail(str(word))


CHANNELS = (f"receiver-{number}-{time.monotonic_ns()}" for number in itertools.count())
PATIENCE_S = 20.0
each_interface = pytest.mark.parametrize("interface", [LOCAL, "virtual"])


def number(value: int) -> can.Message:
    return can.Message(
        arbitration_id=value & 0x7FF, is_extended_id=False, data=bytes([value >> 11])
    )


def value_of(message: can.Message) -> int:
    return message.arbitration_id | message.data[0] << 11


def until(receiver: Receiver, is_so: Callable[[], bool]) -> list[can.Message]:
    """What is heard until something is so."""
    give_up_s, heard = time.monotonic() + PATIENCE_S, []
    while not is_so():
        assert time.monotonic() < give_up_s
        if (message := receiver.recv(0.01)) is not None:
            heard.append(message)
    return heard


def wait_for_stamps(receiver: Receiver, sender: can.BusABC) -> None:
    """Until the kernel notes when messages come.

    Linux begins a moment after it was first asked to; till then the time of reading counts.
    """
    held_s, give_up_s = 0.0, time.monotonic() + PATIENCE_S
    while held_s < 0.002:
        assert time.monotonic() < give_up_s
        sender.send(number(0))
        time.sleep(0.004)
        message = receiver.recv(5.0)
        assert message is not None
        held_s = time.time() - message.timestamp


# --- reading


@each_interface
def test_messages_of_several_channels_come_with_their_names(interface: str) -> None:
    names = [next(CHANNELS), next(CHANNELS)]
    senders = {name: open_bus(name, interface) for name in names}
    wanted: dict[str, Ids | None] = dict.fromkeys(names)
    with Receiver(opener(interface, fd=None), wanted, never_said) as receiver:
        for i, name in enumerate(names * 2):
            senders[name].send(number(i))
        heard = [receiver.recv(5.0) for _ in range(4)]
        assert receiver.recv(0.01) is None
    found = {(message.arbitration_id, message.channel) for message in heard if message}
    assert found == {(0, names[0]), (1, names[1]), (2, names[0]), (3, names[1])}
    for bus in senders.values():
        bus.shutdown()


def test_channels_read_in_one_go_come_in_the_order_of_their_times() -> None:
    """Both spoke while nobody read."""
    names = [next(CHANNELS), next(CHANNELS)]
    senders = [open_bus(name, LOCAL) for name in names]
    wanted: dict[str, Ids | None] = dict.fromkeys(names)
    with Receiver(opener(LOCAL, fd=None), wanted, never_said) as receiver:
        wait_for_stamps(receiver, senders[0])
        for i in range(20):
            senders[i % 2].send(number(i))
        time.sleep(0.02)  # what was sent has come to both
        heard = [receiver.recv(5.0) for _ in range(20)]
    assert [message.arbitration_id for message in heard if message] == list(range(20))
    for bus in senders:
        bus.shutdown()


def test_a_busy_channel_beside_a_quiet_one_comes_in_the_order_of_their_times() -> None:
    """A batch of the quiet one spans ten of the busy one."""
    names, count = [next(CHANNELS), next(CHANNELS)], 10 * BATCH
    senders = [open_bus(name, LOCAL) for name in names]
    wanted: dict[str, Ids | None] = dict.fromkeys(names)
    with Receiver(opener(LOCAL, fd=None), wanted, never_said) as receiver:
        wait_for_stamps(receiver, senders[0])
        for i in range(count):
            senders[i % 10 == 0].send(number(i))
        time.sleep(0.02)  # what was sent has come to both
        heard = [receiver.recv(5.0) for _ in range(count)]
        assert receiver.recv(0.0) is None
    assert [value_of(message) for message in heard if message] == list(range(count))
    for bus in senders:
        bus.shutdown()


def test_more_than_a_batch_comes_in_order_and_complete() -> None:
    channel, count = next(CHANNELS), 4 * BATCH + 5
    with (
        open_bus(channel, LOCAL) as sender,
        Receiver(opener(LOCAL, fd=None), {channel: None}, never_said) as receiver,
    ):
        before_s = time.time()
        for i in range(count):
            sender.send(number(i))
        heard = [receiver.recv(5.0) for _ in range(count)]
        assert receiver.recv(0.0) is None
    assert [value_of(message) for message in heard if message] == list(range(count))
    times = [message.timestamp for message in heard if message]
    assert times == sorted(times)
    assert before_s - 0.001 <= times[0] <= times[-1] <= time.time()


def test_of_the_local_bus_only_wanted_messages_come_and_no_own_ones() -> None:
    """By id and its length; neither strange datagrams nor CAN FD on a classic channel."""
    channel = next(CHANNELS)
    ids: Ids = [(0x123, False), (0x18FF1234, True)]
    offered = [
        can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01"),
        can.Message(arbitration_id=0x123, is_extended_id=True, data=b"\x02"),
        can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, data=bytes(64)),
        can.Message(arbitration_id=0x18FF1234, data=b"\x03"),
        can.Message(arbitration_id=0x234, is_extended_id=False, data=b"\x04"),
    ]
    with (
        open_bus(channel, LOCAL) as sender,
        Receiver(opener(LOCAL, fd=False), {channel: ids}, never_said) as some,
        Receiver(opener(LOCAL, fd=True), {channel: None}, never_said) as every,
    ):
        assert isinstance(sender, LocalBus)
        for payload in (b"", b"short", sender._digest, sender._digest + b"1234567", bytes(200)):
            sender._sender.sendto(payload, sender._destination)
        for message in offered:
            sender.send(message)
        some.connection(channel).send(offered[0])
        wanted = list(iter(lambda: some.recv(0.05), None))
        heard = list(iter(lambda: every.recv(0.05), None))
    assert [message.data for message in wanted] == [b"\x01", b"\x03"]
    assert len(heard) == len(offered) + 1
    for message, sent in zip(heard, [*offered, offered[0]], strict=True):
        assert message.equals(sent, timestamp_delta=None, check_channel=False)


@each_interface
def test_a_signal_does_not_make_the_wait_for_messages_endless(interface: str) -> None:
    """Timers fire while it waits; whenever that is, it must come back after its 2 ms."""
    wanted: dict[str, Ids | None] = {next(CHANNELS): None, next(CHANNELS): None}
    fired = []
    before = signal.signal(signal.SIGALRM, lambda *_: fired.append(time.monotonic()))
    with Receiver(opener(interface, fd=None), wanted, never_said) as receiver:
        signal.setitimer(signal.ITIMER_REAL, 0.0007, 0.0007)
        try:
            for _ in range(500):
                assert receiver.recv(0.002) is None
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)
    assert len(fired) > 500


# --- the receive queue


def test_messages_that_find_the_queue_full_are_counted_exactly() -> None:
    """On the local bus: as soon as they are lost, and none twice."""
    channel, counted = next(CHANNELS), []
    with open_bus(channel, LOCAL) as bus, open_bus(channel, LOCAL) as sender:
        assert isinstance(bus, LocalBus)
        bus._receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
        reader, sent, received = bus.batches(None), 0, 0
        for flood in (2000, 1, 1000):
            for i in range(flood):
                sender.send(number(i))
            sent += flood
            counted.append(reader.drops())
            while messages := reader.read():
                received += len(messages)
            assert reader.drops() == counted[-1] == sent - received
    assert 0 < counted[0] == counted[1] < counted[2]


def test_each_message_tells_how_many_were_lost_before_it() -> None:
    """Which is all that kernels before 4.12 say."""
    channel = next(CHANNELS)
    with open_bus(channel, LOCAL) as bus, open_bus(channel, LOCAL) as sender:
        assert isinstance(bus, LocalBus)
        bus._receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
        reader, sent, received = bus.batches(None), 0, 0
        for flood in (10, 2000, 1):
            for i in range(flood):
                sender.send(number(i))
            sent += flood
            while messages := reader.read():
                received += len(messages)
                assert all(0.0 <= time.time() - message.timestamp < 5.0 for message in messages)
        assert reader._queue._drops == sent - received > 0


def test_a_queue_is_made_larger_and_never_smaller() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as small:
        before = small.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        enlarge(small)
        after = small.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        assert after > before or before >= RECEIVE_BYTES
        enlarge(small)
        assert small.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == after


@pytest.mark.parametrize("ahead_s", [-1.7e9, -11.0, 0.5, 3600.0])
def test_a_driver_with_a_clock_of_its_own_is_not_believed(ahead_s: float) -> None:
    """Some adapters count from when they were plugged in."""
    heard_s, told_s = stamped(ahead_s)
    assert heard_s - 1.0 < told_s <= heard_s


def test_what_waited_in_a_driver_keeps_its_time() -> None:
    heard_s, told_s = stamped(-5.0)
    assert told_s == pytest.approx(heard_s - 5.0, abs=1.0)


def stamped(ahead_s: float) -> tuple[float, float]:
    """When a message stamped by such a clock was heard, and when that is said to have been."""
    channel = next(CHANNELS)
    with can.Bus(channel, "virtual", preserve_timestamps=True) as sender:
        adapter = Adapter(can.Bus(channel, "virtual"), channel)
        message = number(1)
        message.timestamp = time.time() + ahead_s
        sender.send(message)
        (heard,) = drained(adapter, 1)
        heard_s = time.time()
        adapter.shutdown()
    return heard_s, heard.timestamp


def drained(adapter: Adapter, count: int) -> list[can.Message]:
    """What an adapter gives, once it has so many."""
    give_up_s = time.monotonic() + PATIENCE_S
    while len(adapter._heard) < count:
        assert time.monotonic() < give_up_s
        time.sleep(0.01)
    return adapter.read()


def test_an_adapter_that_nobody_reads_keeps_the_newest_and_counts_the_rest() -> None:
    channel, more = next(CHANNELS), 100
    with open_bus(channel, "virtual") as sender:
        adapter = Adapter(open_bus(channel, "virtual"), channel)
        assert adapter.drops() is None
        for i in range(_MOST_HEARD + more):
            sender.send(number(i))
        until_s = time.monotonic() + PATIENCE_S
        while adapter.drops() != more and time.monotonic() < until_s:
            time.sleep(0.01)
        heard = adapter.read()
        assert adapter.drops() == more
        adapter.shutdown()
    assert [value_of(message) for message in heard] == list(range(more, _MOST_HEARD + more))


# --- lost and back


class Flaky:
    """Opens channels of the local bus through python-can; each can be broken, as by unplugging."""

    def __init__(self) -> None:
        self.buses: list[can.BusABC] = []
        self.refusals = 0
        """Attempts to open that fail from now on."""
        self.attempts_s: list[float] = []

    def open(self, channel: str, ids: Ids | None) -> Link:
        self.attempts_s.append(time.monotonic())
        if self.refusals:
            self.refusals -= 1
            raise AbsentBusError("no such adapter")
        numbers = None if ids is None else [number for number, _ in ids]
        self.buses.append(open_bus(channel, LOCAL, receive_ids=numbers))
        return Adapter(self.buses[-1], channel)


@pytest.fixture
def flaky() -> Flaky:
    return Flaky()


def test_a_lost_channel_comes_back_and_others_do_not_wait_for_it(flaky: Flaky) -> None:
    """Four attempts fail, ever longer apart; one line when it is lost, one when it is back."""
    names, said = [next(CHANNELS), next(CHANNELS)], list[str]()
    wanted: dict[str, Ids | None] = dict.fromkeys(names)
    senders = [open_bus(name, LOCAL) for name in names]
    with Receiver(flaky.open, wanted, lambda word: said.append(str(word))) as receiver:
        flaky.refusals, tries = 4, len(flaky.attempts_s)
        flaky.buses[0].shutdown()
        until(receiver, lambda: receiver.health()[0].state is BusState.DOWN)
        senders[1].send(number(1))
        meanwhile = receiver.recv(5.0)
        with pytest.raises(can.CanError, match="is down"):
            receiver.connection(names[0]).send(number(2))
        until(receiver, lambda: receiver.health()[0].state is BusState.UP)
        senders[0].send(number(3))
        after = receiver.recv(5.0)
        first, second = receiver.health()
    assert meanwhile is not None
    assert meanwhile.channel == names[1]
    assert after is not None
    assert (after.arbitration_id, after.channel) == (3, names[0])
    assert (first.losses, first.reconnects, first.reason) == (1, 1, "")
    assert (second.losses, second.reconnects) == (0, 0)
    assert len(said) == 2
    assert said[0].startswith(f"{names[0]} is lost: ")
    assert said[1].startswith(f"{names[0]} is back after ")
    waits_s = np.diff(flaky.attempts_s[tries:])
    expected_s = np.minimum(FIRST_RETRY_S * 2.0 ** np.arange(1, 5), LONGEST_RETRY_S)
    assert (waits_s >= expected_s - 0.001).all()
    for bus in senders:
        bus.shutdown()


def test_what_came_before_a_channel_was_lost_is_given(flaky: Flaky) -> None:
    channel = next(CHANNELS)
    with (
        open_bus(channel, LOCAL) as sender,
        Receiver(flaky.open, {channel: None}, lambda _: None) as receiver,
    ):
        for i in range(20):
            sender.send(number(i))
        time.sleep(0.2)  # the adapter's thread has them
        flaky.buses[0].shutdown()
        time.sleep(0.2)
        heard = until(receiver, lambda: receiver.health()[0].state is BusState.DOWN)
        heard += list(iter(lambda: receiver.recv(0.0), None))
    assert [message.arbitration_id for message in heard] == list(range(20))


def test_predictions_go_to_the_channel_that_was_opened_again(flaky: Flaky) -> None:
    """Meanwhile they fail and are counted; what was said then is not sent later."""
    channel = next(CHANNELS)
    with (
        open_bus(channel, LOCAL) as ear,
        Receiver(flaky.open, {channel: ()}, lambda _: None) as receiver,
    ):
        publisher = CanPublisher(receiver.connection(channel).outbox)
        publisher.publish(many(3))
        assert (publisher.sent, publisher.failed) == (4, 0)
        flaky.buses[0].shutdown()
        until(receiver, lambda: receiver.health()[0].state is BusState.DOWN)
        publisher.publish(many(3))
        publisher.publish(many(3))
        assert (publisher.sent, publisher.failed) == (4, 4)
        assert publisher.is_fd
        until(receiver, lambda: receiver.health()[0].state is BusState.UP)
        assert receiver.recv(0.05) is None
        publisher.publish(many(3))
        assert (publisher.sent, publisher.failed) == (8, 8)
        assert len([*iter(lambda: ear.recv(0.05), None)]) == 8


def test_a_driver_that_takes_its_time_to_open_holds_nobody_up(flaky: Flaky) -> None:
    names, gate = [next(CHANNELS), next(CHANNELS)], threading.Event()
    wanted: dict[str, Ids | None] = dict.fromkeys(names)

    def slow(channel: str, ids: Ids | None) -> Link:
        if len(flaky.buses) == 2:
            assert gate.wait(PATIENCE_S)
        return flaky.open(channel, ids)

    with (
        open_bus(names[1], LOCAL) as sender,
        Receiver(slow, wanted, lambda _: None) as receiver,
    ):
        flaky.buses[0].shutdown()
        until(receiver, lambda: receiver.health()[0].state is BusState.DOWN)
        for i in range(20):
            sender.send(number(i))
            assert receiver.recv(5.0) is not None
            time.sleep(0.02)
        assert receiver.health()[0].state is BusState.DOWN
        gate.set()
        until(receiver, lambda: receiver.health()[0].state is BusState.UP)


def test_what_is_not_there_at_the_start_is_an_error_or_waited_for(flaky: Flaky) -> None:
    channel, said = next(CHANNELS), list[str]()
    flaky.refusals = 1
    with pytest.raises(AbsentBusError, match="no such adapter"):
        Receiver(flaky.open, {channel: None}, lambda word: said.append(str(word)))
    flaky.refusals = 2
    with (
        Receiver(
            flaky.open, {channel: None}, lambda word: said.append(str(word)), wait=True
        ) as receiver,
        open_bus(channel, LOCAL) as sender,
    ):
        assert receiver.health()[0].reason == "no such adapter"
        until(receiver, lambda: receiver.health()[0].state is BusState.UP)
        sender.send(number(1))
        assert receiver.recv(5.0) is not None
        assert receiver.health()[0].losses == 0
    assert said[0] == f"waiting for {channel}: no such adapter"
    assert said[1].startswith(f"{channel} is there after ")
    assert len(said) == 2


def test_a_mistake_is_an_error_even_for_who_waits() -> None:
    """Time does not mend it; and what was opened before is closed."""
    wanted: dict[str, Ids | None] = {next(CHANNELS): None}
    with pytest.raises(BusError, match="no CAN interface 'usbcan'") as caught:
        Receiver(opener("usbcan", fd=None), wanted, never_said, wait=True)
    assert not isinstance(caught.value, AbsentBusError)


def test_error_frames_of_other_adapters_are_counted_too() -> None:
    """And are no messages."""
    channel = next(CHANNELS)
    passive = can.Message(
        arbitration_id=0x4, is_extended_id=False, is_error_frame=True, data=b"\0\x20" + bytes(6)
    )
    with (
        open_bus(channel, "virtual") as sender,
        Receiver(opener("virtual", fd=None), {channel: None}, never_said) as receiver,
    ):
        sender.send(passive)
        sender.send(number(1))
        message = receiver.recv(5.0)
        (health,) = receiver.health()
    assert message is not None
    assert message.arbitration_id == 1
    assert (health.state, health.error_frames) == (BusState.ERROR_PASSIVE, 1)
    assert health.dropped is None


def test_an_adapter_hears_no_more_when_it_is_closed() -> None:
    before = threading.active_count()
    link = open_link(next(CHANNELS), "virtual", fd=None, receive=None)
    assert threading.active_count() == before + 1
    link.shutdown()
    assert threading.active_count() == before


# --- what is said


def health(**changes: object) -> BusHealth:
    values: dict[str, object] = {
        "channel": "can0",
        "state": BusState.UP,
        "since_s": 100.0,
        "reason": "",
        "losses": 0,
        "reconnects": 0,
        "bus_offs": 0,
        "error_frames": 0,
        "dropped": 0,
        "overruns": 0,
    }
    return BusHealth(**values | changes)  # type: ignore[arg-type]


def test_nothing_is_said_of_channels_that_are_well() -> None:
    assert trouble([health()], [health(error_frames=3)], 200.0) == ""
    assert in_sum([health(), health(dropped=None)]) == ""


def test_trouble_is_what_is_wrong_now_and_what_was_lost_since() -> None:
    before = [health(dropped=5), health(channel="can1", dropped=None)]
    after = [
        health(dropped=17, overruns=1),
        health(channel="can1", dropped=None, state=BusState.DOWN, since_s=188.0),
    ]
    assert trouble(before, after, 200.0) == (
        "can0: 12 messages lost, receive queue full; can0: controller overrun (1x); "
        "can1 down for 12 s"
    )


def test_the_sum_of_a_run_names_what_happened() -> None:
    one = health(losses=2, bus_offs=1, error_frames=40, dropped=7, overruns=3)
    assert in_sum([health(channel="can1"), one]) == (
        "can0: lost 2x, bus-off 1x, 40 error frames, 7 messages lost to a full receive queue, "
        "controller overrun 3x"
    )
