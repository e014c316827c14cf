"""Checksums: against the published check value of each, and against recorded messages."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from eqrt.runtime.decoding.checksums import Checksum, sum8, xor8
from eqrt.runtime.protection.crc import crc_of

Combine = Callable[[bytes], int]


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


@pytest.mark.parametrize("byte", [0, -3])
def test_the_first_byte_may_be_the_checksum(byte: int) -> None:
    checksum = Checksum(combine=sum8, byte=byte, covers_id=False, covers_length=False)
    assert checksum.holds(0, bytes([7, 3, 4]))
    assert not checksum.holds(0, bytes([8, 3, 4]))


@pytest.mark.parametrize("byte", [3, -4])
def test_a_checksum_just_outside_the_message_does_not_hold(byte: int) -> None:
    checksum = Checksum(combine=sum8, byte=byte, covers_id=False, covers_length=False)
    assert not checksum.holds(0, bytes(3))


@pytest.mark.parametrize(
    ("arbitration_id", "covered"),
    [
        (0x0B4, b"\x00\xb4"),
        (0x7FF, b"\x07\xff"),
        (0x800, b"\x00\x00\x08\x00"),
        (0x18DAF110, b"\x18\xda\xf1\x10"),
    ],
)
def test_an_id_goes_in_high_byte_first_and_before_the_length(
    arbitration_id: int, covered: bytes
) -> None:
    """A CRC tells the order, where a sum does not."""
    combine = crc_of(8, 0x1D, 0xFF, 0xFF)
    checksum = Checksum(combine=combine, byte=-1, covers_id=True, covers_length=True)
    good = combine(covered + bytes([4]) + b"abc")
    assert checksum.holds(arbitration_id, b"abc" + bytes([good]))
    assert not checksum.holds(arbitration_id, b"abc" + bytes([good ^ 1]))


@pytest.mark.parametrize("combine", [sum8, xor8])
def test_a_message_of_nothing_but_its_checksum_holds_if_that_is_zero(combine: Combine) -> None:
    checksum = Checksum(combine=combine, byte=0, covers_id=False, covers_length=False)
    assert checksum.holds(0x123, b"\0")  # whatever the id is
    assert not checksum.holds(0x123, b"\1")
