"""Opening buses: what works without hardware, and what is said where it does not."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator

import can
import pytest

from eqrt.core.errors import BusError
from eqrt.runtime.bus.buses import (
    LOCAL,
    NetworkInterface,
    carries_fd,
    interface_names,
    network_interface,
    open_bus,
)
from eqrt.runtime.bus.local_bus import LocalBus
from own_network import own_network
from processes import eqrt
from source_tree import ROOT

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is Linux's")
CHANNELS = (f"test-{number}-{time.monotonic_ns()}" for number in itertools.count())
MESSAGES = (
    can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02"),
    can.Message(arbitration_id=0x18FF1234, data=b""),
    can.Message(arbitration_id=0x7FF, is_extended_id=False, is_remote_frame=True, dlc=8),
    can.Message(arbitration_id=0x4, is_error_frame=True, data=bytes(8)),
    can.Message(arbitration_id=0x6E1, is_extended_id=False, is_fd=True, data=bytes(range(64))),
    can.Message(arbitration_id=0x1, is_fd=True, bitrate_switch=True, error_state_indicator=True),
)
ECHO = """
import sys
from eqrt.runtime.bus.buses import open_bus
with open_bus(sys.argv[1], "eqrt_local") as bus:
    print("ready", flush=True)
    for _ in range(int(sys.argv[2])):
        bus.send(bus.recv())
"""


@pytest.fixture
def pair() -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """Two places on one local bus."""
    channel = next(CHANNELS)
    with open_bus(channel, LOCAL) as first, open_bus(channel, LOCAL) as second:
        yield first, second


def test_messages_cross_processes_on_the_local_bus() -> None:
    """Of every kind, with all their fields, in order; another process sends them back."""
    channel = next(CHANNELS)
    with (
        open_bus(channel, LOCAL) as bus,
        subprocess.Popen(
            [sys.executable, "-c", ECHO, channel, str(len(MESSAGES))],
            cwd=ROOT / "runtime",
            stdout=subprocess.PIPE,
        ) as other,
    ):
        assert other.stdout is not None
        assert other.stdout.readline() == b"ready\n"
        for message in MESSAGES:
            bus.send(message)
        for message in MESSAGES:
            received = bus.recv(5.0)
            assert received is not None
            assert received.equals(message, timestamp_delta=None, check_channel=False)
            assert received.channel == channel
            assert abs(received.timestamp - time.time()) < 5.0


def test_who_sends_does_not_hear_it(pair: tuple[can.BusABC, can.BusABC]) -> None:
    first, second = pair
    first.send(MESSAGES[0])
    assert first.recv(0.05) is None
    assert second.recv(5.0) is not None


@LINUX
def test_a_message_is_stamped_when_it_comes_not_when_it_is_read(
    pair: tuple[can.BusABC, can.BusABC],
) -> None:
    """As a CAN driver does it, so that a busy reader knows how long it waited."""
    first, second = pair
    before_s = time.time()
    first.send(MESSAGES[0])
    after_s = time.time()
    time.sleep(0.05)
    received = second.recv(5.0)
    assert received is not None
    assert before_s - 0.001 <= received.timestamp <= after_s + 0.001


def test_channels_of_the_local_bus_are_apart(pair: tuple[can.BusABC, can.BusABC]) -> None:
    first, _ = pair
    with open_bus(next(CHANNELS), LOCAL) as other:
        first.send(MESSAGES[0])
        assert other.recv(0.05) is None


def test_a_classic_place_on_the_local_bus_knows_no_can_fd() -> None:
    """It neither sends nor receives CAN FD; what is classic goes both ways."""
    channel = next(CHANNELS)
    with open_bus(channel, LOCAL, fd=False) as classic, open_bus(channel, LOCAL) as fd:
        assert (carries_fd(classic), carries_fd(fd)) == (False, True)
        with pytest.raises(can.CanOperationError, match="CAN FD"):
            classic.send(MESSAGES[4])
        for number in (4, 0):
            fd.send(MESSAGES[number])
        received = classic.recv(5.0)
        assert received is not None
        assert received.arbitration_id == MESSAGES[0].arbitration_id


def test_strange_datagrams_are_no_messages(pair: tuple[can.BusABC, can.BusABC]) -> None:
    """From a program that speaks to the same group."""
    first, second = pair
    assert isinstance(first, LocalBus)
    with open_bus(str(first.channel), LOCAL) as third:
        assert isinstance(third, LocalBus)
        for payload in (b"", b"short", third._digest, third._digest + b"1234567", bytes(200)):
            third._sender.sendto(payload, third._destination)
        third.send(MESSAGES[0])
        received = second.recv(5.0)
    assert received is not None
    assert received.equals(MESSAGES[0], timestamp_delta=None, check_channel=False)


@pytest.mark.parametrize("interface", [LOCAL, "virtual"])
def test_only_the_wanted_ids_are_received(interface: str) -> None:
    channel = next(CHANNELS)
    with (
        open_bus(channel, interface) as sender,
        open_bus(channel, interface, receive_ids=[0x123, 0x18FF1234]) as some,
        open_bus(channel, interface, receive_ids=[]) as none,
    ):
        for message in MESSAGES:
            sender.send(message)
        found = [message.arbitration_id for message in iter(lambda: some.recv(0.1), None)]
        assert found == [0x123, 0x18FF1234]
        assert none.recv(0.05) is None


@LINUX
def test_the_local_bus_needs_no_network_but_loopback() -> None:
    """In a network namespace that has nothing else: no route, no interface that can multicast."""
    ip = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    program = f"""
import subprocess
subprocess.run(["{ip}", "link", "set", "lo", "up"], check=True)
from eqrt.runtime.bus.buses import open_bus
import can
with open_bus("c", "eqrt_local") as first, open_bus("c", "eqrt_local") as second:
    first.send(can.Message(arbitration_id=0x321))
    print(hex(second.recv(5.0).arbitration_id))
"""
    done = subprocess.run(
        [*own_network(), sys.executable, "-c", program],
        cwd=ROOT / "runtime",
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "0x321\n", done.stderr


def test_virtual_carries_can_fd_unless_told_not_to() -> None:
    with open_bus("a", "virtual") as fd, open_bus("a", "virtual", fd=False) as classic:
        assert (carries_fd(fd), carries_fd(classic)) == (True, False)


def test_an_unknown_interface_names_the_known_ones() -> None:
    with pytest.raises(BusError, match=r"no CAN interface 'usbcan'; known are .*eqrt_local.*pcan"):
        open_bus("can0", "usbcan")
    assert {"socketcan", "virtual", "kvaser", LOCAL} <= set(interface_names())


@pytest.mark.parametrize("interface", ["pcan", "slcan", "udp_multicast", "vector", "socketcand"])
def test_an_adapter_that_cannot_be_opened_says_so_in_one_line(
    interface: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """And python-can's own remarks do not stand beside it."""
    with pytest.raises(BusError, match=f"'nowhere' through {interface}") as caught:
        open_bus("nowhere", interface)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


@LINUX
def test_a_missing_channel_says_what_to_do() -> None:
    """With CAN in the kernel, how to make a channel; without it, how to load it."""
    with pytest.raises(BusError, match=r"CAN channel 'nosuchcan'.*(deploy/vcan\.sh|modprobe)"):
        open_bus("nosuchcan")


@LINUX
def test_the_kernel_is_asked_what_an_interface_is() -> None:
    loopback = network_interface("lo")
    assert loopback is not None
    assert loopback == NetworkInterface(
        is_can=False, is_up=loopback.is_up, mtu_bytes=loopback.mtu_bytes
    )
    assert loopback.mtu_bytes >= 1500
    assert network_interface("nosuchcan") is None
    assert network_interface("n" * 40) is None


@LINUX
def test_channels_are_found_with_the_sockets_that_the_unit_leaves_a_service() -> None:
    """Netlink, which if_nameindex(3) asks, is not among them."""
    code = (
        "import restricted, socket\n"
        "from eqrt.runtime.bus.buses import can_channels\n"
        "before = can_channels()\n"
        "restricted.restrict()\n"
        "assert can_channels() == before\n"
        "try:\n"
        "    socket.if_nameindex()\n"
        "except OSError:\n"
        "    print('restricted')\n"
    )
    done = eqrt(command=[sys.executable, "-c", code], cwd=ROOT / "tests")
    assert (done.stdout, done.stderr) == ("restricted\n", "")
