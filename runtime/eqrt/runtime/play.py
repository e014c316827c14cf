"""Put a recorded log on a CAN bus, in the time in which it was recorded.

`eqrt play drive.log --can vcan0` sends everything on one channel;
`eqrt play drive.log --can can0=vcan0 --can can1=vcan1` keeps the log's channels apart.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

import can

from eqrt.core.errors import BusError, UsageError
from eqrt.runtime.bus.buses import carries_fd, open_bus
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.signals import until_told_to_stop

_LONGEST_WAIT_S = 60.0  # a longer silence in the log, like a clock that was set, is not waited for
_DISORDER_S = 1.0  # how far back a stamp may go without the clock having been set
_NAP_S = 0.1  # how long a signal may go unnoticed
_RETRY_S = 1.0  # how long a full buffer may stay full: 7,000 messages on a fast CAN FD bus
_RETRY_PAUSE_S = 0.001

OTHERS = ""
"""The key of a route for every log channel that has none of its own."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("log", help="candump .log, .asc, .blf or .trc, also with .gz")
    parser.add_argument(
        "--can",
        required=True,
        action="append",
        metavar="[NAME=]CHANNEL",
        help="the channel to send on; with NAME= only what the log has on NAME (repeatable)",
    )
    parser.add_argument("--can-interface", metavar="IF", help="python-can's name; else socketcan")
    parser.add_argument(
        "--speed", type=float, default=1.0, help="times real time; 0 = as fast as the bus takes it"
    )
    parser.add_argument("--loop", action="store_true", help="start again at the end")
    parser.add_argument(
        "--fd",
        action=argparse.BooleanOptionalAction,
        help="open the channel for CAN FD, or not; else if the channel can",
    )


def run(args: argparse.Namespace) -> int:
    """Play, and say in one line how it went."""
    if not (math.isfinite(args.speed) and args.speed >= 0.0):
        raise UsageError(f"--speed is {args.speed}; give a number above 0, or 0 for no waiting")
    log, routes = read_log(args.log), parse_routes(args.can)
    with contextlib.ExitStack() as stack:
        buses = {
            channel: stack.enter_context(open_bus(channel, args.can_interface, fd=args.fd))
            for channel in sorted(set(routes.values()))
        }
        should_stop = stack.enter_context(until_told_to_stop())
        player = Player({name: buses[channel] for name, channel in routes.items()}, args.speed)
        player.play(log, should_stop)
        if log.remark:
            print(f"eqrt: {log.remark}", file=sys.stderr)
        while args.loop and player.sent and not should_stop():
            if args.speed and not player.lasted_s:
                raise UsageError(
                    f"--loop: all messages of {args.log} carry the same time, which does not say "
                    "when to start again; --speed 0 repeats them as fast as the bus takes them"
                )
            player.play(log, should_stop)
        stopped = should_stop()
    print(f"eqrt play: {player.summary()}")
    return 0 if player.sent or stopped else 1


def parse_routes(options: Sequence[str]) -> dict[str, str]:
    """The options `--can`: log channel (or OTHERS) -> bus channel. Raises UsageError."""
    routes: dict[str, str] = {}
    for option in options:
        name, equals, channel = option.rpartition("=")
        if not channel or (equals and not name):
            raise UsageError(f"--can {option!r} names no channel; write CHANNEL or NAME=CHANNEL")
        if name in routes:
            given = f"log channel {name!r}" if equals else "all log channels"
            raise UsageError(f"--can is given twice for {given}; once is enough")
        routes[name] = channel
    return routes


class Player:
    """Sends messages on buses at the times they carry, and counts."""

    def __init__(self, routes: Mapping[str, can.BusABC], speed: float = 1.0) -> None:
        """`routes`: log channel or OTHERS -> bus. `speed`: times real time, 0 = without waiting."""
        self._routes = routes
        self._pace = _Pace(speed)
        self._started_s = time.monotonic()
        self.sent = 0
        self.left_out: Counter[str] = Counter()
        """Messages that were not sent, by the reason."""
        self.latest_s = 0.0
        """How long after its time the latest message was sent."""

    def play(self, messages: Iterable[can.Message], should_stop: Callable[[], bool]) -> None:
        """Send every message, or those until `should_stop`. Raises BusError if a bus does not take
        them, and what iterating raises.
        """
        self._pace.restart()
        for message in messages:
            due_s = self._pace.due_s(message.timestamp)
            while (wait_s := due_s - time.monotonic()) > 0.0 and not should_stop():
                time.sleep(min(wait_s, _NAP_S))
            if should_stop():
                return
            bus = self._bus_for(message)
            if bus is None:
                continue
            self.latest_s = max(self.latest_s, time.monotonic() - due_s)
            send(bus, message, should_stop)
            self.sent += 1

    @property
    def lasted_s(self) -> float:
        """From the first message of the log to the last one, as it was played."""
        return self._pace.lasted_s

    def summary(self) -> str:
        """One line for the terminal."""
        parts = [f"sent {self.sent} messages in {time.monotonic() - self._started_s:.1f} s"]
        if self._pace.speed:
            parts.append(f"at most {1e3 * self.latest_s:.1f} ms late")
        if self._pace.jumps:
            parts.append(f"{self._pace.jumps} jumps of the log's clock not waited for")
        parts += [f"not sent: {number} {reason}" for reason, number in self.left_out.items()]
        return "; ".join(parts)

    def _bus_for(self, message: can.Message) -> can.BusABC | None:
        """None for a message that is left out."""
        bus = self._routes.get(str(message.channel)) or self._routes.get(OTHERS)
        if message.is_error_frame:
            reason = "bus errors"
        elif bus is None:
            reason = f"of the log's channel {message.channel}, which no --can names"
        elif message.is_fd and not carries_fd(bus):
            reason = "in CAN FD, for a channel that is open for classic CAN"
        else:
            return bus
        self.left_out[reason] += 1
        return None


class _Pace:
    """Turns the log's clock into the monotonic clock. Every time is counted from the first message,
    not from the one before, so that lateness does not add up.
    """

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self.jumps = 0
        self._due_s = time.monotonic()
        self.restart()

    def restart(self) -> None:
        """The next message is the first of a log, and due when the one before was."""
        self._start_s, self._first_s, self._last_s = self._due_s, math.nan, math.nan

    @property
    def lasted_s(self) -> float:
        """From when the first message of the log was due to when the latest was."""
        return self._due_s - self._start_s

    def due_s(self, timestamp_s: float) -> float:
        """When (monotonic clock) the message stamped `timestamp_s` is to be sent."""
        if not self.speed:
            return time.monotonic()
        if math.isnan(self._first_s):
            self._first_s = self._last_s = timestamp_s
        step_s = timestamp_s - self._last_s
        if not -_DISORDER_S <= step_s <= _LONGEST_WAIT_S:
            self.jumps += 1
            self._first_s += step_s
        self._last_s = timestamp_s
        self._due_s = max(self._due_s, self._start_s + (timestamp_s - self._first_s) / self.speed)
        return self._due_s


def send(bus: can.BusABC, message: can.Message, should_stop: Callable[[], bool]) -> None:
    """Send one message, however long the bus is full. Raises BusError if it stays so."""
    give_up_s = time.monotonic() + _RETRY_S
    while True:
        try:
            return bus.send(message)
        except (can.CanError, OSError) as error:
            if should_stop():
                return None
            if time.monotonic() > give_up_s:
                raise BusError(
                    f"{bus.channel_info} took no message for {_RETRY_S:.0f} s "
                    f"({error}); is it up, and is another node on it at the same bit rate?"
                ) from error
        time.sleep(_RETRY_PAUSE_S)
