"""What the processes of a service benchmark are told, as one argument of JSON, and what they say.

Each prints lines of JSON, one for every thing that has happened; `say` writes one.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from eqrt.runtime.bench.json_form import parse
from eqrt.runtime.signals import until_told_to_stop

Order = TypeVar("Order")


@dataclass(frozen=True, slots=True, kw_only=True)
class BusOrder:
    """Which bus."""

    channel: str
    interface: str | None
    """python-can's name; None = socketcan."""
    fd: bool | None
    """None = CAN FD if the channel can."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficOrder:
    """Of the process that sends."""

    bus: BusOrder
    cores: tuple[int, ...]
    objects: int
    """Without a log."""
    period_s: float | None
    """Between cycles; None = the next one when the one before has been answered."""
    log: str | None
    """A recorded log instead, on its own clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceOrder:
    """Of the process that is measured."""

    bus: BusOrder
    cores: tuple[int, ...]
    profile: str
    model: str
    tile: str | None
    stationary: bool
    threads: int
    seconds: float
    """To measure, after the warm-up."""
    expected: int
    """About how many cycles that will be."""
    answered_clock: bool
    """Time goes on by a model step with every answer: for traffic that waits for them."""
    rows: str
    """The file for every sample, written at the end (numpy's npy)."""


def read_order(kind: type[Order]) -> Order:
    """The order of this process; it stays on its cores from here on."""
    order = parse(kind, json.loads(sys.argv[1]))
    os.sched_setaffinity(0, order.cores)  # type: ignore[attr-defined] # every order has them
    return order


@contextlib.contextmanager
def while_wanted() -> Iterator[Callable[[], bool]]:
    """Gives `should_stop()`: true when told to, or when nobody is left who could."""
    parent = os.getppid()
    with until_told_to_stop() as is_told:
        yield lambda: is_told() or os.getppid() != parent


def written(order: Any) -> str:
    """An order as the argument of a process."""
    return json.dumps(asdict(order))


def say(event: str, **values: Any) -> None:
    """Tell the process that gave the order."""
    print(json.dumps({"event": event, **values}), flush=True)
