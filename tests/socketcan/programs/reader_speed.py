"""What a message costs to read, by readers of one bus that take turns.

reader_speed.py CHANNEL INTERFACE ROUNDS. `python-can`: its bus; `recvmsg`: a message per system
call through Python's socket, and nothing made of it; `eqrt`: our reader. Medians over the rounds.
"""

from __future__ import annotations

import contextlib
import select
import sys
import time
from collections.abc import Callable

import can
import numpy as np

from eqrt.runtime.bus.links import open_link
from eqrt.runtime.bus.socketcan import SocketCan

WAITING = 100  # messages in the queue when reading begins; any queue has room for them
MESSAGE = can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes(8))
Read = Callable[[int], None]
"""Reads so many messages, waiting for each if it is not there."""


def python_can(channel: str, interface: str, stack: contextlib.ExitStack) -> Read:
    bus = stack.enter_context(can.Bus(channel, interface, fd=True))

    def read(count: int) -> None:
        for _ in range(count):
            assert bus.recv(1.0) is not None

    return read


def eqrt(channel: str, interface: str, stack: contextlib.ExitStack) -> Read:
    link, poll = open_link(channel, interface, fd=True, receive=None), select.poll()
    stack.callback(link.shutdown)
    poll.register(link, select.POLLIN)

    def read(count: int) -> None:
        while count > 0:
            poll.poll(1000)
            count -= len(link.read())

    return read


def recvmsg(channel: str, _interface: str, stack: contextlib.ExitStack) -> Read:
    link, poll = SocketCan(channel, fd=True, receive=None), select.poll()
    stack.callback(link.shutdown)
    poll.register(link, select.POLLIN)

    def read(count: int) -> None:
        while count > 0:
            poll.poll(1000)
            with contextlib.suppress(BlockingIOError):
                while count > 0:
                    link._socket.recvmsg(72, 64)
                    count -= 1

    return read


def main(channel: str, interface: str, rounds: int) -> None:
    """Take turns."""
    makers = [python_can, *([recvmsg] if interface == "socketcan" else []), eqrt]
    spent: dict[tuple[str, int], list[float]] = {}
    with contextlib.ExitStack() as stack:
        readers = {make.__name__: make(channel, interface, stack) for make in makers}
        sender = open_link(channel, interface, fd=True, receive=())
        stack.callback(sender.shutdown)
        for _ in range(rounds):
            for count in (WAITING, *[1] * 20):
                for _ in range(count):
                    sender.send(MESSAGE)
                for name, read in readers.items():
                    begun_s = time.perf_counter()
                    read(count)
                    each_s = (time.perf_counter() - begun_s) / count
                    spent.setdefault((name, count), []).append(each_s)
    for name in readers:
        queued, alone = (1e6 * np.median(spent[name, count]) for count in (WAITING, 1))
        print(f"{name:<11}{queued:6.1f} us of {WAITING} that wait, {alone:6.1f} us of one alone")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
