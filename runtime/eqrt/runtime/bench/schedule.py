"""When runs start: one after the other, or at fixed times as in the car.

Deadlines are absolute: the time that a run takes does not add up. Whoever is late by more than a
whole period leaves out the ticks that have passed, as a cycle that is over is of no use in a car.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

Clock = Callable[[], int]
"""Nanoseconds that only go forward."""


@dataclass(frozen=True, slots=True)
class Turn:
    """One run that is to be made now."""

    number: int
    """Periodic: of the tick; numbers that are left out are ticks that were missed altogether."""
    due_ns: int
    """Back-to-back: when it started."""
    started_ns: int
    waited: bool
    """Whether there was time left to wait for the tick: then being late is the wake-up's doing."""


def back_to_back(seconds: float, clock: Clock) -> Iterator[Turn]:
    """One turn after the other, for so long."""
    end_ns = clock() + round(1e9 * seconds)
    number = 0
    while (now_ns := clock()) < end_ns:
        yield Turn(number, now_ns, now_ns, waited=False)
        number += 1


def periodic(
    rate_hz: float,
    seconds: float,
    clock: Clock,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Turn]:
    """A turn every 1 / rate_hz seconds for so long, the first one period from now.

    `sleep` is given seconds and may wake early: the deadline is looked at again.
    """
    period_ns = round(1e9 / rate_hz)
    start_ns = clock() + period_ns
    number, ticks = 0, ticks_in(rate_hz, seconds)
    while number < ticks:
        due_ns = start_ns + number * period_ns
        waited = clock() < due_ns
        while (left_ns := due_ns - clock()) > 0:
            sleep(left_ns / 1e9)
        yield Turn(number, due_ns, clock(), waited)
        number = max(number + 1, (clock() - start_ns) // period_ns)


def ticks_in(rate_hz: float, seconds: float) -> int:
    """How many ticks a periodic schedule has."""
    return max(1, round(rate_hz * seconds))


CLOCK: Clock = time.perf_counter_ns
"""What everything here is measured with: CLOCK_MONOTONIC on Linux, the same in all processes."""
