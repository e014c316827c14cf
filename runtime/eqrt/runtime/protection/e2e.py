"""AUTOSAR end-to-end protection, profiles 5 and 2: what is sent is protected, what comes checked.

From the "E2E Protocol Specification" (AUTOSAR Foundation, document 849). A message begins with a
check over the rest of it and over a *data id*, which is not sent: both sides know it, so a message
that was taken for another one fails. A counter shows what was lost, repeated or held back.

    protection = Profile5(data_id=0x06E1)
    checker = Checker(protection)
    if checker.check(message.data).is_usable: ...
"""

from __future__ import annotations

import binascii
from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.protection.crc import crc8_h2f, crc8_h2f_rows, crc16
from eqrt.runtime.protection.sequence import Sequence, Status

Bytes = bytes | bytearray


class Protection(Protocol):
    """A profile with the configuration of one message."""

    @property
    def modulus(self) -> int:
        """The counter goes from 0 to `modulus` - 1."""

    def protect(self, data: bytearray, counter: int) -> None:
        """Write counter (modulo `modulus`) and check into the message, which is final otherwise."""

    def counter(self, data: Bytes) -> int | None:
        """The message's counter; None if it does not carry the check that belongs to it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile5:
    """CRC-16 (little endian), then a counter of eight bits, `offset` bytes into the message.

    The check covers what is before the header, the counter, what is behind it, then the data id,
    its low byte first.
    """

    data_id: int
    """0 to 65535."""
    offset: int = 0
    """Bytes, where AUTOSAR's configuration counts bits."""

    @property
    def modulus(self) -> int:
        """The counter goes from 0 to `modulus` - 1."""
        return 256

    def protect(self, data: bytearray, counter: int) -> None:
        """Write counter (modulo 256) and check into the message, which is final otherwise."""
        at = self.offset
        data[at + 2] = counter & 0xFF
        data[at : at + 2] = self._crc(data).to_bytes(2, "little")

    def counter(self, data: Bytes) -> int | None:
        """The message's counter; None if it does not carry the check that belongs to it."""
        at = self.offset
        if len(data) < at + 3 or data[at] | data[at + 1] << 8 != self._crc(data):
            return None
        return data[at + 2]

    def _crc(self, data: Bytes) -> int:
        at = self.offset
        covered = b"".join((data[:at], data[at + 2 :], self.data_id.to_bytes(2, "little")))
        return crc16(covered)


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile2:
    """CRC-8-H2F, then a counter in the low half of byte 1, whose high half is free.

    The check covers all from byte 1 on, then one of sixteen data ids: that of the counter.
    Profile 22 is the same on the bus.
    """

    data_ids: bytes
    """Sixteen of them, by counter."""

    @property
    def modulus(self) -> int:
        """The counter goes from 0 to `modulus` - 1."""
        return 16

    def protect(self, data: bytearray, counter: int) -> None:
        """Write counter (modulo 16) and check into the message, which is final otherwise."""
        data[1] = (data[1] & 0xF0) | (counter & 0x0F)
        data[0] = self._crc(data)

    def counter(self, data: Bytes) -> int | None:
        """The message's counter; None if it does not carry the check that belongs to it."""
        if len(data) < 2 or data[0] != self._crc(data):
            return None
        return data[1] & 0x0F

    def _crc(self, data: Bytes) -> int:
        counter = data[1] & 0x0F
        return crc8_h2f(b"".join((data[1:], self.data_ids[counter : counter + 1])))


def data_id_of(arbitration_id: int) -> int:
    """The data id (profile 5) of a message that is given none: the low 16 bits of its id."""
    return arbitration_id & 0xFFFF


def data_ids_of(arbitration_id: int) -> bytes:
    """The data ids (profile 2) of a message that is given none, by counter.

    The low byte of the message's id, plus 16 times the counter: two messages whose ids differ by
    less than 16 never have the same one.
    """
    return bytes((arbitration_id + 16 * counter) & 0xFF for counter in range(16))


def crc_p5_rows(rows: NDArray[np.uint8], data_id: int) -> NDArray[np.uint16]:
    """(M,) checks of profile 5 for the messages (M, W), header first, counters set.

    A loop around C: faster for 64 bytes than any lookup over all rows at once.
    """
    width, tail = rows.shape[1], data_id.to_bytes(2, "little")
    payload = memoryview(rows.tobytes())
    checks = [
        binascii.crc_hqx(tail, binascii.crc_hqx(payload[start + 2 : start + width], 0xFFFF))
        for start in range(0, len(payload), width)
    ]
    return np.array(checks, np.uint16)


def crc_p2_rows(rows: NDArray[np.uint8], data_ids: bytes) -> NDArray[np.uint8]:
    """(M,) checks of profile 2 for the messages (M, W), counters set."""
    covered = np.empty_like(rows)  # all but the check, and the data id behind it
    covered[:, :-1] = rows[:, 1:]
    covered[:, -1] = np.frombuffer(data_ids, np.uint8)[rows[:, 1] & 0x0F]
    return crc8_h2f_rows(covered)


class Checker:
    """Checks the messages of one id, in the order in which they come."""

    def __init__(self, protection: Protection, *, max_delta: int | None = None) -> None:
        """`max_delta`: AUTOSAR's MaxDeltaCounter; None = less than half the counter's range."""
        self._protection = protection
        self._sequence = Sequence(protection.modulus, max_delta=max_delta)

    def check(self, data: Bytes) -> Status:
        """What has become of this message on its way, or of those before it."""
        counter = self._protection.counter(data)
        if counter is None:
            self._sequence.skip()
            return Status.ERROR
        return self._sequence.follow(counter)


class Sender:
    """Protects the messages of one id, and counts them."""

    def __init__(self, protection: Protection, *, first: int = 0) -> None:
        """`first`: counter of the first message."""
        self._protection = protection
        self._counter = first

    def protect(self, data: SequenceOf[int]) -> bytes:
        """The message with counter and check in their place, whatever stood there."""
        protected = bytearray(data)
        self._protection.protect(protected, self._counter)
        self._counter = (self._counter + 1) % self._protection.modulus
        return bytes(protected)
