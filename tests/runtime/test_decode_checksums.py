"""Checksums: against the published check value of each, and against recorded messages."""

from __future__ import annotations

import pytest

from eqrt.runtime.decoding.checksums import Checksum, sum8, xor8
from eqrt.runtime.protection.crc import crc_of


@pytest.mark.parametrize(
    ("start", "polynomial", "final_xor", "check"),
    [
        (0xFF, 0x1D, 0xFF, 0x4B),  # SAE J1850
        (0xFF, 0x2F, 0xFF, 0xDF),  # AUTOSAR
        (0x00, 0x07, 0x00, 0xF4),  # SMBus
    ],
)
def test_crc8_of_the_nine_digits_is_as_published(
    start: int, polynomial: int, final_xor: int, check: int
) -> None:
    assert crc_of(8, polynomial, start, final_xor)(b"123456789") == check


def test_sum8_and_xor8_by_hand() -> None:
    assert sum8(bytes([200, 100, 1])) == 45
    assert xor8(bytes([0b1100, 0b1010])) == 0b0110


def test_a_recorded_message_of_the_toyota_holds_and_one_flipped_bit_does_not() -> None:
    checksum = Checksum(combine=sum8, byte=-1, covers_id=True, covers_length=True)
    speed = bytes.fromhex("000000001D0B7A5E")  # 0x0B4, recorded
    assert checksum.holds(0x0B4, speed)
    for bit in range(64):
        damaged = (int.from_bytes(speed, "big") ^ (1 << bit)).to_bytes(8, "big")
        assert not checksum.holds(0x0B4, damaged)


def test_a_checksum_may_lie_anywhere() -> None:
    checksum = Checksum(combine=xor8, byte=1, covers_id=False, covers_length=False)
    assert checksum.holds(0, bytes([3, 3 ^ 5, 5]))


@pytest.mark.parametrize("data", [b"", b"\x00"])
def test_a_message_too_short_for_its_checksum_does_not_hold(data: bytes) -> None:
    checksum = Checksum(combine=sum8, byte=3, covers_id=False, covers_length=False)
    assert not checksum.holds(0x123, data)
