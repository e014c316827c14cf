"""Checksums that a sensor or a car puts into its messages."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Literal, Protocol

from eqrt.runtime.protection.e2e import Profile5


class Check(Protocol):
    """What a message must carry to be as it was sent."""

    def holds(self, arbitration_id: int, data: bytes | bytearray) -> bool:
        """Whether the message carries the checksum of the rest of itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checksum:
    """Which bytes of a message hold a checksum, and over what."""

    combine: Callable[[bytes], int]
    """Bytes -> 0..255, or 0..65535 for a checksum of two bytes."""
    byte: int
    """Index of the checksum in the payload; negative counts from its end."""
    size: int = 1
    """Bytes of the checksum."""
    order: Literal["little", "big"] = "little"
    """Of these bytes."""
    covers_id: bool
    """The arbitration id's bytes, high first, go in before the data."""
    covers_length: bool
    """The payload's length goes in before the data (after the id)."""

    def holds(self, arbitration_id: int, data: bytes | bytearray) -> bool:
        """Whether the message carries the checksum of the rest of itself."""
        place = self.byte if self.byte >= 0 else len(data) + self.byte
        end = place + self.size
        if place < 0 or end > len(data):
            return False
        before = _big_endian(arbitration_id) if self.covers_id else b""
        if self.covers_length:
            before += bytes((len(data),))
        stored = data[place] if self.size == 1 else int.from_bytes(data[place:end], self.order)
        return self.combine(b"".join((before, data[:place], data[end:]))) == stored


@dataclass(frozen=True, slots=True, kw_only=True)
class E2eCheck:
    """AUTOSAR E2E profile 5 over the bytes that the DBC gives the message."""

    profile: Profile5
    length: int
    """Bytes of the message; what a longer one has behind them is not covered, nor read."""

    def holds(self, arbitration_id: int, data: bytes | bytearray) -> bool:  # noqa: ARG002  # the data id stands for it
        """Whether the message carries the check of the rest of itself and of its data id."""
        return len(data) >= self.length and self.profile.counter(data[: self.length]) is not None


def sum8(data: bytes) -> int:
    """The sum of the bytes, its low eight bits."""
    return sum(data) & 0xFF


def xor8(data: bytes) -> int:
    """All bytes, exclusive or."""
    return reduce(operator.xor, data, 0)


def _big_endian(arbitration_id: int) -> bytes:
    return arbitration_id.to_bytes(2 if arbitration_id <= 0x7FF else 4, "big")
