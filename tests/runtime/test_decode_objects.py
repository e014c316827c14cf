"""What an object is made of: every field, in every way in which a sensor may leave it out."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import can
import numpy as np
import pytest

from can_recordings import detections_of
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.detections import Detections, ObjectClass, VelocityKind
from soundness import assert_consistent
from tiny_sensor import (
    COUNTED,
    DBC,
    PACKED,
    SENSOR,
    SLOTS,
    decoder_of,
    first,
    header,
    message,
    profile_of,
    second,
)

NAN = math.nan
RICH, PAIR = 0x160, 0x161
RICH_DBC = (
    f"{DBC}BO_ {RICH} RICH: 16 R\n"
    ' SG_ RANGE : 0|32@1- (1,0) [0|0] "m" R\n'
    ' SG_ AZIMUTH : 32|32@1- (1,0) [0|0] "rad" R\n'
    ' SG_ HEADING : 64|16@1- (0.5,0) [0|0] "deg" R\n'
    ' SG_ LENGTH : 80|8@1+ (0.1,0) [0|0] "m" R\n'
    ' SG_ WIDTH : 88|8@1+ (5,0) [0|0] "cm" R\n'
    ' SG_ KIND : 96|4@1+ (1,0) [0|0] "" R\n'
    ' SG_ QUALITY : 100|4@1+ (1,0) [0|0] "" R\n'
    ' SG_ VX : 104|8@1- (0.5,0) [0|0] "m/s" R\n'
    ' SG_ VY : 112|8@1- (0.5,0) [0|0] "m/s" R\n\n'
    f"BO_ {PAIR} PAIR: 8 R\n"
    ' SG_ X1 : 0|8@1+ (1,0) [0|0] "m" R\n'
    ' SG_ X2 : 8|8@1+ (1,0) [0|0] "m" R\n'
    ' SG_ COUNTER : 16|4@1+ (1,0) [0|0] "" R\n\n'
    f"SIG_VALTYPE_ {RICH} RANGE : 1;\nSIG_VALTYPE_ {RICH} AZIMUTH : 1;\n"
)
RICH_TOML = (
    SENSOR
    + """
framing = "single"
velocity = "absolute"
messages = { object = "RICH" }

[sensor.fields]
range = "RANGE"
azimuth = "AZIMUTH"
velocity_x = "VX"
velocity_y = "VY"
heading = "HEADING"
length = "LENGTH"
width = "WIDTH"
new_track = "QUALITY == 3"
class = { signal = "KIND", table = { 1 = "car", 15 = "animal" } }
existence = { signal = "QUALITY", table = { 1 = 0.25, 3 = 0.75 } }
"""
)


def rich(
    range_m: float = 5.0, azimuth_rad: float = 0.0, *, kind: int = 1, quality: int = 3
) -> can.Message:
    """A car of 4.5 m by 1.8 m that faces -90 degrees and drives at (1, -2) m/s."""
    numbers = (range_m, azimuth_rad, -180, 45, 36, kind | quality << 4, 2, -4)
    return message(RICH, struct.pack("<ffhBBBbbx", *numbers))


def feed(decoder: Decoder, messages: list[can.Message], at_s: float = 0.0) -> list[Detections]:
    cycles = detections_of([event for one in messages for event in decoder.feed(one, at_s)])
    for cycle in cycles:
        assert_consistent(cycle)
    return cycles


def decoded(folder: Path, one: can.Message, text: str = RICH_TOML) -> Detections:
    (cycle,) = feed(Decoder(profile_of(folder, text, RICH_DBC)), [one])
    return cycle


def test_every_field_comes_from_its_signal(tmp_path: Path) -> None:
    cycle = decoded(tmp_path, rich(5.0, math.pi / 2))
    np.testing.assert_allclose(cycle.position, [[0.0, 5.0]], atol=1e-6)
    assert cycle.velocity_kind is VelocityKind.ABSOLUTE
    assert cycle.velocity.tolist() == [[1.0, -2.0]]
    assert cycle.heading_rad == pytest.approx([-math.pi / 2])
    assert cycle.length_m == pytest.approx([4.5])
    assert cycle.width_m == pytest.approx([1.8])
    assert cycle.object_class.tolist() == [ObjectClass.CAR]
    assert cycle.existence.tolist() == [0.75]
    assert cycle.is_new.tolist() == [True]
    assert cycle.sensor == "tiny"


def test_values_that_a_table_lacks_are_not_known(tmp_path: Path) -> None:
    cycle = decoded(tmp_path, rich(kind=2, quality=0))
    assert cycle.object_class.tolist() == [ObjectClass.UNKNOWN]
    assert np.isnan(cycle.existence).all()
    assert cycle.is_new.tolist() == [False]


def test_the_last_value_of_a_table_is_one_of_it(tmp_path: Path) -> None:
    assert decoded(tmp_path, rich(kind=15)).object_class.tolist() == [ObjectClass.ANIMAL]


@pytest.mark.parametrize(
    ("sign", "raws"), [("+", {1: 1, 14: 14, 15: 15}), ("-", {1: 1, 14: -2, 15: -1})]
)
def test_a_table_lists_the_raw_values_that_the_dbc_lists(
    tmp_path: Path, sign: str, raws: dict[int, int]
) -> None:
    """Of a signed signal all bits set is -1, for every value that the bits can hold."""
    dbc = RICH_DBC.replace("96|4@1+", f"96|4@1{sign}").replace("100|4@1+", f"100|4@1{sign}")
    names = {1: "car", 14: "pedestrian", 15: "truck"}
    text = RICH_TOML.replace(
        '{ 1 = "car", 15 = "animal" }',
        "{ " + ", ".join(f'{raws[bits]} = "{name}"' for bits, name in names.items()) + " }",
    ).replace("{ 1 = 0.25, 3 = 0.75 }", f"{{ {raws[14]} = 0.25, {raws[15]} = 0.75 }}")
    decoder = Decoder(profile_of(tmp_path, text, dbc))
    for bits in range(16):
        (cycle,) = feed(decoder, [rich(kind=bits, quality=bits)])
        expected = ObjectClass[names.get(bits, "unknown").upper()]
        assert cycle.object_class.tolist() == [expected]
        np.testing.assert_array_equal(cycle.existence, [{14: 0.25, 15: 0.75}.get(bits, NAN)])


def test_a_signal_may_be_in_a_table_and_in_conditions(tmp_path: Path) -> None:
    """The table goes by its bits, a condition by its raw value: both are right."""
    dbc = RICH_DBC.replace("96|4@1+", "96|4@1-")
    text = RICH_TOML.replace("15 = ", "-1 = ").replace("QUALITY == 3", "raw(KIND) == -1")
    for kind, expected in ((15, ObjectClass.ANIMAL), (1, ObjectClass.CAR)):
        (cycle,) = feed(Decoder(profile_of(tmp_path, text, dbc)), [rich(kind=kind)])
        assert cycle.object_class.tolist() == [expected]
        assert cycle.is_new.tolist() == [kind == 15]


def test_what_a_short_message_lacks_is_not_known(tmp_path: Path) -> None:
    cut = rich(kind=15)
    cut.data = cut.data[:10]
    cycle = decoded(tmp_path, cut)
    assert cycle.position.tolist() == [[5.0, 0.0]]
    assert cycle.heading_rad == pytest.approx([-math.pi / 2])
    for values in (cycle.velocity, cycle.length_m, cycle.width_m, cycle.existence):
        assert np.isnan(values).all()
    assert cycle.object_class.tolist() == [ObjectClass.UNKNOWN]
    assert cycle.is_new.tolist() == [False]


@pytest.mark.parametrize(("quality", "length_m"), [(3, 4.5), (1, NAN)])
def test_a_field_counts_only_where_its_condition_holds(
    tmp_path: Path, quality: int, length_m: float
) -> None:
    text = RICH_TOML.replace(
        'length = "LENGTH"', 'length = { signal = "LENGTH", when = "QUALITY == 3" }'
    )
    cycle = decoded(tmp_path, rich(quality=quality), text)
    np.testing.assert_allclose(cycle.length_m, [length_m])


@pytest.mark.parametrize(("key", "velocity"), [("x", [1.0, NAN]), ("y", [NAN, -2.0])])
def test_a_sensor_may_know_one_part_of_the_velocity(
    tmp_path: Path, key: str, velocity: list[float]
) -> None:
    other = {"x": "y", "y": "x"}[key]
    text = RICH_TOML.replace(f'velocity_{other} = "V{other.upper()}"\n', "")
    np.testing.assert_array_equal(decoded(tmp_path, rich(), text).velocity, [velocity])


def test_what_the_profile_does_not_name_is_not_known(tmp_path: Path) -> None:
    """The position is all that a sensor must say."""
    head = RICH_TOML.partition("velocity_x")[0].replace('velocity = "absolute"\n', "")
    cycle = decoded(tmp_path, rich(), head)
    assert cycle.position.tolist() == [[5.0, 0.0]]
    assert cycle.velocity_kind is VelocityKind.NONE
    for values in (
        cycle.velocity,
        cycle.heading_rad,
        cycle.length_m,
        cycle.width_m,
        cycle.existence,
    ):
        assert np.isnan(values).all()
    assert cycle.object_class.tolist() == [ObjectClass.UNKNOWN]
    assert cycle.is_new.tolist() == [False]


@pytest.mark.parametrize(
    ("range_m", "azimuth_rad"), [(math.inf, 0.0), (NAN, 0.0), (5.0, math.inf), (5.0, NAN)]
)
def test_an_object_that_is_nowhere_is_left_out(
    tmp_path: Path, range_m: float, azimuth_rad: float
) -> None:
    """Quietly, whatever arithmetic thinks of it (warnings are errors here)."""
    cycle = decoded(tmp_path, rich(range_m, azimuth_rad))
    assert cycle.object_id.tolist() == []
    assert cycle.velocity.shape == (0, 2)
    assert len(cycle.existence) == len(cycle.object_class) == len(cycle.is_new) == 0


@pytest.mark.parametrize(("num_objects", "places"), [(3, [0]), (3, [1]), (3, [0, 2]), (2, [0, 1])])
def test_objects_in_slots_are_numbered_on_from_slot_to_slot(
    tmp_path: Path, num_objects: int, places: list[int]
) -> None:
    """With three in a message those of slot 5 are 15, 16 and 17; an empty place counts too."""
    text = (
        SENSOR
        + """
framing = "slots"
slots = { first = 5, last = 5 }
objects = { first = 1, last = LAST }
messages = { objects = "PACKED" }
fields = { x = "O{object}_X", y = "O{object}_Y", valid = "O{object}_ID != 0" }
"""
    ).replace("LAST", str(num_objects))
    data = bytearray(24)
    for place in places:
        data[5 * place : 5 * place + 5] = struct.pack("<hhB", 100 * place, 200, 1)
    (cycle,) = feed(decoder_of(tmp_path, text), [message(PACKED, bytes(data))])
    assert cycle.object_id.tolist() == [5 * num_objects + place for place in places]
    assert cycle.position.tolist() == [[float(place), 2.0] for place in places]


def test_a_header_cut_short_says_no_age(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    cut = header(0, age_ms=50)
    cut.data = cut.data[:3]
    (cycle,) = feed(decoder, [cut], at_s=10.0)
    assert cycle.timestamp_s == 10.0


def test_a_header_cut_short_says_no_counter(tmp_path: Path) -> None:
    """The counters of its objects are compared with each other instead, and with no other cycle."""
    decoder = decoder_of(tmp_path, COUNTED)
    cut = header(2)
    cut.data = cut.data[:1]
    objects = [first(1, 0, 1, counter=9), first(2, 0, 2, counter=8)]
    feed(decoder, [header(0, 3)])
    (cycle,) = feed(decoder, [cut, *objects, second(1, 4.0), second(2, 4.0)])
    assert cycle.object_id.tolist() == [1]


def test_an_objects_counter_may_have_fewer_bits_than_the_headers(tmp_path: Path) -> None:
    """0x35 in eight bits is 5 in four."""
    text = SLOTS.replace(
        "[sensor.messages]",
        '[sensor.header]\nmessage = "LIST"\ncounter = "COUNT"\n[sensor.messages]',
    )
    decoder = decoder_of(tmp_path, text)
    firsts = [first(i + 1, 0, 0, slot=i, counter=3 if i == 2 else 5) for i in range(4)]
    seconds = [second(0, 4.0, slot=i) for i in range(4)]
    (cycle,) = feed(decoder, [header(0x35), *firsts, *seconds])
    assert cycle.object_id.tolist() == [0, 1, 3]
    assert cycle.timestamp_s == 0.0


@pytest.mark.parametrize("counters", [(4, 6), (15, 1), (4, 4)])
def test_without_a_header_cycles_are_counted_by_their_objects(
    tmp_path: Path, counters: tuple[int, int]
) -> None:
    decoder = decoder_of(tmp_path, SLOTS)
    for i, counter in enumerate(counters):
        firsts = [first(1, 0, 0, slot=slot, counter=counter) for slot in range(4)]
        feed(decoder, firsts + [second(0, 4.0, slot=slot) for slot in range(4)], at_s=0.1 * i)
    assert decoder.counters.bad_counter == 1
    assert decoder.sources[0].wrong == 1


@pytest.mark.parametrize("foreign", [0, 1, 2])
def test_a_cycle_is_right_if_most_of_its_messages_belong_to_it(
    tmp_path: Path, foreign: int
) -> None:
    """Four messages about objects; two of another cycle are too many."""
    decoder = decoder_of(tmp_path, COUNTED)
    feed(decoder, [header(0, 3)])
    firsts = [first(i + 1.0, 0, i, counter=5 if i < foreign else 4) for i in range(2)]
    (cycle,) = feed(decoder, [header(2, 4), *firsts, second(0, 4.0), second(1, 4.0)])
    assert cycle.object_id.tolist() == [0, 1][foreign:]
    assert decoder.counters.bad_counter == foreign
    assert decoder.sources[0].wrong == (foreign == 2)


@pytest.mark.parametrize(
    ("first_ids", "second_ids", "lengths"),
    [
        ([1, 2, 3], [3, 1, 2], [1.0, 2.0, 3.0]),
        ([3, 1, 2], [1, 2, 3], [3.0, 1.0, 2.0]),
        ([1, 2, 3], [4, 5, 6], [NAN, NAN, NAN]),
        ([4, 5, 6], [1, 2, 3], [NAN, NAN, NAN]),
        ([2, 4, 6], [1, 4, 7], [NAN, 4.0, NAN]),
        ([1, 2, 3], [2, 2, 2], [NAN, 2.0, NAN]),
    ],
)
def test_second_messages_go_to_the_objects_with_their_ids(
    tmp_path: Path, first_ids: list[int], second_ids: list[int], lengths: list[float]
) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    messages = [header(3), *(first(1.0, 0, i) for i in first_ids)]
    (cycle,) = feed(decoder, messages + [second(i, float(i)) for i in second_ids])
    assert cycle.object_id.tolist() == first_ids
    np.testing.assert_array_equal(cycle.length_m, lengths)


def test_the_last_of_two_second_messages_counts(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    messages = [header(3), first(1, 0, 7), first(2, 0, 8), first(3, 0, 9)]
    (cycle,) = feed(decoder, [*messages, second(8, 1.0), second(7, 2.0), second(8, 3.0)])
    np.testing.assert_array_equal(cycle.length_m, [2.0, 3.0, NAN])


def test_second_messages_that_did_not_come_leave_nothing_in_their_place(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    objects = [first(1, 0, 7), first(2, 0, 8), first(3, 0, 9)]
    feed(decoder, [header(3), *objects, second(9, 1.0), second(7, 2.0)])
    (cycle,) = detections_of(decoder.poll(1.0))
    np.testing.assert_array_equal(cycle.length_m, [2.0, NAN, 1.0])


def test_of_many_second_messages_with_one_id_the_last_counts(tmp_path: Path) -> None:
    """So many that a sort which does not keep their order would show."""
    decoder = decoder_of(tmp_path, COUNTED)
    lengths = [0.1 * i for i in range(100)]
    messages = [header(100), *(first(1.0, 0, i) for i in range(100))]
    (cycle,) = feed(decoder, messages + [second(i % 2, lengths[i]) for i in range(100)])
    assert cycle.length_m[:2] == pytest.approx(lengths[-2:])


def test_every_lost_cycle_is_counted(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, COUNTED)
    feed(decoder, [header(0, counter) for counter in (1, 3, 5, 7, 8)])
    assert (decoder.counters.bad_counter, decoder.sources[0].wrong) == (3, 3)


def test_a_damaged_object_does_not_hide_that_a_cycle_was_lost(tmp_path: Path) -> None:
    """The header's counter could be read."""
    text = COUNTED.replace(
        '"FIRST_00", counter = "COUNTER"', '"FIRST_00", checksum = { kind = "xor8" }'
    )
    decoder = decoder_of(tmp_path, text)
    for counter in (1, 3):
        feed(decoder, [header(1, counter), first(1, 0, 7, state=1), second(7, 4.0)])
    assert (decoder.counters.bad_checksum, decoder.counters.bad_counter) == (2, 1)


BEHIND = '{ signal = "first.RATE", unit = "m" }'
WITHOUT_CONDITION = COUNTED.replace('valid = "first.STATE != 0"\n', "")


@pytest.mark.parametrize(
    ("num_bytes", "text"),
    [
        (6, COUNTED.replace('"first.X"', BEHIND)),
        (6, COUNTED.replace('{ signal = "first.Y", sign = -1 }', BEHIND)),
        (4, WITHOUT_CONDITION),
    ],
    ids=["x", "y", "id"],
)
def test_an_object_that_lacks_its_place_or_name_is_left_out(
    tmp_path: Path, num_bytes: int, text: str
) -> None:
    """Even if the profile's condition holds; the others stay."""
    decoder = decoder_of(tmp_path, text)
    for i in range(2):
        cut = first(1, 2, 7, counter=i)
        cut.data = cut.data[:num_bytes]
        messages = [header(2, i), cut, first(1, 2, 8, counter=i), second(7, 4.0), second(8, 4.0)]
        (cycle,) = feed(decoder, messages)
        assert cycle.object_id.tolist() == [8]
    assert (decoder.counters.invalid_objects, decoder.counters.objects) == (2, 2)


def test_an_object_too_short_for_its_counter_is_not_one_of_another_cycle(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, WITHOUT_CONDITION)
    cut = first(1, 2, 7)
    cut.data = cut.data[:5]
    (cycle,) = feed(decoder, [header(1, 3), cut, second(7, 4.0)])
    assert cycle.object_id.tolist() == [7]
    assert (decoder.counters.bad_counter, decoder.counters.short) == (0, 1)


BOTH_COUNT = SLOTS.replace(
    'second = "SECOND_{slot:X}"', 'second = { message = "SECOND_{slot:X}", counter = "COUNTER" }'
)


def test_counters_of_all_messages_of_an_object_are_one_count(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, BOTH_COUNT)
    for counter in range(3):
        firsts = [first(1, 0, 0, slot=slot, counter=counter) for slot in range(4)]
        seconds = [second(0, 4.0, slot=slot, counter=counter) for slot in range(4)]
        (cycle,) = feed(decoder, firsts + seconds, at_s=0.1 * counter)
        assert cycle.length_m.tolist() == [4.0] * 4
    assert decoder.counters.bad_counter == 0


@pytest.mark.parametrize("foreign", [[3], [2, 3]])
def test_all_messages_of_another_cycle_count_against_the_cycle(
    tmp_path: Path, foreign: list[int]
) -> None:
    """Half of its messages are too many."""
    decoder = decoder_of(tmp_path, BOTH_COUNT)
    counters = [4 if slot in foreign else 5 for slot in range(4)]
    firsts = [first(1, 0, 0, slot=slot, counter=counters[slot]) for slot in range(4)]
    seconds = [second(0, 4.0, slot=slot, counter=counters[slot]) for slot in range(4)]
    feed(decoder, firsts + seconds)
    assert decoder.counters.bad_counter == 2 * len(foreign)
    assert decoder.sources[0].wrong == (len(foreign) == 2)


PAIRS = (
    SENSOR
    + """
framing = "counted"
objects = { first = 1, last = 2 }
header = { message = "LIST", count = "COUNT", counter = "COUNTER" }
messages = { pair = { message = "PAIR", counter = "COUNTER" } }
fields = { id = "X{object}", x = "X{object}", y = "X{object}" }
"""
)


@pytest.mark.parametrize(("num_foreign", "is_wrong"), [(0, False), (1, False), (2, True)])
def test_a_message_of_another_cycle_is_one_however_many_objects_it_has(
    tmp_path: Path, num_foreign: int, is_wrong: bool
) -> None:
    """Three messages of two objects each."""
    decoder = Decoder(profile_of(tmp_path, PAIRS, RICH_DBC))
    feed(decoder, [header(0, 4)])
    pairs = [
        message(PAIR, bytes([2 * i, 2 * i + 1, 4 if i < num_foreign else 5])) for i in range(3)
    ]
    (cycle,) = feed(decoder, [header(6, 5), *pairs])
    assert cycle.object_id.tolist() == list(range(2 * num_foreign, 6))
    assert decoder.counters.bad_counter == num_foreign
    assert decoder.sources[0].wrong == is_wrong


def test_slots_cut_short_say_no_counter(tmp_path: Path) -> None:
    decoder = decoder_of(tmp_path, SLOTS)
    firsts = [first(1, 0, 0, slot=slot) for slot in range(4)]
    for one in firsts:
        one.data = one.data[:5]
    (cycle,) = feed(decoder, firsts + [second(0, 4.0, slot=slot) for slot in range(4)])
    assert cycle.complete
    assert cycle.object_id.tolist() == []
    assert (decoder.counters.bad_counter, decoder.counters.invalid_objects) == (0, 4)
