"""The program that puts traffic on the bus: `python -m eqrt.runtime.bench.service.traffic ORDER`.

Periodic cycles start at absolute times and their messages follow each other as on a bus of
500 kbit/s. Back-to-back, a cycle is sent at once and the next one when the last prediction of the
one before has been heard. It goes on until it is told to stop, then says how punctual it was.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np

from eqrt.runtime.bench.schedule import CLOCK
from eqrt.runtime.bench.service.crowd import MESSAGE_S, Cycle, crowded_cycles
from eqrt.runtime.bench.service.orders import TrafficOrder, read_order, say, while_wanted
from eqrt.runtime.bus.buses import open_bus
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.output.can_output import CLASSIC_TIMES_S, STATUS, STATUS_CLASSIC, Offset
from eqrt.runtime.output.publish_can import BASE_ID
from eqrt.runtime.play import OTHERS, Player, send

ANSWER_S = 1.0
"""A cycle that is not answered by then is lost, and the next one is sent."""


def main() -> int:
    """Send until told to stop."""
    order = read_order(TrafficOrder)
    waits = order.log is None and order.period_s is None
    heard = [BASE_ID + offset for offset in Offset] if waits else []
    wanted = order.bus
    with (
        open_bus(wanted.channel, wanted.interface, fd=wanted.fd, receive_ids=heard) as bus,
        while_wanted() as should_stop,
    ):
        if order.log is not None:
            _play(Path(order.log), bus, should_stop)
        elif order.period_s is not None:
            _periodic(_endless(order.objects), order.period_s, bus, should_stop)
        else:
            _back_to_back(_endless(order.objects, message_s=0.0), bus, should_stop)
    return 0


def _endless(objects: int, message_s: float = MESSAGE_S) -> Iterator[Cycle]:
    """The drive over and over, made before the first message is sent."""
    cycles = list(crowded_cycles(objects, message_s))
    return itertools.cycle(cycles)


def _play(log: Path, bus: can.BusABC, should_stop: Callable[[], bool]) -> None:
    player = Player({OTHERS: bus})
    say("ready")
    while not should_stop():
        player.play(read_log(log), should_stop)
    say("ended", cycles=0, lost=0, late_p99_s=player.latest_s)


def _periodic(
    cycles: Iterator[Cycle], period_s: float, bus: can.BusABC, should_stop: Callable[[], bool]
) -> None:
    late_s: list[float] = []
    say("ready")
    start_s = time.perf_counter() + period_s
    for number, cycle in enumerate(cycles):
        due_s = start_s + number * period_s
        for message in cycle:
            while (wait_s := due_s + message.timestamp - time.perf_counter()) > 0.0:
                time.sleep(wait_s)
            send(bus, message, should_stop)
        late_s.append(time.perf_counter() - due_s - cycle[-1].timestamp)
        if should_stop():
            break
    say("ended", cycles=len(late_s), lost=0, late_p99_s=float(np.quantile(late_s, 0.99)))


def _back_to_back(
    cycles: Iterator[Cycle], bus: can.BusABC, should_stop: Callable[[], bool]
) -> None:
    sent = lost = 0
    say("ready")
    for cycle in cycles:
        for message in cycle:
            send(bus, message, should_stop)
        sent += 1
        is_answered = _answered(bus)
        if should_stop():
            break
        lost += not is_answered
    say("ended", cycles=sent, lost=lost, late_p99_s=0.0)


def _answered(bus: can.BusABC) -> bool:
    """Wait for the last prediction of a cycle."""
    give_up_ns = CLOCK() + round(1e9 * ANSWER_S)
    left: int | None = None
    while (wait_ns := give_up_ns - CLOCK()) > 0:
        message = bus.recv(wait_ns / 1e9)
        if message is None:
            continue
        offset = message.arbitration_id - BASE_ID
        if offset == Offset.STATUS:
            row = np.frombuffer(message.data, STATUS, count=1)[0]
            left = int(row["num_objects"]) * int(row["num_modes"])
        elif offset == Offset.STATUS_CLASSIC:
            row = np.frombuffer(message.data, STATUS_CLASSIC, count=1)[0]
            left = int(row["num_objects"]) * len(CLASSIC_TIMES_S)
        elif left is not None and offset in (Offset.TRAJECTORY, Offset.POINT_CLASSIC):
            left -= 1
        if left == 0 and offset != Offset.STATUS_CLASSIC:
            return True
    return False


if __name__ == "__main__":
    sys.exit(main())
