"""Two processes on one SocketCAN channel: this one sends, its child prints what it receives."""

from __future__ import annotations

import subprocess
import sys

import can

MESSAGES = [
    can.Message(arbitration_id=0x60A, data=bytes.fromhex("01c24910"), is_extended_id=False),
    can.Message(arbitration_id=0x1ABCDEF0, data=bytes(range(8)), is_extended_id=True),
    can.Message(arbitration_id=0x7FF, data=b"", is_extended_id=False),
    can.Message(arbitration_id=0x123, data=bytes(range(64)), is_extended_id=False, is_fd=True),
    can.Message(
        arbitration_id=0x124,
        data=bytes(range(12)),
        is_extended_id=False,
        is_fd=True,
        bitrate_switch=True,
    ),
]


def describe(message: can.Message) -> str:
    """What must arrive as it was sent."""
    kind = f"fd{int(message.bitrate_switch)}" if message.is_fd else "classic"
    return f"{kind} {message.is_extended_id:d} {message.arbitration_id:X} {message.data.hex()}"


def send(channel: str) -> None:
    """Start the receiver, wait until it listens, send, and wait for its end."""
    child = subprocess.Popen(
        [sys.executable, __file__, channel, "receive"], stderr=subprocess.PIPE, text=True
    )
    assert child.stderr is not None
    child.stderr.readline()
    with can.Bus(interface="socketcan", channel=channel, fd=True) as bus:
        for message in MESSAGES:
            bus.send(message)
    sys.exit(child.wait())


def receive(channel: str) -> None:
    """Print as many messages as are sent."""
    with can.Bus(interface="socketcan", channel=channel, fd=True) as bus:
        print("listening", file=sys.stderr, flush=True)
        for _ in MESSAGES:
            message = bus.recv(timeout=5.0)
            print(describe(message) if message else "nothing came")


if __name__ == "__main__":
    receive(sys.argv[1]) if sys.argv[2:] else send(sys.argv[1])
