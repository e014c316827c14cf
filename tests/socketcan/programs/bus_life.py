"""What happens to channels, and who notices: bus_life.py [SCENARIO]... prints findings as JSON."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import can

from eqrt.runtime.bus.health import BusHealth, BusWord
from eqrt.runtime.bus.ids import Ids
from eqrt.runtime.bus.links import opener
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.bus.socketcan import SocketCan
from socketcan.programs.exchange import MESSAGES

SOME: Ids = [(0x123, False), (0x18FF1234, True)]
OFFERED = (
    can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01"),
    can.Message(arbitration_id=0x123, is_extended_id=True, data=b"\x02"),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=4),
    can.Message(arbitration_id=0x18FF1234, is_extended_id=True, data=b"\x03"),
    can.Message(arbitration_id=0x234, is_extended_id=False, data=b"\x04"),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, data=bytes(48)),
)
BUS_OFF, RESTARTED, CONTROLLER = 0x40, 0x100, 0x04  # classes of error frames, linux/can/error.h
OVERRUN, WARNING, PASSIVE, ACTIVE = 0x01, 0x04, 0x10, 0x40  # of the controller, in byte 1
PATIENCE_S = 20.0


def ip_link(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True)


def number(value: int) -> can.Message:
    return can.Message(arbitration_id=0x123, is_extended_id=False, data=value.to_bytes(4, "big"))


def error(kind: int, controller: int = 0) -> can.Message:
    data = bytes([0, controller, 0, 0, 0, 0, 0, 0])
    return can.Message(arbitration_id=kind, is_extended_id=False, is_error_frame=True, data=data)


def kind(message: can.Message) -> str:
    """Which of those that were offered."""
    if message.is_error_frame:
        return "error"
    name = f"{message.arbitration_id:X}{'X' * message.is_extended_id}"
    return name + " remote" * message.is_remote_frame + " FD" * message.is_fd


def send(channel: str, *messages: can.Message) -> None:
    """As another program does."""
    with can.Bus(channel, "socketcan", fd=True) as bus:
        for message in messages:
            bus.send(message)


class Life:
    """A receiver, what it was told, and what it heard."""

    def __init__(self, *channels: str, ids: Ids | None = None, wait: bool = False) -> None:
        self.said: list[str] = []
        self._heard: list[str] = []
        wanted = dict.fromkeys(channels, ids)
        self.receiver = Receiver(opener(None, fd=None), wanted, self._note, wait=wait)

    def _note(self, word: BusWord) -> None:
        self.said.append(str(word))

    def heard(self, seconds: float = 0.2) -> list[str]:
        """Channel and data of what comes within that time, or came while it waited."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            self._hear(left_s)
        found, self._heard = self._heard, []
        return found

    def _hear(self, timeout_s: float) -> None:
        if (message := self.receiver.recv(timeout_s)) is not None:
            self._heard.append(f"{message.channel} {message.data.hex()}")

    def health(self, channel: str) -> BusHealth:
        return next(one for one in self.receiver.health() if one.channel == channel)

    def until(self, channel: str, state: str) -> float:
        """Read until a channel's state is that; the seconds it took."""
        begun_s = time.monotonic()
        while self.health(channel).state.name != state:
            assert time.monotonic() < begun_s + PATIENCE_S, f"{channel} is not {state}"
            self._hear(0.01)
        return time.monotonic() - begun_s

    def send(self, channel: str, message: can.Message) -> str:
        """What sending led to."""
        try:
            self.receiver.connection(channel).send(message)
        except (can.CanError, OSError) as problem:
            return type(problem).__name__
        return "sent"


@contextlib.contextmanager
def listening(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(channel, "socketcan", fd=True) as bus:
        yield bus


def messages() -> object:
    """Our reader beside python-can's, and what we send, as python-can reads it."""
    ours = SocketCan("vcan0", fd=True, receive=None)
    read, sent = [], []
    with listening("vcan0") as theirs, listening("vcan0") as other:
        for message in (*OFFERED, *MESSAGES, error(CONTROLLER, OVERRUN)):
            before_s = time.time()
            other.send(message)
            (mine,), reference = ours.read(), theirs.recv(1.0)
            assert reference is not None
            same = mine.equals(
                reference, timestamp_delta=1e-6, check_direction=False, check_channel=False
            )
            read.append(same and before_s - 0.1 < mine.timestamp <= time.time())
        for message in (*OFFERED, *MESSAGES):
            ours.send(message)
            reference = theirs.recv(1.0)
            assert reference is not None
            sent.append(
                reference.equals(
                    message, timestamp_delta=None, check_channel=False, check_direction=False
                )
            )
    return {"read": read, "sent": sent, "own": len(ours.read())}


def filters() -> object:
    """What the kernel lets through, by what was asked for."""
    wanted: dict[str, Ids | None] = {
        "all": None,
        "some": SOME,
        "none": (),
        "many": [(i, True) for i in range(600)] + list(SOME),
    }
    links = {name: SocketCan("vcan0", fd=True, receive=ids) for name, ids in wanted.items()}
    send("vcan0", *OFFERED, error(BUS_OFF))
    return {name: [kind(message) for message in link.read()] for name, link in links.items()}


def overflow() -> object:
    """A flood that nobody reads, with a small queue: what came and what did not."""
    link = SocketCan("vcan0", fd=True, receive=SOME)
    link._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
    sent, rounds = 0, []
    for flood in (3000, 1, 2000, 10):
        send("vcan0", *map(number, range(sent, sent + flood)))
        sent += flood
        dropped_unread = link.drops()
        received = []
        while batch := link.read():
            received += [int.from_bytes(message.data, "big") for message in batch]
        assert received == list(range(sent - flood, sent - flood + len(received)))
        rounds.append(
            {
                "sent": sent,
                "received": len(received),
                "dropped_before_reading": dropped_unread,
                "dropped": link.drops(),
            }
        )
    return rounds


def down_and_up() -> object:
    """vcan0 goes down with a message unread; vcan1 goes on."""
    life = Life("vcan0", "vcan1")
    send("vcan0", number(1))
    ip_link("set", "vcan0", "down")
    before = life.heard()
    state, reason = life.health("vcan0").state.name, life.health("vcan0").reason
    send("vcan1", number(2))
    meanwhile = life.heard()
    unsent = life.send("vcan0", number(3))
    time.sleep(0.5)
    ip_link("set", "vcan0", "up")
    life.until("vcan0", "UP")
    send("vcan0", number(4))
    after = life.heard()
    with listening("vcan0") as other:
        resent = life.send("vcan0", number(5))
        arrived = other.recv(1.0) is not None
    return {
        "before": before,
        "state": state,
        "reason": reason,
        "meanwhile": meanwhile,
        "unsent": unsent,
        "after": after,
        "resent": resent,
        "arrived": arrived,
        "said": life.said,
        "losses": [one.losses for one in life.receiver.health()],
        "reconnects": [one.reconnects for one in life.receiver.health()],
    }


def gone_and_back() -> object:
    """vcan0 is removed, twice, as when an adapter is unplugged; it comes back as classic CAN."""
    life = Life("vcan0", ids=SOME)
    states, heard = [life.receiver.connection("vcan0").protocol.name], []
    for mtu in ("16", "72"):
        ip_link("del", "vcan0")
        life.until("vcan0", "DOWN")
        life.heard(0.5)
        ip_link("add", "dev", "vcan0", "type", "vcan")
        life.heard(0.3)
        states.append(life.health("vcan0").state.name)
        ip_link("set", "vcan0", "up", "mtu", mtu)
        life.until("vcan0", "UP")
        states.append(life.receiver.connection("vcan0").protocol.name)
        send_one = ["cansend", "vcan0", "123#01"], ["cansend", "vcan0", "124#02"]
        for command in send_one:
            subprocess.run(command, check=True)
        heard += life.heard()
    return {"states": states, "heard": heard, "said": life.said}


def error_frames() -> object:
    """As a controller's driver makes them."""
    life = Life("vcan0", ids=[(0x123, False), (BUS_OFF, False)])
    states = []
    for frame in (
        error(CONTROLLER, WARNING),
        error(CONTROLLER, PASSIVE),
        error(0x08),  # a protocol violation, which changes nothing
        error(BUS_OFF),
        error(RESTARTED),
        error(CONTROLLER, PASSIVE),
        error(CONTROLLER, ACTIVE),
        error(CONTROLLER, OVERRUN),
        error(BUS_OFF),
        number(1),
    ):
        send("vcan0", frame)
        heard = life.heard(0.05)
        states.append(life.health("vcan0").state.name)
    one = life.health("vcan0")
    return {
        "states": states,
        "heard": heard,
        "said": life.said,
        "error_frames": one.error_frames,
        "bus_offs": one.bus_offs,
        "overruns": one.overruns,
        "losses": one.losses,
    }


def waited_for() -> object:
    """vcan2 is down and vcan5 not there at the start, while vcan0 is read."""
    life = Life("vcan0", "vcan2", "vcan5", wait=True)
    send("vcan0", number(1))
    heard = life.heard(0.5)
    states = [one.state.name for one in life.receiver.health()]
    ip_link("set", "vcan2", "up", "mtu", "72")
    ip_link("add", "dev", "vcan5", "type", "vcan")
    ip_link("set", "vcan5", "up", "mtu", "72")
    for channel in ("vcan2", "vcan5"):
        life.until(channel, "UP")
        send(channel, number(2))
    heard += life.heard()
    return {"states": states, "heard": heard, "said": life.said}


def loopback() -> object:
    """The local bus, whose network is switched off and on: nothing is lost for good."""
    said: list[str] = []
    wanted: dict[str, Ids | None] = {"here": None}
    receiver = Receiver(opener("eqrt_local", fd=None), wanted, lambda word: said.append(str(word)))
    heard = []
    with can.Bus("here", "eqrt_local") as other:
        for step in ("up", "down", "up"):
            ip_link("set", "lo", step)
            with contextlib.suppress(can.CanError):
                other.send(number(1))
            heard.append(receiver.recv(0.3) is not None)
    ip_link("set", "lo", "down")
    return {"heard": heard, "said": said}


SCENARIOS: dict[str, Callable[[], object]] = {
    scenario.__name__: scenario
    for scenario in (
        messages,
        filters,
        overflow,
        error_frames,
        down_and_up,
        gone_and_back,
        waited_for,
        loopback,
    )
}

if __name__ == "__main__":
    for name in sys.argv[1:] or SCENARIOS:
        print(json.dumps({name: SCENARIOS[name]()}), flush=True)
