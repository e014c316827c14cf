"""What the pipeline was told, one step after the other: all that decides its predictions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import can
import msgspec

MAX_TIME_S = 1e12
"""Beyond it, as NaN is, it is no time; 30,000 years."""


Time = Annotated[float, msgspec.Meta(ge=-MAX_TIME_S, le=MAX_TIME_S)]
"""Seconds of any clock."""


class CanEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    """A message on its topic: one msgpack map, keys at their default left out."""

    now_s: Time
    """The pipeline's clock when the message was given to it."""
    stamp_s: float
    """The driver's stamp, most often wall-clock time; whatever it says."""
    id: Annotated[int, msgspec.Meta(ge=0, le=0x1FFF_FFFF)]
    data: Annotated[bytes, msgspec.Meta(max_length=64)] = b""
    channel: str | int | None = None
    extended: bool = False
    remote: bool = False
    error: bool = False
    fd: bool = False
    sent: bool = False
    """By this machine, not received."""
    bitrate_switch: bool = False
    error_state: bool = False
    length: Annotated[int, msgspec.Meta(ge=-1, le=64)] = -1
    """What a remote frame asks for; else that of `data`."""


class PollEntry(msgspec.Struct, frozen=True):
    """A moment without a message."""

    now_s: Time


class Lost(msgspec.Struct, frozen=True, kw_only=True):
    """What is missing at this place of the recording."""

    steps: Annotated[int, msgspec.Meta(ge=0)]
    """Messages and moments."""
    forecasts: Annotated[int, msgspec.Meta(ge=0)]
    statuses: Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the pipeline: `poll(now_s)`, then, if there is a message, `feed`."""

    now_s: float
    message: can.Message | None
    clock_s: tuple[float, ...] = ()
    """What its clock said meanwhile, in the order in which it was asked."""
    outcomes: tuple[int, ...] = ()
    """What became of the model's runs (`runs.Outcome`); empty = all were answered."""


def can_entry(message: can.Message, now_s: float) -> CanEntry:
    """A message, ready to be written."""
    return CanEntry(
        now_s,
        message.timestamp,
        message.arbitration_id,
        bytes(message.data),
        _name(message.channel),
        message.is_extended_id,
        message.is_remote_frame,
        message.is_error_frame,
        message.is_fd,
        not message.is_rx,
        message.bitrate_switch,
        message.error_state_indicator,
        message.dlc if message.is_remote_frame else -1,
    )


def _name(channel: can.typechecking.Channel | None) -> str | int | None:
    return channel if channel is None or isinstance(channel, str | int) else str(channel)


def can_message(entry: CanEntry) -> can.Message:
    """The message, as it was received."""
    return can.Message(
        timestamp=entry.stamp_s,
        arbitration_id=entry.id,
        is_extended_id=entry.extended,
        is_remote_frame=entry.remote,
        is_error_frame=entry.error,
        channel=entry.channel,
        dlc=len(entry.data) if entry.length < 0 else entry.length,
        data=entry.data,
        is_fd=entry.fd,
        is_rx=not entry.sent,
        bitrate_switch=entry.bitrate_switch,
        error_state_indicator=entry.error_state,
    )


class TapedClock:
    """A clock that keeps what it said, so that a replay can be told the same."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._said_s: list[float] = []

    def __call__(self) -> float:
        """The time, in seconds."""
        now_s = self._clock()
        self._said_s.append(now_s)
        return now_s

    def take(self) -> list[float]:
        """What it said since it was last asked for this."""
        said_s, self._said_s = self._said_s, []
        return said_s


class ReplayedClock:
    """Says what a recorded clock said in the same step, and what became of the model's runs.

    Asked more often than then (another model may ask more often), it stays at its last answer:
    from there on, no time passes.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._coming_s: list[float] = []
        self._outcomes: list[int] = []

    def begin(self, step: Step) -> None:
        """The pipeline is about to be told this."""
        self._now_s = step.now_s
        self._coming_s = list(reversed(step.clock_s))
        self._outcomes = list(reversed(step.outcomes))

    def outcome(self) -> int:
        """What became of the model's next run in this step (`runs.Outcome`)."""
        return self._outcomes.pop() if self._outcomes else 0

    def __call__(self) -> float:
        """The time, in seconds."""
        if self._coming_s:
            self._now_s = self._coming_s.pop()
        return self._now_s
