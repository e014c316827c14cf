"""AUTOSAR E2E: against another implementation, the standard's examples, and every kind of fault."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from e2e import p02, p05
from hypothesis import given
from hypothesis import strategies as st

from eqrt.runtime.protection.crc import crc8_h2f, crc16, crc_of
from eqrt.runtime.protection.e2e import (
    Checker,
    Profile2,
    Profile5,
    Protection,
    Sender,
    crc_p2_rows,
    crc_p5_rows,
    data_id_of,
    data_ids_of,
)
from eqrt.runtime.protection.sequence import Sequence, Status

DIGITS = b"123456789"
P5 = Profile5(data_id=0x06E1)
P2 = Profile2(data_ids=data_ids_of(0x6E4))
PROTECTIONS: tuple[tuple[Protection, int], ...] = ((P5, 64), (P2, 8))


def messages_of(protection: Protection, length: int, count: int) -> list[bytes]:
    """Protected messages with a content that differs from one to the next."""
    sender = Sender(protection)
    return [sender.protect(bytes((7 * i + k) & 0xFF for k in range(length))) for i in range(count)]


# The published check values of the three.
def test_checks_of_the_nine_digits_are_as_published() -> None:
    assert crc16(DIGITS) == 0x29B1
    assert crc8_h2f(DIGITS) == 0xDF
    assert crc_of(16, 0x1021, 0xFFFF, 0)(DIGITS) == 0x29B1
    assert crc_of(16, 0x8005, 0xFFFF, 0)(DIGITS) == 0xAEE7  # CMS: no table of the library's


# The examples of the standard: data id 0x1234, counter 0, all user data 0.
@pytest.mark.parametrize(
    ("offset", "length", "expected"),
    [(0, 8, "1cca000000000000"), (8, 16, "00000000000000002891000000000000")],
)
def test_profile_5_protects_as_in_the_standard(offset: int, length: int, expected: str) -> None:
    data = bytearray(length)
    Profile5(data_id=0x1234, offset=offset).protect(data, 0)
    assert data.hex() == expected


def test_profile_2_protects_as_in_the_standard() -> None:
    """Counter 1, data ids 1, 2, ... 16."""
    data = bytearray(8)
    Profile2(data_ids=bytes(range(1, 17))).protect(data, 1)
    assert data.hex() == "1b01000000000000"


@given(
    data=st.binary(min_size=3, max_size=64),
    data_id=st.integers(0, 0xFFFF),
    counter=st.integers(0, 1000),
    place=st.floats(0, 1),
)
def test_profile_5_is_that_of_another_implementation(
    data: bytes, data_id: int, counter: int, place: float
) -> None:
    offset = round(place * (len(data) - 3))
    ours, theirs = bytearray(data), bytearray(data)
    protection = Profile5(data_id=data_id, offset=offset)
    protection.protect(ours, counter)
    theirs[offset + 2] = counter & 0xFF
    p05.e2e_p05_protect(theirs, data_id, offset=offset, increment_counter=False)
    assert ours == theirs
    assert protection.counter(ours) == counter & 0xFF
    assert (protection.counter(data) is not None) == p05.e2e_p05_check(
        bytearray(data), data_id, offset=offset
    )


@given(
    data=st.binary(min_size=2, max_size=32),
    data_ids=st.binary(min_size=16, max_size=16),
    counter=st.integers(0, 100),
)
def test_profile_2_is_that_of_another_implementation(
    data: bytes, data_ids: bytes, counter: int
) -> None:
    ours, theirs = bytearray(data), bytearray(data)
    protection = Profile2(data_ids=data_ids)
    protection.protect(ours, counter)
    theirs[1] = theirs[1] & 0xF0 | counter & 0x0F
    p02.e2e_p02_protect(theirs, data_ids, increment_counter=False)
    assert ours == theirs
    assert protection.counter(ours) == counter & 0x0F
    assert (protection.counter(data) is not None) == p02.e2e_p02_check(bytearray(data), data_ids)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 40), width=st.integers(3, 64))
def test_many_rows_at_once_have_the_checks_that_each_has(seed: int, count: int, width: int) -> None:
    rows = np.random.default_rng(seed).integers(0, 256, (count, width)).astype(np.uint8)
    data_id, data_ids = seed & 0xFFFF, data_ids_of(seed)
    fives, twos = crc_p5_rows(rows, data_id), crc_p2_rows(rows, data_ids)
    assert fives.dtype == np.uint16
    assert twos.dtype == np.uint8
    for row, five, two in zip(rows, fives, twos, strict=True):
        data = bytearray(row.tobytes())
        Profile5(data_id=data_id).protect(data, data[2])
        assert data[0] | data[1] << 8 == five
        data = bytearray(row.tobytes())
        Profile2(data_ids=data_ids).protect(data, data[1])
        assert data[0] == two


@pytest.mark.parametrize(("protection", "length"), PROTECTIONS)
def test_every_flipped_bit_is_found(protection: Protection, length: int) -> None:
    for data in messages_of(protection, length, 20):
        for bit in range(8 * length):
            damaged = bytearray(data)
            damaged[bit // 8] ^= 1 << bit % 8
            assert Checker(protection).check(damaged) is Status.ERROR


@pytest.mark.parametrize("length", [64, 32, 12, 8])
def test_every_three_flipped_bits_are_found(length: int) -> None:
    """A CRC is linear: what flipped bits do to it is the exclusive or of what each of them does.

    In profile 2 the bits of the counter choose the data id as well, and are left out.
    """
    data = bytearray(length)
    protection = P2 if length == 8 else P5
    protection.protect(data, 0)
    kept = range(8, 12) if protection is P2 else range(0)
    effects = []
    for bit in set(range(8 * length)) - set(kept):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        again = bytearray(flipped)
        protection.protect(again, 0 if protection is P2 else flipped[2])
        size = 1 if protection is P2 else 2
        effects.append(
            int.from_bytes(flipped[:size], "little") ^ int.from_bytes(again[:size], "little")
        )
    one = np.array(effects)
    first, second = np.triu_indices(len(one), 1)
    two = one[first] ^ one[second]
    assert one.all()
    assert two.all()
    assert not np.isin(two, one).any()


@pytest.mark.parametrize(("protection", "length", "width"), [(P5, 64, 16), (P2, 8, 8)])
def test_every_burst_no_longer_than_the_check_is_found(
    protection: Protection, length: int, width: int
) -> None:
    """A burst in the bits as they are sent, the highest of a byte first, behind the check."""
    (data,) = messages_of(protection, length, 1)
    number, behind_bits = int.from_bytes(data, "big"), 8 * length - width
    for shift, burst in itertools.product(range(0, behind_bits - width + 1, 3), (0x81, 0xFF, 0xA5)):
        pattern = burst << (width - 8) | 1
        damaged = (number ^ pattern << shift).to_bytes(length, "big")
        assert Checker(protection).check(damaged) is Status.ERROR


def test_a_flipped_bit_of_a_counter_is_found_with_the_data_ids_of_any_id() -> None:
    """In profile 2 it changes the data id as well; the two must never make up for each other."""
    for low_byte, counter, bit in itertools.product(range(256), range(16), range(4)):
        protection = Profile2(data_ids=data_ids_of(low_byte))
        data = bytearray(8)
        protection.protect(data, counter)
        data[1] ^= 1 << bit
        assert protection.counter(data) is None


@pytest.mark.parametrize(("protection", "length"), PROTECTIONS)
def test_a_message_cut_short_is_found(protection: Protection, length: int) -> None:
    (data,) = messages_of(protection, length, 1)
    for end in range(length):
        assert Checker(protection).check(data[:end]) is Status.ERROR


@pytest.mark.parametrize("base_id", [0x100, 0x6E0, 0x7F8, 0x18FFFFFD])
def test_a_message_taken_for_another_one_is_found(base_id: int) -> None:
    """Every pair of our ids, with every counter."""
    for sent, taken in itertools.permutations(range(base_id, base_id + 6), 2):
        for data in messages_of(Profile5(data_id=data_id_of(sent)), 12, 256):
            assert Checker(Profile5(data_id=data_id_of(taken))).check(data) is Status.ERROR
        for data in messages_of(Profile2(data_ids=data_ids_of(sent)), 8, 16):
            assert Checker(Profile2(data_ids=data_ids_of(taken))).check(data) is Status.ERROR


@pytest.mark.parametrize(("protection", "length"), PROTECTIONS)
@pytest.mark.parametrize("at", range(1, 40))
def test_a_lost_doubled_or_swapped_message_is_found(
    protection: Protection, length: int, at: int
) -> None:
    """Wherever it happens; the messages before and after are as they should be."""
    sent = messages_of(protection, length, 45)
    lost = sent[:at] + sent[at + 1 :]
    doubled = sent[: at + 1] + sent[at:]
    swapped = [*sent[:at], sent[at + 1], sent[at], *sent[at + 2 :]]

    def wrong(messages: list[bytes]) -> dict[int, Status]:
        checker = Checker(protection)
        found = [checker.check(one) for one in messages]
        return {i: status for i, status in enumerate(found) if status is not Status.OK}

    assert wrong(sent) == {}
    assert wrong(lost) == {at: Status.SOME_LOST}
    assert wrong(doubled) == {at + 1: Status.REPEATED}
    assert wrong(swapped) == {
        at: Status.SOME_LOST,
        at + 1: Status.WRONG_SEQUENCE,
        at + 2: Status.SOME_LOST,
    }


@pytest.mark.parametrize("max_delta", [1, 3, 127])
def test_more_lost_messages_than_allowed_are_a_wrong_sequence(max_delta: int) -> None:
    """As AUTOSAR's MaxDeltaCounter; the next message follows the one that came."""
    for delta in range(2, 256):
        sequence = Sequence(256, max_delta=max_delta)
        assert sequence.follow(250) is Status.OK
        expected = Status.SOME_LOST if delta <= max_delta else Status.WRONG_SEQUENCE
        assert sequence.follow((250 + delta) % 256) is expected
        assert sequence.follow((251 + delta) % 256) is Status.OK


def test_a_checker_allows_as_many_lost_messages_as_it_is_told() -> None:
    sent = messages_of(P5, 12, 4)
    for max_delta, expected in ((2, Status.WRONG_SEQUENCE), (3, Status.SOME_LOST)):
        checker = Checker(P5, max_delta=max_delta)
        assert [checker.check(one) for one in (sent[0], sent[3])] == [Status.OK, expected]


@pytest.mark.parametrize("modulus", [4, 15, 16, 256])
def test_less_than_half_the_range_may_be_lost_unless_it_is_said(modulus: int) -> None:
    """Beyond that, a gap and a step back look alike; AUTOSAR's profile 1 counts to fourteen."""
    for delta in range(2, modulus):
        sequence = Sequence(modulus)
        sequence.follow(1)
        expected = Status.SOME_LOST if 2 * delta < modulus else Status.WRONG_SEQUENCE
        assert sequence.follow((1 + delta) % modulus) is expected


def test_a_damaged_message_stands_for_one_lost_one_only() -> None:
    sequence = Sequence(16)
    sequence.follow(3)
    sequence.skip()
    assert sequence.follow(6) is Status.SOME_LOST


def test_a_damaged_message_is_not_missing_in_the_next_one() -> None:
    sent = messages_of(P5, 12, 5)
    checker = Checker(P5)
    damaged = [bytes(12), bytes(12)]
    found = [checker.check(one) for one in (sent[0], *damaged, sent[3], sent[4])]
    assert found == [Status.OK, Status.ERROR, Status.ERROR, Status.OK, Status.OK]


def test_after_silence_any_counter_will_do() -> None:
    sequence = Sequence(16, silence_s=0.5)
    statuses = [sequence.follow(n, at_s) for n, at_s in ((3, 0.0), (9, 0.6), (9, 1.0), (10, -5.0))]
    assert statuses == [Status.OK, Status.OK, Status.REPEATED, Status.OK]


@pytest.mark.parametrize("since_s", [0.5, -0.5])
def test_just_as_long_as_the_limit_is_no_silence(since_s: float) -> None:
    sequence = Sequence(16, silence_s=0.5)
    sequence.follow(3, 1.0)
    assert sequence.follow(3, 1.0 + since_s) is Status.REPEATED


def test_only_new_messages_that_came_as_sent_are_usable() -> None:
    assert [one for one in Status if one.is_usable] == [Status.OK, Status.SOME_LOST]
    assert [one for one in Status if one.is_stale] == [Status.REPEATED, Status.WRONG_SEQUENCE]


def test_data_ids_that_are_not_given_come_from_the_messages_id() -> None:
    """Whoever receives our messages has them from the pages, and must come to the same ones."""
    assert data_id_of(0x18FF06E4) == 0x06E4
    assert data_ids_of(0x6E4).hex() == "e4f404142434445464748494a4b4c4d4"


def test_a_sender_begins_with_zero() -> None:
    assert P5.counter(Sender(P5).protect(bytes(12))) == 0


def test_a_sender_counts_on_from_where_it_is_told() -> None:
    sender = Sender(P2, first=15)
    assert [P2.counter(sender.protect(bytes([0, 0xF0]))) for _ in range(3)] == [15, 0, 1]
    assert sender.protect(bytes([0, 0xF0]))[1] == 0xF0 | 2
