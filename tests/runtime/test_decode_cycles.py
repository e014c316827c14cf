"""The edges of framing: where a change by one would go unnoticed elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import can
import pytest

from can_recordings import detections_of
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.cycles import Cycle, Framing, framing_of
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.decoding.detections import Detections
from eqrt.runtime.protection.sequence import Status
from tiny_sensor import COUNTED, DBC, SLOTS, decoder_of, first, header, profile_of, second

WITH_HEADER = SLOTS.replace(
    "[sensor.messages]", '[sensor.header]\nmessage = "LIST"\ncount = "COUNT"\n[sensor.messages]'
)


def feed(decoder: Decoder, messages: list[can.Message], at_s: float = 0.0) -> list[Detections]:
    """The cycles that the messages close, fed a millisecond apart."""
    events = []
    for i, one in enumerate(messages):
        events += decoder.feed(one, at_s + 1e-3 * i)
    return detections_of(events)


def slots(*numbers: int) -> list[can.Message]:
    firsts = [first(i + 1, 0, 0, slot=i) for i in numbers]
    return firsts + [second(0, i + 1.0, slot=i) for i in numbers]


def test_a_header_without_a_count_lets_all_slots_come(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, WITH_HEADER.replace('count = "COUNT"\n', ""))
    messages = [header(1), *slots(0, 1, 2, 3)]
    assert feed(decoder, messages[:-1]) == []
    (cycle,) = feed(decoder, messages[-1:], at_s=0.008)
    assert cycle.complete
    assert cycle.object_id.tolist() == [0, 1, 2, 3]


def test_a_slot_beyond_the_headers_count_is_not_one_of_those_awaited(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, WITH_HEADER)
    assert feed(decoder, [header(2), *slots(0, 2, 3)]) == []
    (cycle,) = feed(decoder, slots(1), at_s=0.01)
    assert cycle.complete


def test_a_header_that_counts_more_than_there_are_slots_awaits_them_all(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, WITH_HEADER)
    (cycle,) = feed(decoder, [header(200), *slots(0, 1, 2, 3)])
    assert cycle.complete
    assert cycle.object_id.tolist() == [0, 1, 2, 3]


def test_what_is_not_awaited_any_more_still_belongs_to_the_cycle_it_comes_in(
    tmp_path: Path,
) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    for i in range(3):
        feed(decoder, [header(1, i), first(10, 0, 7, counter=i)], at_s=float(i))
        decoder.poll(i + 0.5)
    (cycle,) = feed(decoder, [header(1, 3), second(7, 4.5), first(10, 0, 7, counter=3)], at_s=3.0)
    assert cycle.complete
    assert cycle.length_m.tolist() == [4.5]


EXACT = COUNTED.replace("timeout_s = 0.1", "timeout_s = 0.125\nsilence_s = 0.1875")
"""Numbers that a float holds exactly."""


@pytest.mark.parametrize("since_s", [0.125, -0.125])
def test_a_cycle_whose_last_message_is_as_old_as_the_timeout_stays_open(
    tmp_path: Path, since_s: float
) -> None:
    decoder = decoder_of(tmp_path, EXACT)
    decoder.feed(header(1), 1.0 - since_s / 4)
    decoder.feed(first(10, 0, 7), 1.0)
    assert decoder.poll(1.0 + since_s) == []
    assert len(decoder.poll(1.0 + since_s * 1.001)) == 1


@pytest.mark.parametrize("since_s", [0.1875, -0.1875])
def test_a_cycle_as_old_as_silence_stays_open_if_its_messages_still_come(
    tmp_path: Path, since_s: float
) -> None:
    decoder = decoder_of(tmp_path, EXACT)
    decoder.feed(header(1), 1.0)
    decoder.feed(first(10, 0, 7), 1.0 + since_s / 2)
    assert decoder.poll(1.0 + since_s) == []
    assert len(decoder.poll(1.0 + since_s * 1.001)) == 1


@pytest.mark.parametrize(("bits", "count"), [(0x7F800000, "infinity"), (0x7FC00000, "NaN")])
def test_a_count_that_is_no_number_is_stray(tmp_path: Path, bits: int, count: str) -> None:
    """In a header whose count is a float, as some DBC may have it."""
    as_float = DBC.replace(
        ' SG_ COUNT : 0|8@1+ (1,0) [0|0] "" R\n', ' SG_ COUNT : 32|32@1- (1,0) [0|0] "" R\n'
    )
    decoder = Decoder(profile_of(tmp_path, COUNTED, f"{as_float}SIG_VALTYPE_ 256 COUNT : 1;\n"))
    opening = header(0)
    opening.data[4:8] = bits.to_bytes(4, "little")
    assert feed(decoder, [opening, first(1, 0, 1)]) == [], count
    assert decoder.counters.stray == 2


def test_a_header_that_cannot_be_read_ends_the_cycle_before(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    short = header(0)
    short.data = short.data[:0]
    (cycle,) = feed(decoder, [header(2), first(1, 0, 1), short])
    assert not cycle.complete
    assert decoder.counters.stray == 1


def test_one_object_more_than_announced_is_stray_and_closes_nothing(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    assert feed(decoder, [header(1), first(1, 0, 1), first(2, 0, 2)]) == []
    assert decoder.counters.stray == 1
    (cycle,) = feed(decoder, [second(1, 4.5)], at_s=0.01)
    assert cycle.length_m.tolist() == [4.5]


@pytest.mark.parametrize("pattern", ["--x--", "-x--", "x--"])
def test_only_absences_in_a_row_count(tmp_path: Path, pattern: str) -> None:
    """After two without it (-) the second message is still waited for, whatever was before."""
    decoder = decoder_of(tmp_path, COUNTED)
    for i, mark in enumerate(pattern):
        seconds = [second(7, 4.5)] if mark == "x" else []
        feed(decoder, [header(1, i), first(10, 0, 7, counter=i), *seconds], at_s=float(i))
        decoder.poll(i + 0.5)
    assert feed(decoder, [header(1, 9), first(10, 0, 7, counter=9)], at_s=9.0) == []


def test_a_late_comer_is_waited_for_as_if_it_had_always_come(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    for i in range(4):
        feed(decoder, [header(1, i), first(10, 0, 7, counter=i)], at_s=float(i))
        decoder.poll(i + 0.5)
    feed(decoder, [second(7, 4.5)], at_s=3.6)
    for i in (4, 5):
        assert feed(decoder, [header(1, i), first(10, 0, 7, counter=i)], at_s=float(i)) == []
        assert len(decoder.poll(i + 0.5)) == 1
    assert feed(decoder, [header(1, 6), first(10, 0, 7, counter=6)], at_s=6.0) == []


@pytest.mark.parametrize("end", ["header", "timeout", "slot"])
def test_a_cycle_that_lacks_something_says_so(tmp_path: Path, end: str) -> None:
    decoder = decoder_of(tmp_path, SLOTS if end == "slot" else COUNTED)
    if end == "slot":
        (cycle,) = feed(decoder, slots(0)[:1] * 2)
    elif end == "header":
        (cycle,) = feed(decoder, [header(1), header(1, 1)])
    else:
        feed(decoder, [header(1)])
        (cycle,) = detections_of(decoder.poll(0.5))
    assert cycle.complete is False


def test_every_header_that_cannot_be_read_is_counted(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    short = header(0)
    short.data = short.data[:0]
    feed(decoder, [short, short, short])
    assert decoder.counters.stray == 3


def test_a_cycle_of_slots_was_received_when_its_last_message_was(tmp_path: Path) -> None:
    (cycle,) = feed(decoder_of(tmp_path, SLOTS), slots(0, 1, 2, 3), at_s=1.0)
    assert (cycle.timestamp_s, cycle.received_s) == (1.0, 1.007)


def framing(folder: Path, text: str) -> Framing:
    return framing_of(profile_of(folder, text).sensors[0], DecoderCounters())


STALE = [Status.REPEATED, Status.WRONG_SEQUENCE]


@pytest.mark.parametrize("stale", [[], STALE[:1], STALE, STALE * 2])
def test_old_messages_count_as_wrong_ones_and_take_no_objects_place(
    tmp_path: Path, stale: list[Status]
) -> None:
    gathering = framing(tmp_path, COUNTED)
    gathering.open(bytes([1, 0, 0, 0]), 0.0, Status.OK)
    for status in (Status.OK, *stale):
        assert gathering.add(0, 0, b"first", 0.0, status) == ()
    (cycle,) = gathering.add(1, 0, b"second", 0.0, Status.OK)
    assert cycle.payloads == [[b"first"], [b"second"]]
    assert (cycle.num_messages, cycle.num_wrong) == (2 + len(stale), len(stale))


@pytest.mark.parametrize("stale", [[], STALE[:1], STALE, STALE * 2])
def test_old_messages_of_a_slot_that_has_come_count_as_wrong_ones(
    tmp_path: Path, stale: list[Status]
) -> None:
    gathering = framing(tmp_path, SLOTS)
    for status in (Status.OK, *stale):
        assert gathering.add(0, 0, b"0", 0.0, status) == ()
    others = [(0, slot) for slot in (1, 2, 3)] + [(1, slot) for slot in range(4)]
    (cycle,) = (one for place in others for one in gathering.add(*place, b"0", 0.0, Status.OK))
    assert cycle.payloads == [[b"0"] * 4] * 2
    assert (cycle.num_messages, cycle.num_wrong) == (8 + len(stale), len(stale))


@pytest.mark.parametrize("text", [COUNTED, SLOTS])
@pytest.mark.parametrize("stale", STALE)
def test_old_messages_do_not_keep_a_cycle_open(tmp_path: Path, stale: Status, text: str) -> None:
    gathering = framing(tmp_path, text)
    if text is COUNTED:
        gathering.open(bytes([1, 0, 0, 0]), 0.0, Status.OK)
    assert gathering.add(0, 0, b"first", 0.0, Status.OK) == ()
    assert gathering.add(0, 0, b"first", 0.09, stale) == ()
    (cycle,) = gathering.expire(0.11)
    assert cycle.last_s == 0.0


@pytest.mark.parametrize("status", [Status.ERROR, Status.SOME_LOST])
@pytest.mark.parametrize("text", [COUNTED, SLOTS])
def test_damaged_messages_and_those_after_lost_ones_are_wrong_in_their_place(
    tmp_path: Path, text: str, status: Status
) -> None:
    gathering = framing(tmp_path, text)
    num_objects = 1 if text is COUNTED else 4
    if text is COUNTED:
        gathering.open(bytes([1, 0, 0, 0]), 0.0, Status.OK)
    places = [(part, slot) for part in range(2) for slot in range(num_objects)]
    (cycle,) = (one for place in places for one in gathering.add(*place, b"", 0.0, status))
    assert cycle.num_messages == cycle.num_wrong == len(places)
    assert not cycle.is_right(0)


@pytest.mark.parametrize(
    ("num_messages", "num_wrong", "num_foreign", "is_right"),
    [
        (0, 0, 0, True),
        (0, 0, 1, False),
        (4, 1, 0, True),
        (4, 2, 0, False),
        (4, 1, 1, False),
        (5, 1, 1, True),
        (5, 0, 3, False),
    ],
)
def test_most_messages_of_a_right_cycle_are_right_and_its_header_is(
    num_messages: int, num_wrong: int, num_foreign: int, is_right: bool
) -> None:
    cycle = Cycle(
        payloads=[],
        header=None,
        count=None,
        first_s=0.0,
        last_s=0.0,
        complete=True,
        num_messages=num_messages,
        num_wrong=num_wrong,
    )
    assert cycle.is_right(num_foreign) == is_right
    assert not replace(cycle, header_right=False).is_right(num_foreign)
