"""Whether messages with a counter come in order; the words are those of AUTOSAR E2E."""

from __future__ import annotations

import math
from enum import Enum


class Status(Enum):
    """How a message came, by its checksum and its counter."""

    OK = "ok"
    SOME_LOST = "some lost"
    """As it was sent, but messages before it did not come."""
    REPEATED = "repeated"
    """The same counter again: a message that came before, or a sender that hangs."""
    WRONG_SEQUENCE = "wrong sequence"
    """Older than what has come, or after so many lost ones that nobody can tell."""
    ERROR = "error"
    """Not as it was sent, or sent by somebody else: the checksum is that of other bytes."""

    @property
    def is_usable(self) -> bool:
        """Whether what is in the message is new and as it was sent."""
        return self is Status.OK or self is Status.SOME_LOST

    @property
    def is_stale(self) -> bool:
        """Whether the message is as it was sent, but not new."""
        return self is Status.REPEATED or self is Status.WRONG_SEQUENCE


class Sequence:
    """The counter of one kind of message: one more in every message, 0 after the last."""

    def __init__(
        self, modulus: int, *, max_delta: int | None = None, silence_s: float = math.inf
    ) -> None:
        """The counter goes from 0 to `modulus` - 1.

        `max_delta` (AUTOSAR's MaxDeltaCounter): how far it may be from the last one; None = less
        than half its range, beyond which a gap looks like a step back. After more than `silence_s`
        without a message any counter will do: the sender may have started again.
        """
        self._modulus = modulus
        self._max_delta = (modulus - 1) // 2 if max_delta is None else max_delta
        self._silence_s = silence_s
        self._last: int | None = None
        self._last_s = 0.0
        self._damaged = 0

    def follow(self, counter: int, timestamp_s: float = 0.0) -> Status:
        """Take the counter of a message whose checksum was right."""
        last, damaged = self._last, self._damaged
        if not abs(timestamp_s - self._last_s) <= self._silence_s:
            last = None
        self._last, self._last_s, self._damaged = counter, timestamp_s, 0
        if last is None:
            return Status.OK
        delta = (counter - last) % self._modulus
        if delta == 0:
            return Status.REPEATED
        if delta <= 1 + damaged:
            return Status.OK
        return Status.SOME_LOST if delta <= self._max_delta else Status.WRONG_SEQUENCE

    def skip(self) -> None:
        """Take a damaged message: it had a number too, which is not missing in the next one."""
        self._damaged += 1
