"""How a channel is: what the service knows of it, and what a controller's error frames tell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import can

_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100  # CAN_ERR_CRTL, ..., classes in the id
_CONTROLLER_FULL = 0x01  # CAN_ERR_CRTL_RX_OVERFLOW, in byte 1 of the data
_PASSIVE = 0x10 | 0x20  # CAN_ERR_CRTL_RX_PASSIVE, ..._TX_PASSIVE
_BETTER = 0x04 | 0x08 | 0x40  # ..._RX_WARNING, ..._TX_WARNING, ..._ACTIVE


class BusState(Enum):
    """What a channel can be used for."""

    UP = "up"
    ERROR_PASSIVE = "error passive"
    """Messages go both ways, but the controller has seen many errors."""
    BUS_OFF = "bus-off"
    """The controller has stopped because of errors, until it is restarted."""
    DOWN = "down"
    """Switched off, unplugged, or not there yet."""


LOST = (BusState.DOWN, BusState.BUS_OFF)
"""States in which nothing is heard."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusWord:
    """What is said at once, when a channel is lost or back."""

    channel: str
    state: BusState
    text: str

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, slots=True, kw_only=True)
class BusHealth:
    """One channel, from the start of the service until now."""

    channel: str
    state: BusState
    since_s: float
    """On the monotonic clock."""
    reason: str
    """Why it is not up; "" while it is."""
    losses: int
    """How often it went down or away."""
    reconnects: int
    """How often it came back, or came after it was waited for."""
    bus_offs: int
    error_frames: int
    dropped: int | None
    """Messages that found the kernel's receive queue full; None = the adapter does not tell."""
    overruns: int
    """How often the controller said that it had lost messages itself."""


def told_state(error: can.Message) -> BusState | None:
    """What an error frame says of the state of the controller; None = nothing.

    Classes and bits are those of the kernel's linux/can/error.h.
    """
    told = error.arbitration_id
    if told & _BUS_OFF:
        return BusState.BUS_OFF
    if told & _RESTARTED:
        return BusState.UP
    if told & _CONTROLLER and len(error.data) > 1:
        if error.data[1] & _PASSIVE:
            return BusState.ERROR_PASSIVE
        if error.data[1] & _BETTER:
            return BusState.UP
    return None


def told_overrun(error: can.Message) -> bool:
    """Whether an error frame says that the controller itself has lost messages."""
    is_controller = bool(error.arbitration_id & _CONTROLLER) and len(error.data) > 1
    return is_controller and bool(error.data[1] & _CONTROLLER_FULL)


def trouble(before: Sequence[BusHealth], after: Sequence[BusHealth], now_s: float) -> str:
    """What is not as it should be, for one line; "" if nothing. Losses are those in between."""
    parts = []
    for old, new in zip(before, after, strict=True):
        if new.state is not BusState.UP:
            parts.append(f"{new.channel} {new.state.value} for {now_s - new.since_s:.0f} s")
        if lost := (new.dropped or 0) - (old.dropped or 0):
            parts.append(f"{new.channel}: {lost} messages lost, receive queue full")
        if overruns := new.overruns - old.overruns:
            parts.append(f"{new.channel}: controller overrun ({overruns}x)")
    return "; ".join(parts)


def in_sum(channels: Iterable[BusHealth]) -> str:
    """What was not as it should be, over a whole run; "" if nothing."""
    parts = []
    for one in channels:
        counts = {
            "lost {}x": one.losses,
            "bus-off {}x": one.bus_offs,
            "{} error frames": one.error_frames,
            "{} messages lost to a full receive queue": one.dropped or 0,
            "controller overrun {}x": one.overruns,
        }
        if told := [text.format(count) for text, count in counts.items() if count]:
            parts.append(f"{one.channel}: {', '.join(told)}")
    return "; ".join(parts)
