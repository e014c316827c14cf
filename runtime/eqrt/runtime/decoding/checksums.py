"""Checksums that a sensor or a car puts into its messages."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce


@dataclass(frozen=True, slots=True, kw_only=True)
class Checksum:
    """Which byte of a message holds a checksum, and over what."""

    combine: Callable[[bytes], int]
    """Bytes -> 0..255."""
    byte: int
    """Index of the checksum in the payload; negative counts from its end."""
    covers_id: bool
    """The arbitration id's bytes, high first, go in before the data."""
    covers_length: bool
    """The payload's length goes in before the data (after the id)."""

    def holds(self, arbitration_id: int, data: bytes | bytearray) -> bool:
        """Whether the message carries the checksum of the rest of itself."""
        place = self.byte if self.byte >= 0 else len(data) + self.byte
        if not 0 <= place < len(data):
            return False
        before = _big_endian(arbitration_id) if self.covers_id else b""
        if self.covers_length:
            before += bytes((len(data),))
        return self.combine(b"".join((before, data[:place], data[place + 1 :]))) == data[place]


def sum8(data: bytes) -> int:
    """The sum of the bytes, its low eight bits."""
    return sum(data) & 0xFF


def xor8(data: bytes) -> int:
    """All bytes, exclusive or."""
    return reduce(operator.xor, data, 0)


def crc8(polynomial: int, start: int, final_xor: int) -> Callable[[bytes], int]:
    """The cyclic redundancy check of eight bits, most significant bit first."""
    table = _crc8_table(polynomial)

    def combine(data: bytes) -> int:
        crc = start
        for byte in data:
            crc = table[crc ^ byte]
        return crc ^ final_xor

    return combine


@cache
def _crc8_table(polynomial: int) -> bytes:
    table = bytearray()
    for crc in range(256):
        for _ in range(8):
            crc = (crc << 1) ^ (polynomial if crc & 0x80 else 0)  # noqa: PLW2901  # shifted out
            crc &= 0xFF  # noqa: PLW2901
        table.append(crc)
    return bytes(table)


def _big_endian(arbitration_id: int) -> bytes:
    return arbitration_id.to_bytes(2 if arbitration_id <= 0x7FF else 4, "big")
