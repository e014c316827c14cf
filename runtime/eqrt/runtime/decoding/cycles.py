"""Framing: which messages belong to one measurement cycle of a sensor.

The messages of a cycle arrive over some milliseconds; a `Cycle` is all of them. It is closed as
soon as nothing is missing, else by a timeout or by what begins the next one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from eqrt.runtime.decoding.dbc_tables import Payload
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.decoding.sensor_profile import Part, SensorProfile
from eqrt.runtime.protection.sequence import Status

_OK = Status.OK  # a member's name is looked up slowly, and every message needs it
_PATIENCE = 3
"""Cycles without any message of an optional part, after which it is not waited for any more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """The messages of one closed cycle."""

    payloads: Sequence[Sequence[Payload]]
    """By part: counted framing in order of arrival, else one per slot, empty where none came."""
    header: Payload | None
    count: int | None
    """Objects in the cycle as the header says; None if it does not say."""
    first_s: float
    """Arrival of the first message."""
    last_s: float
    complete: bool
    header_right: bool = True
    """The header was neither damaged nor the first one after lost ones; True without a header."""
    num_messages: int = 0
    """Messages of objects that came."""
    num_wrong: int = 0
    """Of those: damaged, out of sequence, or the first one after lost ones."""

    def is_right(self, num_foreign: int) -> bool:
        """Whether header and most messages are; `num_foreign` more turned out to be wrong."""
        wrong = self.num_wrong + num_foreign
        return self.header_right and (not wrong or 2 * wrong < self.num_messages)


def framing_of(sensor: SensorProfile, counters: DecoderCounters) -> Framing:
    """The framing that the sensor's profile asks for."""
    kind = CountedFraming if sensor.framing == "counted" else SlotFraming
    return kind(sensor, counters)


class Framing(ABC):
    """Gathers one sensor's messages, and gives the cycles that each arrival closes."""

    def __init__(self, sensor: SensorProfile, counters: DecoderCounters) -> None:
        self._sensor = sensor
        self._counters = counters
        self._awaits = [True] * len(sensor.parts)
        self._absences = [0] * len(sensor.parts)
        self._begin(None, None, 0.0)
        self._is_open = False

    @abstractmethod
    def add(
        self, part: int, slot: int, data: Payload, timestamp_s: float, status: Status
    ) -> tuple[Cycle, ...]:
        """Take a message of an object; `slot` counts from 0. What is not usable has no data."""

    @property
    def is_open(self) -> bool:
        """Whether more messages are awaited."""
        return self._is_open

    def blame_header(self) -> bool:
        """The header of the open cycle came again; False = no cycle is open."""
        self._header_right = False
        return self._is_open

    def open(self, data: Payload, timestamp_s: float, status: Status) -> tuple[Cycle, ...]:
        """Take a header: it ends the cycle before, and begins one if its count can be read."""
        closed = self._close(complete=False)
        header, count = self._sensor.header, None
        if header is not None and header.count is not None:
            number = header.count.read(data)
            if not 0.0 <= number < math.inf:  # not there (NaN), or nonsense
                self._counters.stray += 1
                return closed
            count = int(number)
        self._begin(data, count, timestamp_s)
        self._header_right = status is _OK
        return closed if self._missing else closed + self._close(complete=True)

    def expire(self, now_s: float) -> tuple[Cycle, ...]:
        """Close a cycle that has waited too long, or one from before the clock was set back.

        That is `timeout_s` after its last message, because the more objects there are, the longer
        a cycle takes; and `silence_s` after its first one, because the sensor is silent then.
        """
        sensor = self._sensor
        if not self._is_open or (
            -sensor.timeout_s <= now_s - self._last_s <= sensor.timeout_s
            and -sensor.silence_s <= now_s - self._first_s <= sensor.silence_s
        ):
            return ()
        return self._close(complete=False)

    @abstractmethod
    def _needed(self, part: Part) -> int:
        """Messages of a part that the cycle has when it is complete."""

    @abstractmethod
    def _blank(self) -> list[Payload | None]:
        """The payloads of one part before any has come."""

    @property
    def _num_messages(self) -> int | None:
        """How many messages of one part the announced objects come in."""
        if self._count is None:
            return None
        return -(-self._count // self._sensor.objects_per_message)

    def _begin(self, header: Payload | None, count: int | None, timestamp_s: float) -> None:
        self._is_open = self._header_right = True
        self._num_wrong = self._num_stale = 0
        self._header, self._count = header, count
        self._first_s = self._last_s = timestamp_s
        self._payloads = [self._blank() for _ in self._sensor.parts]
        counts = [self._needed(part) for part in self._sensor.parts]
        self._most = counts
        self._awaited = [
            count if awaits else 0 for count, awaits in zip(counts, self._awaits, strict=True)
        ]
        self._missing = sum(self._awaited)

    def _close(self, *, complete: bool) -> tuple[Cycle, ...]:
        if not self._is_open:
            return ()
        self._is_open = False
        came = [sum(data is not None for data in part) for part in self._payloads]
        self._learn(came)
        cycle = Cycle(
            payloads=[[data or b"" for data in part] for part in self._payloads],
            header=self._header,
            count=self._count,
            first_s=self._first_s,
            last_s=self._last_s,
            complete=complete,
            header_right=self._header_right,
            num_messages=sum(came) + self._num_stale,
            num_wrong=self._num_wrong,
        )
        return (cycle,)

    def _learn(self, came: Sequence[int]) -> None:
        """Which optional messages this sensor sends at all: some are sent only if configured."""
        if not came[0] or came[0] < self._most[0]:
            return  # empty, or cut off: tells nothing
        for i, part in enumerate(self._sensor.parts):
            if part.optional:
                self._absences[i] = 0 if came[i] else self._absences[i] + 1
                self._awaits[i] = self._absences[i] < _PATIENCE

    def _stray(self, part: int) -> None:
        self._counters.stray += 1
        if not self._awaits[part]:  # it is sent after all, behind the messages we waited for
            self._awaits[part], self._absences[part] = True, 0


class CountedFraming(Framing):
    """A header with the number of objects, then their messages, part after part or mixed."""

    def add(
        self,
        part: int,
        slot: int,  # noqa: ARG002  # there are no slots
        data: Payload,
        timestamp_s: float,
        status: Status,
    ) -> tuple[Cycle, ...]:
        """Take a message of an object."""
        late = self.expire(timestamp_s)
        if status is not _OK and self._is_stale(status):
            return late
        if not self._is_open or len(self._payloads[part]) >= self._most[part]:
            self._stray(part)
            return late
        self._num_wrong += status is not _OK
        self._payloads[part].append(data)
        self._last_s = timestamp_s
        if self._awaited[part]:
            self._missing -= 1
        return late if self._missing else late + self._close(complete=True)

    def _is_stale(self, status: Status) -> bool:
        """Whether a message stands for no object of the cycle, because it is not new."""
        if not status.is_stale:
            return False
        self._num_wrong += 1
        self._num_stale += 1
        return True

    def _needed(self, part: Part) -> int:
        return part.per_cycle if part.per_cycle is not None else self._num_messages or 0

    def _blank(self) -> list[Payload | None]:
        return []


class SlotFraming(Framing):
    """One message id per slot and part; a slot that comes twice begins the next cycle.

    With a header, only a header begins a cycle; without, any message of the parts that the one
    before waited for. `single` framing is that of one slot.
    """

    def add(
        self, part: int, slot: int, data: Payload, timestamp_s: float, status: Status
    ) -> tuple[Cycle, ...]:
        """Take a message of a slot."""
        closed = self.expire(timestamp_s)
        if status is not _OK and self._is_repeat(part, slot, status):
            self._num_wrong += 1
            self._num_stale += 1
            return closed
        if self._is_open and self._payloads[part][slot] is not None:
            closed = self._close(complete=False)
        if not self._is_open:
            if self._sensor.header is not None or not self._awaited[part]:
                self._stray(part)
                return closed
            self._begin(None, None, timestamp_s)
        self._payloads[part][slot] = data
        self._last_s = timestamp_s
        self._num_wrong += status is not _OK
        if slot < self._awaited[part]:
            self._missing -= 1
        return closed if self._missing else closed + self._close(complete=True)

    def _is_repeat(self, part: int, slot: int, status: Status) -> bool:
        """Whether the slot's message of the open cycle has come before."""
        return status.is_stale and self._is_open and self._payloads[part][slot] is not None

    def _needed(self, part: Part) -> int:  # noqa: ARG002  # all parts have the same slots
        slots = len(self._sensor.slots)
        return slots if self._num_messages is None else min(self._num_messages, slots)

    def _blank(self) -> list[Payload | None]:
        return [None] * len(self._sensor.slots)
