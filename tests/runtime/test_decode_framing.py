"""Which messages make a cycle, when it is closed, and what is in it."""

from __future__ import annotations

import math
from copy import copy
from pathlib import Path

import can
import numpy as np
import pytest

from can_recordings import detections_of, feed_all
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.detections import Detections, ObjectClass, VelocityKind
from tiny_sensor import (
    COUNTED,
    DBC,
    FIRST,
    PACKED,
    POLAR,
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


def stamped(messages: list[can.Message], step_s: float) -> list[can.Message]:
    """The messages, one every step from 0 s on."""
    again = [copy(one) for one in messages]
    for i, one in enumerate(again):
        one.timestamp = i * step_s
    return again


def feed(decoder: Decoder, messages: list[can.Message], at_s: float = 0.0) -> list[Detections]:
    """The cycles that the messages close, fed a millisecond apart."""
    events = []
    for i, one in enumerate(messages):
        events += decoder.feed(one, at_s + 1e-3 * i)
    return detections_of(events)


class TestCounted:
    def test_a_cycle_closes_on_its_count(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        messages = [header(2), first(10, 1, 7), first(20, -2, 8), second(7, 4.5), second(8, 12.0)]
        assert feed(decoder, messages[:-1]) == []
        (cycle,) = feed(decoder, messages[-1:], at_s=0.004)
        assert cycle.complete
        assert (cycle.timestamp_s, cycle.received_s) == (0.0, 0.004)
        assert cycle.object_id.tolist() == [7, 8]
        np.testing.assert_allclose(cycle.position, [[10, -1], [20, 2]])  # y is turned around
        np.testing.assert_allclose(cycle.length_m, [4.5, 12.0])

    def test_messages_of_one_object_are_joined_by_id_in_any_order(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        messages = [second(8, 12.0), first(20, 0, 8), second(7, 4.5), first(10, 0, 7)]
        (cycle,) = feed(decoder, [header(2), *messages])
        assert dict(zip(cycle.object_id.tolist(), cycle.length_m.tolist(), strict=True)) == {
            7: 4.5,
            8: 12.0,
        }

    def test_an_object_without_its_second_message_lacks_only_that(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        (cycle,) = feed(
            decoder, [header(2), first(10, 0, 7), first(20, 0, 8), second(8, 12.0), second(9, 1.0)]
        )
        np.testing.assert_array_equal(cycle.length_m, [NAN, 12.0])
        np.testing.assert_array_equal(cycle.existence, [NAN, 1.0])

    def test_an_empty_list_is_a_cycle_without_objects(self, tmp_path: Path) -> None:
        (cycle,) = feed(decoder_of(tmp_path, COUNTED), [header(0)])
        assert cycle.complete
        assert cycle.position.shape == cycle.velocity.shape == (0, 2)

    def test_the_time_is_the_headers_less_latency_and_age(self, tmp_path: Path) -> None:
        late = COUNTED.replace("timeout_s", "latency_s = 0.25\ntimeout_s")
        (cycle,) = feed(decoder_of(tmp_path, late), [header(0, age_ms=50)], at_s=10.0)
        assert cycle.timestamp_s == pytest.approx(10.0 - 0.25 - 0.05)
        assert cycle.received_s == 10.0

    def test_the_next_header_closes_an_unfinished_cycle(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        (cycle,) = feed(decoder, [header(2), first(10, 0, 7), header(1, counter=1)])
        assert not cycle.complete
        assert cycle.object_id.tolist() == [7]
        assert decoder.counters.incomplete_cycles == 1

    def test_a_timeout_closes_an_unfinished_cycle(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        feed(decoder, [header(2), first(10, 0, 7)])
        assert decoder.poll(0.1) == []
        (cycle,) = detections_of(decoder.poll(0.102))
        assert not cycle.complete
        assert (cycle.timestamp_s, cycle.received_s) == (0.0, 0.001)
        assert decoder.poll(0.2) == []

    def test_a_cycle_may_take_longer_than_the_timeout(self, tmp_path: Path) -> None:
        """Its messages come 90 ms apart, and the timeout is 100 ms."""
        decoder = decoder_of(tmp_path, COUNTED)
        messages = [header(2), first(10, 0, 7), first(20, 0, 8), second(7, 4.5), second(8, 12.0)]
        events = feed_all(decoder, stamped(messages, 0.09))
        (cycle,) = detections_of(events)
        assert cycle.complete
        assert (cycle.timestamp_s, cycle.received_s) == (0.0, 0.36)
        assert cycle.object_id.tolist() == [7, 8]

    def test_messages_beyond_its_count_do_not_keep_a_cycle_open(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        feed(decoder, [header(1), first(10, 0, 7)])
        (cycle,) = detections_of(feed_all(decoder, stamped([first(30, 0, 9)] * 5, 0.03)))
        assert cycle.object_id.tolist() == [7]
        assert decoder.counters.stray == 5

    def test_a_late_message_closes_an_unfinished_cycle_and_is_none_of_it(
        self, tmp_path: Path
    ) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        feed(decoder, [header(2), first(10, 0, 7)])
        (cycle,) = feed(decoder, [first(20, 0, 8)], at_s=0.2)
        assert cycle.object_id.tolist() == [7]
        assert decoder.counters.stray == 1

    @pytest.mark.parametrize("now_s", [-5.0, NAN, math.inf])
    def test_a_clock_that_jumps_ends_the_cycle(self, tmp_path: Path, now_s: float) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        feed(decoder, [header(2), first(10, 0, 7)])
        assert len(decoder.poll(now_s)) == 1

    def test_objects_without_a_header_are_stray(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        assert feed(decoder, [first(10, 0, 7), second(7, 4.5)]) == []
        assert decoder.counters.stray == 2

    def test_more_objects_than_announced_are_stray(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        (cycle,) = feed(decoder, [header(1), first(1, 0, 1), first(2, 0, 2), second(1, 4.0)])
        assert cycle.object_id.tolist() == [1]
        assert decoder.counters.stray == 1

    def test_the_last_of_two_objects_with_one_id_counts(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        firsts = [first(1, 0, 1), first(2, 0, 2), first(3, 0, 1)]
        seconds = [second(1, 4.0), second(2, 4.0), second(1, 5.0)]
        (cycle,) = feed(decoder, [header(3), *firsts, *seconds])
        assert cycle.position[:, 0].tolist() == [2.0, 3.0]
        assert cycle.length_m.tolist() == [4.0, 5.0]
        assert decoder.counters.invalid_objects == 1

    def test_the_validity_condition_leaves_objects_out(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        objects = [first(1, 0, 1, state=0), first(2, 0, 2, state=1), first(3, 0, 3, state=2)]
        (cycle,) = feed(decoder, [header(3), *objects, *(second(i, 4.0) for i in (1, 2, 3))])
        assert cycle.object_id.tolist() == [2, 3]
        assert cycle.is_new.tolist() == [True, False]
        assert (decoder.counters.objects, decoder.counters.invalid_objects) == (2, 1)

    def test_a_radial_speed_is_a_vector_along_the_line_of_sight(self, tmp_path: Path) -> None:
        """2 m/s away at (3, 4) m, which the profile turns to (3, -4)."""
        (cycle,) = feed(decoder_of(tmp_path, COUNTED), [header(1), first(3, 4, 1), second(1, 4)])
        assert cycle.velocity_kind is VelocityKind.RADIAL
        np.testing.assert_allclose(cycle.velocity, [[1.2, -1.6]])

    def test_an_object_at_the_sensor_has_no_direction(self, tmp_path: Path) -> None:
        (cycle,) = feed(decoder_of(tmp_path, COUNTED), [header(1), first(0, 0, 1), second(1, 4)])
        assert np.isnan(cycle.velocity).all()

    def test_ids_are_offset_as_the_profile_says(self, tmp_path: Path) -> None:
        shifted = COUNTED.replace("timeout_s", "object_id_offset = 1000\ntimeout_s")
        (cycle,) = feed(decoder_of(tmp_path, shifted), [header(1), first(1, 0, 7), second(7, 4)])
        assert cycle.object_id.tolist() == [1007]


class TestOptionalMessages:
    """A clone of a radar, or a radar set up so, sends no second messages."""

    def cycle(self, counter: int, *seconds: can.Message) -> list[can.Message]:
        return [header(1, counter), first(10, 0, 7, counter=counter), *seconds]

    def test_what_never_comes_is_not_waited_for_from_the_fourth_cycle_on(
        self, tmp_path: Path
    ) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        for i in range(3):
            feed(decoder, self.cycle(i), at_s=float(i))
            assert len(decoder.poll(i + 0.5)) == 1
        (cycle,) = feed(decoder, self.cycle(3), at_s=3.0)
        assert cycle.complete
        assert (decoder.counters.cycles, decoder.counters.incomplete_cycles) == (4, 3)

    def test_what_comes_after_all_is_waited_for_again(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        for i in range(4):
            feed(decoder, self.cycle(i), at_s=float(i))
        feed(decoder, self.cycle(4, second(7, 4.5)), at_s=4.0)
        assert decoder.counters.stray == 1
        (cycle,) = feed(decoder, self.cycle(5, second(7, 4.5)), at_s=5.0)
        assert cycle.length_m.tolist() == [4.5]
        assert cycle.received_s == 5.002

    def test_what_is_lost_once_is_still_waited_for(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        feed(decoder, self.cycle(0, second(7, 4.5)))
        feed(decoder, self.cycle(1), at_s=1.0)
        (lost, whole) = feed(decoder, self.cycle(2, second(7, 4.5)), at_s=2.0)
        assert np.isnan(lost.length_m).all()
        assert whole.length_m.tolist() == [4.5]

    def test_cycles_that_were_cut_off_tell_nothing_about_what_comes(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        for i in range(5):
            feed(decoder, [header(2, i), first(10, 0, 7, counter=i)], at_s=float(i))
        feed(decoder, self.cycle(5), at_s=5.0)
        (cycle,) = feed(decoder, [second(7, 4.5)], at_s=5.002)
        assert cycle.length_m.tolist() == [4.5]

    def test_empty_cycles_tell_nothing_about_what_comes(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        for i in range(10):
            assert len(feed(decoder, [header(0, i)], at_s=float(i))) == 1
        (cycle,) = feed(decoder, self.cycle(10, second(7, 4.5)), at_s=10.0)
        assert cycle.length_m.tolist() == [4.5]

    @pytest.mark.parametrize("period_s", [0.05, 0.2])
    @pytest.mark.parametrize("places", [[0, 1, 2, 3, 4, 5, 6, 7], [0, 4, 1, 5, 2, 6, 3, 7]])
    def test_slots_that_come_after_all_are_waited_for_again(
        self, tmp_path: Path, places: list[int], period_s: float
    ) -> None:
        """Behind the first messages or between them; they make no cycles of their own."""
        optional = SLOTS.replace(
            '"SECOND_{slot:X}"', '{ message = "SECOND_{slot:X}", optional = true }'
        )
        decoder, cycles = decoder_of(tmp_path, optional), []
        for i in range(7):
            whole = [first(slot + 1, 0, 0, slot=slot, counter=i) for slot in range(4)]
            whole += [second(0, 4.5, slot=slot) for slot in range(4)]
            sent = whole[:4] if i < 4 else [whole[place] for place in places]
            decoder.poll(i * period_s)
            cycles += feed(decoder, sent, at_s=i * period_s)
        *_, late, one, another = cycles
        assert late.complete
        assert math.isnan(late.length_m[3])
        assert one.length_m.tolist() == another.length_m.tolist() == [4.5] * 4
        counters = decoder.counters
        assert (counters.cycles, counters.incomplete_cycles) == (7, 3)
        assert counters.stray == np.isnan(late.length_m).sum()


class TestCounters:
    def test_a_lost_cycle_is_counted(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        for counter in (14, 15, 0, 2):  # four bits; 1 is lost
            feed(decoder, [header(0, counter)])
        assert decoder.counters.bad_counter == 1

    def test_the_profile_says_by_how_much_a_counter_may_grow(self, tmp_path: Path) -> None:
        by_two = COUNTED.replace(
            'counter = "COUNTER"\nage', 'counter = { signal = "COUNTER", steps = [2] }\nage'
        )
        decoder = decoder_of(tmp_path, by_two)
        for counter in (12, 14, 0, 2, 3):
            feed(decoder, [header(0, counter)])
        assert decoder.counters.bad_counter == 1

    @pytest.mark.parametrize(("header_sign", "object_sign"), ["--", "-+", "+-"])
    def test_a_counter_counts_in_its_bits_whatever_its_sign(
        self, tmp_path: Path, header_sign: str, object_sign: str
    ) -> None:
        """0 to 15 and 0 again, and what is of another cycle is found out as ever."""
        dbc = DBC.replace("COUNTER : 8|4@1+", f"COUNTER : 8|4@1{header_sign}")
        dbc = dbc.replace("COUNTER : 40|4@1+", f"COUNTER : 40|4@1{object_sign}")
        decoder = Decoder(profile_of(tmp_path, COUNTED, dbc))
        for i in range(32):
            objects = [first(1, 0, 1, counter=i % 16), first(2, 0, 2, counter=(i + 1) % 16)]
            seconds = [second(1, 4.0), second(2, 4.0)]
            (cycle,) = feed(decoder, [header(2, i % 16), *objects, *seconds], at_s=float(i))
            assert cycle.object_id.tolist() == [1]
        assert decoder.counters.bad_counter == 32  # the second object of every cycle

    def test_the_messages_of_slots_count_in_their_bits(self, tmp_path: Path) -> None:
        dbc = DBC.replace("COUNTER : 40|4@1+", "COUNTER : 40|4@1-")
        decoder = Decoder(profile_of(tmp_path, SLOTS, dbc))
        for i in range(32):
            firsts = [first(k + 1, 0, 0, slot=k, counter=i % 16) for k in range(4)]
            cycles = feed(decoder, [*firsts, *(second(0, 4.0, slot=k) for k in range(4))], float(i))
            assert [cycle.object_id.tolist() for cycle in cycles] == [[0, 1, 2, 3]]
        assert decoder.counters.bad_counter == 0

    def test_an_object_of_another_cycle_is_left_out(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTED)
        objects = [first(1, 0, 1, counter=5), first(2, 0, 2, counter=4)]
        (cycle,) = feed(decoder, [header(2, 5), *objects, second(1, 4.0), second(2, 4.0)])
        assert cycle.object_id.tolist() == [1]
        assert decoder.counters.bad_counter == 1

    def test_slots_of_another_cycle_are_left_out(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, SLOTS)
        firsts = [first(i + 1, 0, 0, slot=i, counter=3 if i else 4) for i in (1, 2, 0, 3)]
        (cycle,) = feed(decoder, firsts + [second(0, 4.0, slot=i) for i in range(4)])
        assert cycle.object_id.tolist() == [0]
        assert decoder.counters.bad_counter == 3

    def test_a_damaged_message_is_as_if_nothing_were_in_it(self, tmp_path: Path) -> None:
        summed = COUNTED.replace(
            '"FIRST_00", counter = "COUNTER"',
            '"FIRST_00", checksum = { kind = "xor8", byte = 7 }',
        )
        good, bad = first(1, 0, 1), first(2, 0, 2)
        for one in (good, bad):
            one.data += bytes([0])
            one.data[7] = np.bitwise_xor.reduce(list(one.data))
        bad.data[0] ^= 4
        decoder = decoder_of(tmp_path, summed)
        (cycle,) = feed(decoder, [header(2), good, bad, second(1, 4.0), second(2, 4.0)])
        assert cycle.complete
        assert cycle.object_id.tolist() == [1]
        assert (decoder.counters.bad_checksum, decoder.counters.invalid_objects) == (1, 1)


class TestSlots:
    def messages(self, counter: int = 0) -> list[can.Message]:
        firsts = [first(i + 1, 0, 0, slot=i, counter=counter) for i in range(4)]
        return firsts + [second(0, i + 1.0, slot=i) for i in range(4)]

    def test_a_cycle_closes_when_every_slot_has_come(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, SLOTS)
        assert feed(decoder, self.messages()[:-1]) == []
        (cycle,) = feed(decoder, self.messages()[-1:], at_s=0.007)
        assert cycle.complete
        assert cycle.timestamp_s == 0.0
        assert cycle.object_id.tolist() == [0, 1, 2, 3]
        assert cycle.position[:, 0].tolist() == cycle.length_m.tolist() == [1.0, 2.0, 3.0, 4.0]

    def test_slots_may_come_in_any_order(self, tmp_path: Path) -> None:
        (cycle,) = feed(decoder_of(tmp_path, SLOTS), self.messages()[::-1])
        assert cycle.position[:, 0].tolist() == cycle.length_m.tolist() == [1.0, 2.0, 3.0, 4.0]

    def test_a_slot_that_comes_again_begins_the_next_cycle(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, SLOTS)
        lossy = [one for one in self.messages() if one.arbitration_id != FIRST + 2]
        (cycle, whole) = feed(decoder, [*lossy, *self.messages(1)])
        assert not cycle.complete
        assert cycle.object_id.tolist() == [0, 1, 3]
        assert whole.complete

    def test_a_timeout_closes_what_has_come(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, SLOTS)
        feed(decoder, self.messages()[:6])
        (cycle,) = detections_of(decoder.poll(1.0))
        np.testing.assert_array_equal(cycle.length_m, [1.0, 2.0, NAN, NAN])

    def test_a_message_after_the_timeout_begins_the_next_cycle(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, SLOTS)
        feed(decoder, self.messages()[:6])
        (cycle,) = feed(decoder, self.messages()[:1], at_s=1.0)
        assert not cycle.complete
        assert decoder.counters.stray == 0

    def test_a_header_says_how_many_slots_are_sent(self, tmp_path: Path) -> None:
        with_header = SLOTS.replace(
            "[sensor.messages]",
            '[sensor.header]\nmessage = "LIST"\ncount = "COUNT"\n[sensor.messages]',
        )
        decoder = decoder_of(tmp_path, with_header)
        sent = [one for one in self.messages() if one.arbitration_id & 0xF < 2]
        assert feed(decoder, sent) == []
        assert decoder.counters.stray == 4
        (cycle,) = feed(decoder, [header(2), *sent])
        assert cycle.complete
        assert cycle.object_id.tolist() == [0, 1]

    def test_an_id_may_come_from_a_signal(self, tmp_path: Path) -> None:
        named = SLOTS.replace('id = "slot"', 'id = "first.ID"')
        messages = self.messages()
        for i, one in enumerate(messages[:4]):
            one.data[4] = 40 + i
        (cycle,) = feed(decoder_of(tmp_path, named), messages)
        assert cycle.object_id.tolist() == [40, 41, 42, 43]


SINGLE = (
    SENSOR
    + """
framing = "single"
velocity = "radial"
messages = { object = "POLAR" }

[sensor.fields]
range = { signal = "RANGE", unit = "m" }
azimuth = { signal = "ANGLE", sign = -1 }
range_rate = { signal = "RATE", when = "raw(RATE) != -32768" }
valid = "RANGE > 0"

[sensor.fields.class]
signal = "RANGE"
table = { 200 = "truck" }
"""
)


def polar(range_m: float, angle_deg: float, rate_km_h: float) -> can.Message:
    numbers = (round(10 * range_m), round(10 * angle_deg), round(10 * rate_km_h))
    return message(POLAR, b"".join((n & 0xFFFF).to_bytes(2, "little") for n in numbers) + bytes(2))


class TestSingle:
    def test_every_message_is_a_cycle(self, tmp_path: Path) -> None:
        """20 m away, 30 degrees to the right, coming closer at 36 km/h."""
        (one, two) = feed(decoder_of(tmp_path, SINGLE), [polar(20, 30, -36), polar(10, 0, 0)])
        np.testing.assert_allclose(one.position, [[20 * math.sqrt(0.75), -10.0]])
        np.testing.assert_allclose(one.velocity, [[-10 * math.sqrt(0.75), 5.0]])
        assert one.object_class.tolist() == [ObjectClass.TRUCK]
        assert two.object_class.tolist() == [ObjectClass.UNKNOWN]
        assert one.object_id.tolist() == two.object_id.tolist() == [0]

    def test_a_field_counts_only_when_its_condition_holds(self, tmp_path: Path) -> None:
        (cycle,) = feed(decoder_of(tmp_path, SINGLE), [polar(20, 0, -3276.8)])
        assert np.isnan(cycle.velocity).all()
        assert cycle.position.tolist() == [[20.0, 0.0]]

    @pytest.mark.parametrize(
        ("condition", "raw", "is_valid"),
        [
            ("RANGE != 6553.4", 65534, False),
            ("RANGE != 6553.4", 65533, True),
            ("RANGE < 102.3", 1023, False),
            ("RANGE <= 102.3", 1023, True),
        ],
    )
    def test_a_value_is_compared_as_the_dbc_writes_it(
        self, tmp_path: Path, condition: str, raw: int, is_valid: bool
    ) -> None:
        """As floats, 65534 * 0.1 is 6553.400000000001, and 1023 * 0.1 is above 102.3."""
        text = SINGLE.replace("RANGE > 0", condition)
        data = raw.to_bytes(2, "little") + bytes(6)
        (cycle,) = feed(decoder_of(tmp_path, text), [message(POLAR, data)])
        assert len(cycle.object_id) == is_valid

    def test_a_message_without_a_valid_object_is_an_empty_cycle(self, tmp_path: Path) -> None:
        (cycle,) = feed(decoder_of(tmp_path, SINGLE), [polar(0, 0, 0)])
        assert len(cycle.object_id) == 0


MANY = (
    SENSOR
    + """
framing = "counted"
objects = { first = 1, last = 3 }
header = { message = "LIST", count = "COUNT" }
messages = { objects = "PACKED" }
fields = { id = "O{object}_ID", x = "O{object}_X", y = "O{object}_Y" }
"""
)


def packed(*objects: tuple[float, float, int]) -> can.Message:
    data = b"".join(
        (round(100 * x) & 0xFFFF).to_bytes(2, "little")
        + (round(100 * y) & 0xFFFF).to_bytes(2, "little")
        + bytes([number])
        for x, y, number in objects
    )
    return message(PACKED, data.ljust(24, b"\0"))


class TestPacked:
    def test_several_objects_come_in_one_message(self, tmp_path: Path) -> None:
        """Five objects in two messages, the last place of the second unused."""
        decoder = decoder_of(tmp_path, MANY)
        objects = [(float(i), -float(i), 10 + i) for i in range(1, 6)]
        (cycle,) = feed(decoder, [header(5), packed(*objects[:3]), packed(*objects[3:])])
        assert cycle.complete
        assert cycle.object_id.tolist() == [11, 12, 13, 14, 15]
        np.testing.assert_allclose(cycle.position, [(x, y) for x, y, _ in objects])

    def test_a_sensor_may_always_send_as_many_messages(self, tmp_path: Path) -> None:
        fixed = MANY.replace('"PACKED"', '{ message = "PACKED", per_cycle = 3 }')
        messages = [header(2), packed((1, 0, 1), (2, 0, 2)), packed(), packed()]
        decoder = decoder_of(tmp_path, fixed)
        assert feed(decoder, messages[:3]) == []
        (cycle,) = feed(decoder, messages[3:], at_s=0.003)
        assert cycle.object_id.tolist() == [1, 2]

    def test_a_packed_message_cut_short_gives_the_objects_in_it(self, tmp_path: Path) -> None:
        cut = packed((1, 0, 1), (2, 0, 2), (3, 0, 3))
        cut.data = cut.data[:12]
        decoder = decoder_of(tmp_path, MANY)
        (cycle,) = feed(decoder, [header(3), cut])
        assert cycle.object_id.tolist() == [1, 2]
        assert decoder.counters.short == 1
