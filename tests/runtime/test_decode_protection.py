"""Checksums, counters and silence on the way in: what is used, and when a source is believed."""

from __future__ import annotations

import random
import re
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can
import cantools.database
import numpy as np
import pytest
from e2e import p05
from hypothesis import given, settings
from hypothesis import strategies as st

from can_recordings import detections_of, feed_all, messages_of
from drives import Car, object_list, shipped_predictor
from eqrt.core.errors import ProfileError
from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import Detections, EgoMotion
from eqrt.runtime.decoding.generic_objects import ListProtection, encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.protection.crc import crc_of
from eqrt.runtime.protection.e2e import Profile5, Sender
from eqrt.runtime.protection.source_health import (
    MAX_WRONG,
    MIN_RIGHT,
    SourceReport,
    SourceState,
)
from source_tree import ROOT
from tiny_sensor import (
    COUNTED,
    FIRST,
    GEAR,
    LIST,
    SLOTS,
    decoder_of,
    first,
    header,
    message,
    profile_of,
    second,
)

DECODING = ROOT / "runtime/eqrt/runtime/decoding"
DBCS, E2E_TOML = DECODING / "dbc", DECODING / "profiles" / "generic-e2e.toml"
E2E = load_profile("generic-e2e")
CARS = [Car(object_id=i + 1, x_m=10.0 * i, y_m=3.0 * i, speed_mps=1.0) for i in range(3)]
HEADER, POSITION, MOTION, EGO_MOTION = 0x5AB, 0x5AC, 0x5AD, 0x5A8
EGO_POSITION, EGO_YAW = 0x5A9, 0x5AA
CYCLE_S = 0.1
Cycle = list[can.Message]


def sent(count: int, cars: list[Car] = CARS) -> list[Cycle]:
    """Protected cycles of the generic list, with ego motion and pose."""
    protection = ListProtection()
    return [
        encode_cycle(
            object_list(cars, i * CYCLE_S),
            timestamp_s=i * CYCLE_S,
            counter=i % 256,
            speed_mps=5.0,
            yaw_rate_rad_s=0.1,
            map_from_ego=Pose2(1.0, 2.0, 0.5),
            message_s=0.0002,
            protection=protection,
        )
        for i in range(count)
    ]


def fed(decoder: Decoder, cycles: Iterable[Cycle]) -> list[Event]:
    return [event for cycle in cycles for event in feed_all(decoder, cycle)]


def report_of(decoder: Decoder, name: str = "generic-e2e") -> SourceReport:
    return next(source for source in decoder.sources if source.name == name)


def damaged(one: can.Message) -> can.Message:
    """The message with a flipped bit in its last byte."""
    data = bytearray(one.data)
    data[-1] ^= 1
    return can.Message(
        timestamp=one.timestamp,
        arbitration_id=one.arbitration_id,
        is_extended_id=one.is_extended_id,
        is_fd=one.is_fd,
        data=data,
    )


def changed(cycle: Cycle, change: Callable[[can.Message], list[can.Message]], *ids: int) -> Cycle:
    """The cycle with every message of these ids (of any, if none is given) put through `change`."""
    return [
        out
        for one in cycle
        for out in (change(one) if not ids or one.arbitration_id in ids else [one])
    ]


def lost(cycle: Cycle, arbitration_id: int, which: int = 0) -> Cycle:
    """The cycle without the nth message of an id."""
    there = [one for one in cycle if one.arbitration_id == arbitration_id]
    return [one for one in cycle if one is not there[which]]


class TestProtectedList:
    def test_it_says_the_same_as_the_plain_one(self) -> None:
        cycles = sent(12)
        events = fed(decoder := Decoder(E2E), cycles)
        plain = Decoder(load_profile("generic"))
        for i in range(12):
            told = fed(
                plain,
                [
                    encode_cycle(
                        object_list(CARS, i * CYCLE_S),
                        timestamp_s=i * CYCLE_S,
                        counter=i,
                        speed_mps=5.0,
                        yaw_rate_rad_s=0.1,
                        map_from_ego=Pose2(1.0, 2.0, 0.5),
                        message_s=0.0002,
                    )
                ],
            )
            for ours, theirs in zip(events[3 * i : 3 * i + 3], told, strict=True):
                if isinstance(ours, Detections):
                    assert isinstance(theirs, Detections)
                    assert ours.timestamp_s == theirs.timestamp_s
                    np.testing.assert_array_equal(ours.position, theirs.position)
                    np.testing.assert_array_equal(ours.velocity, theirs.velocity)
                else:
                    assert ours == theirs
        assert all(source.valid and not source.wrong for source in decoder.sources)
        assert [source.name for source in decoder.sources] == [
            "generic-e2e",
            "ego EGO_MOTION",
            "ego EGO_YAW",
        ]

    def test_without_protection_nothing_is_used(self) -> None:
        """The plain messages have other ids; with these ids, they have no right checksum."""
        decoder = Decoder(E2E)
        for cycle in sent(20):
            stripped = changed(
                cycle, lambda one: [message(one.arbitration_id, bytes(one.data[4:]))]
            )
            assert feed_all(decoder, stripped) == []
        assert decoder.counters.bad_checksum == decoder.counters.messages
        assert {source.state for source in decoder.sources} == {SourceState.WRONG}

    def test_a_message_of_another_id_is_not_taken_for_one_of_this(self) -> None:
        """Positions sent with the id of motions: the data id gives them away."""
        decoder, swap = Decoder(E2E), {POSITION: MOTION, MOTION: POSITION}
        for cycle in sent(20):
            for one in cycle:
                one.arbitration_id = swap.get(one.arbitration_id, one.arbitration_id)
            detections = detections_of(feed_all(decoder, cycle))
            assert all(len(one.object_id) == 0 for one in detections)
        assert decoder.counters.bad_checksum == 20 * 2 * len(CARS)
        assert report_of(decoder).state is SourceState.WRONG
        assert report_of(decoder, "ego EGO_MOTION").valid

    def test_all_ids_and_data_ids_move_with_the_offset(self, tmp_path: Path) -> None:
        text = E2E_TOML.read_text()
        profile = profile_of(
            tmp_path, text.replace("arbitration_id_offset = 0 ", "arbitration_id_offset = 16 ")
        )
        protection = ListProtection()
        cycle = encode_cycle(
            object_list(CARS, 0.0),
            timestamp_s=0.0,
            arbitration_id_offset=16,
            protection=protection,
        )
        (detections,) = feed_all(Decoder(profile), cycle)
        assert isinstance(detections, Detections)
        assert len(detections.object_id) == len(CARS)

    def test_the_page_about_profiles_says_how_to_send_it(self) -> None:
        """Its example protects as we do, and as the E2E library of somebody else checks."""
        text = (ROOT / "docs" / "profiles.md").read_text()
        (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
        names: dict[str, Any] = {}
        exec(example, names)
        counters: Counter[int] = Counter()
        for one in (one for cycle in sent(100) for one in cycle):
            count = counters[one.arbitration_id]
            assert names["protect"](bytes(one.data[4:]), one.arbitration_id, count) == one.data
            assert p05.e2e_p05_check(one.data, one.arbitration_id)
            counters[one.arbitration_id] += 1
        assert max(counters.values()) == 300

    def test_the_dbc_is_the_plain_one_behind_a_header(self) -> None:
        """As cantools reads both."""
        plain: Any = cantools.database.load_file(DBCS / "eqrt_objects.dbc")
        protected: Any = cantools.database.load_file(DBCS / "eqrt_objects_e2e.dbc")
        for theirs, ours in zip(plain.messages, protected.messages, strict=True):
            assert (ours.name, ours.frame_id) == (theirs.name, theirs.frame_id + 8)
            assert (ours.length, ours.is_fd) == (12, True)
            crc, counter, *signals = ours.signals
            assert (crc.start, crc.length, counter.start, counter.length) == (0, 16, 16, 8)
            assert crc.comment
            assert counter.comment
            for other, signal in zip(theirs.signals, signals, strict=True):
                assert signal.start == other.start + 32
                for key in ("name", "length", "is_signed", "scale", "unit", "choices", "comment"):
                    assert getattr(signal, key) == getattr(other, key), signal.name

    def test_a_longer_message_counts_as_far_as_the_dbc_goes(self) -> None:
        (cycle,) = sent(1)
        for one in cycle:
            one.data = one.data + b"\xff" * 4
        assert len(feed_all(Decoder(E2E), cycle)) == 3


class TestWhatOneFaultCosts:
    """A fault costs what it touches, one verdict, and nothing more."""

    @pytest.mark.parametrize("which", [0, 1, 2])
    @pytest.mark.parametrize("arbitration_id", [POSITION, MOTION])
    def test_a_lost_message(self, arbitration_id: int, which: int) -> None:
        cycles = sent(10)
        cycles[5] = lost(cycles[5], arbitration_id, which)
        decoder = Decoder(E2E)
        detections = detections_of(fed(decoder, cycles))
        assert len(detections) == 10
        assert [len(one.object_id) for one in detections].count(3) >= 9
        assert decoder.counters.bad_counter == 1
        assert report_of(decoder).wrong == 0  # most messages are right

    def test_a_lost_header(self) -> None:
        cycles = sent(10)
        cycles[5] = lost(cycles[5], HEADER)
        decoder = Decoder(E2E)
        assert len(detections_of(fed(decoder, cycles))) == 9
        assert report_of(decoder).wrong == 1

    def test_a_lost_cycle(self) -> None:
        cycles = sent(10)
        del cycles[5]
        decoder = Decoder(E2E)
        assert [len(one.object_id) for one in detections_of(fed(decoder, cycles))] == [3] * 9
        assert report_of(decoder).wrong == 1

    def test_a_damaged_header(self) -> None:
        cycles = sent(10)
        cycles[5] = changed(cycles[5], lambda one: [damaged(one)], HEADER)
        decoder = Decoder(E2E)
        assert len(detections_of(fed(decoder, cycles))) == 9
        assert report_of(decoder).wrong == 1

    def test_a_damaged_header_ends_the_cycle_before_which_is_told(self) -> None:
        cycles = sent(10)
        cycles[5] = lost(cycles[5], MOTION, 2)
        cycles[6] = changed(cycles[6], lambda one: [damaged(one)], HEADER)
        decoder = Decoder(E2E)
        for one in (one for cycle in cycles[:6] for one in cycle):
            decoder.feed(one, one.timestamp)
        told = [e for one in cycles[6] for e in decoder.feed(one, cycles[5][-1].timestamp)]
        (detections,) = detections_of(told)
        assert not detections.complete
        assert len(detections.object_id) == 3

    def test_a_damaged_cycle(self) -> None:
        cycles = sent(10)
        cycles[5] = changed(cycles[5], lambda one: [damaged(one)], POSITION, MOTION)
        decoder = Decoder(E2E)
        objects = [len(one.object_id) for one in detections_of(fed(decoder, cycles))]
        assert objects == [3] * 5 + [0] + [3] * 4
        assert report_of(decoder).wrong == 1

    @pytest.mark.parametrize("arbitration_id", [POSITION, MOTION, HEADER])
    def test_a_doubled_message(self, arbitration_id: int) -> None:
        """It takes no other object's place."""
        cycles = sent(10)
        cycles[5] = changed(cycles[5], lambda one: [one, one], arbitration_id)
        decoder = Decoder(E2E)
        detections = detections_of(fed(decoder, cycles))
        assert [len(one.object_id) for one in detections] == [3] * 10
        assert decoder.counters.bad_counter == (1 if arbitration_id == HEADER else 3)
        assert report_of(decoder).wrong == (arbitration_id == HEADER)

    def test_a_message_held_back_until_the_next_cycle(self) -> None:
        """It is not taken for one of that cycle."""
        cycles = sent(10)
        late = cycles[5].pop()
        late.timestamp = cycles[6][-1].timestamp
        cycles[6].insert(-1, late)
        decoder = Decoder(E2E)
        detections = detections_of(fed(decoder, cycles))
        assert [len(one.object_id) for one in detections] == [3] * 10
        assert np.isnan(detections[5].velocity[-1]).all()
        assert np.isfinite(detections[6].velocity).all()

    def test_a_cycle_repeated_as_a_whole(self) -> None:
        cycles = sent(10)
        cycles.insert(6, cycles[5])
        decoder = Decoder(E2E)
        assert len(detections_of(fed(decoder, cycles))) == 10
        assert report_of(decoder).wrong == 1
        # The header, the three about the ego and the first of either kind are known as old ones;
        # what follows these two is in sequence, but finds no open cycle.
        assert (decoder.counters.bad_counter, decoder.counters.stray) == (6, 4)


class TestHealth:
    def test_a_sensor_is_invalid_after_five_wrong_cycles_and_recovers(self) -> None:
        cycles = sent(20)
        for i in range(4, 12):
            cycles[i] = changed(cycles[i], lambda one: [damaged(one)], HEADER, POSITION, MOTION)
        decoder = Decoder(E2E)
        states = []
        for cycle in cycles:
            events = feed_all(decoder, cycle)
            states.append(report_of(decoder).state)
            assert sum(not isinstance(one, Detections) for one in events) == 2  # the ego goes on
        valid, wrong = SourceState.VALID, SourceState.WRONG
        assert states == (
            [valid] * 4 + [valid] * (MAX_WRONG - 1) + [wrong] * 4 + [wrong] * 2 + [valid] * 6
        )
        assert decoder.counters.refused_cycles == MIN_RIGHT - 1
        assert decoder.counters.cycles == 12
        assert report_of(decoder).since_s == pytest.approx(1.4, abs=0.05)

    def test_while_a_sensor_is_invalid_nothing_of_it_goes_on(self) -> None:
        """Its counter stands still, its checksums are right."""
        decoder = Decoder(load_profile("generic"))
        used = []
        for i in range(20):
            cycle = encode_cycle(object_list(CARS, 0.0), timestamp_s=i * CYCLE_S, counter=7)
            used.append(len(detections_of(feed_all(decoder, cycle))))
        assert used == [1] * MAX_WRONG + [0] * (20 - MAX_WRONG)
        assert decoder.counters.refused_cycles == 20 - MAX_WRONG
        assert decoder.counters.objects == 3 * MAX_WRONG

    def test_a_sender_that_hangs_is_found_out(self) -> None:
        """The same messages over and over: not one of them is used a second time."""
        (cycle,) = sent(1)
        decoder = Decoder(E2E)
        for i in range(20):
            for one in cycle:
                one.timestamp = i * CYCLE_S
            assert len(feed_all(decoder, cycle)) == (0 if i else 3)
        assert {source.state for source in decoder.sources} == {SourceState.WRONG}

    def test_silence_shows_when_time_passes_and_ends_with_the_next_cycle(self) -> None:
        """The sender has started again: any counter will do."""
        decoder = Decoder(E2E)
        fed(decoder, sent(5))
        decoder.poll(0.8)
        assert all(source.valid for source in decoder.sources)
        decoder.poll(1.0)
        assert {source.state for source in decoder.sources} == {SourceState.SILENT}
        for cycle in sent(3):
            for one in cycle:
                one.timestamp += 60.0
            assert len(feed_all(decoder, cycle)) == 3
        assert all(source.valid for source in decoder.sources)
        assert {(source.wrong, source.silences) for source in decoder.sources} == {(0, 1)}

    def test_an_ego_source_that_is_invalid_tells_nothing(self) -> None:
        cycles = sent(20)
        for i in range(3, 12):
            cycles[i] = lost(cycles[i], EGO_YAW) if i == 5 else cycles[i]
            cycles[i] = changed(cycles[i], lambda one: [damaged(one)], EGO_MOTION)
        decoder = Decoder(E2E)
        told = []
        for cycle in cycles:
            events = feed_all(decoder, cycle)
            told.append(sum(isinstance(one, EgoMotion) for one in events))
            assert len(detections_of(events)) == 1
        assert told == [1] * 3 + [0] * 9 + [0] * (MIN_RIGHT - 1) + [1] * 6
        assert decoder.counters.refused_ego == MIN_RIGHT - 1
        assert report_of(decoder, "ego EGO_MOTION").refused == MIN_RIGHT - 1
        assert report_of(decoder, "ego EGO_YAW").valid

    def test_an_ego_source_needs_all_of_its_messages(self) -> None:
        """The position is damaged, the yaw that comes with it is not: no pose is told any more."""
        cycles = sent(20)
        for i in range(3, 12):
            cycles[i] = changed(cycles[i], lambda one: [damaged(one)], EGO_POSITION)
        decoder = Decoder(E2E)
        states = []
        for cycle in cycles:
            feed_all(decoder, cycle)
            states.append(report_of(decoder, "ego EGO_YAW").state)
        valid, wrong = SourceState.VALID, SourceState.WRONG
        assert states == [valid] * (3 + MAX_WRONG - 1) + [wrong] * 7 + [valid] * 6

    def test_a_few_damaged_objects_in_every_cycle_cost_only_themselves(self) -> None:
        cycles = sent(20)
        for cycle in cycles:
            cycle[-1] = damaged(cycle[-1])
        decoder = Decoder(E2E)
        detections = detections_of(fed(decoder, cycles))
        assert [len(one.object_id) for one in detections] == [3] * 20
        assert all(np.isnan(one.velocity[-1]).all() for one in detections)
        assert decoder.counters.bad_checksum == 20


class TestMuchTraffic:
    """Recordings, and faults by chance."""

    @pytest.mark.parametrize("name", ["ars408", "rav4"])
    def test_recorded_sensors_are_valid_throughout(self, name: str) -> None:
        decoder = Decoder(load_profile({"rav4": "toyota-rav4"}.get(name, name)))
        feed_all(decoder, messages_of(name))
        heard = [source for source in decoder.sources if source.right]
        assert heard
        for source in heard:
            assert (source.wrong, source.refused) == (0, 0)

    @settings(deadline=None)  # two hundred messages on a machine that others use as well
    @given(seed=st.integers(0, 2**32 - 1))
    def test_whatever_is_damaged_lost_or_doubled_it_is_believed_again(self, seed: int) -> None:
        """After three whole cycles at most; nothing damaged is ever used."""
        chance = random.Random(seed)

        def fault(one: can.Message) -> list[can.Message]:
            return chance.choice([[one], [one], [], [damaged(one)], [one, one]])

        cycles = sent(16)
        bad = [changed(cycle, fault) for cycle in cycles[:12]]
        decoder = Decoder(E2E)
        for one in detections_of(fed(decoder, bad)):
            true = {car.object_id: car for car in CARS}
            for object_id, (x_m, y_m) in zip(one.object_id, one.position, strict=True):
                car = true[int(object_id)]
                assert y_m == pytest.approx(car.y_m)
                assert -0.01 <= x_m - car.x_m <= 1.2  # where it was in one of the cycles
        fed(decoder, cycles[12 : 12 + MIN_RIGHT + 1])
        assert all(source.valid for source in decoder.sources)


class TestPipeline:
    """What becomes of predictions when a source is not believed."""

    def modes(self, cycles: list[Cycle]) -> list[tuple[Mode, int]]:
        """(mode, objects) of what is said."""
        pipeline = Pipeline(E2E, shipped_predictor())
        said = []
        for one in (one for cycle in cycles for one in cycle):
            for made in pipeline.poll(one.timestamp) + pipeline.feed(one, one.timestamp):
                said.append((made.mode, made.num_targets))
        return said

    def test_without_a_believable_ego_nothing_is_predicted(self) -> None:
        cycles = sent(60)
        for i in range(20, 40):
            cycles[i] = changed(cycles[i], lambda one: [damaged(one)], EGO_MOTION, EGO_YAW)
        said = self.modes(cycles)
        assert said[15:20] == [(Mode.NO_MAP, 3)] * 5
        assert said[30:40] == [(Mode.NO_POSE, 0)] * 10
        assert said[-5:] == [(Mode.NO_MAP, 3)] * 5

    def test_without_a_believable_sensor_silence_is_said(self) -> None:
        cycles = sent(60)
        for i in range(20, 40):
            cycles[i] = changed(cycles[i], lambda one: [damaged(one)], POSITION, MOTION)
        said = self.modes(cycles)
        assert said[15:20] == [(Mode.NO_MAP, 3)] * 5
        assert said.count((Mode.SILENT, 0)) >= 10
        assert said[-5:] == [(Mode.NO_MAP, 3)] * 5


class TestProfileKeys:
    """What a profile can say about the protection of any sensor."""

    def test_crc16_at_the_end_in_either_order(self, tmp_path: Path) -> None:
        for order in ("little", "big"):
            text = COUNTED.replace(
                '"FIRST_00", counter = "COUNTER"',
                f'"FIRST_00", checksum = {{ kind = "crc16", order = "{order}", covers_id = true }}',
            )
            good, bad = first(1, 0, 1), first(2, 0, 2)
            for one in (good, bad):
                crc = crc_of(16, 0x1021, 0xFFFF, 0)(b"\x01\x10" + bytes(one.data))
                one.data += crc.to_bytes(2, "little" if order == "little" else "big")
            bad.data[0] ^= 4
            decoder = decoder_of(tmp_path, text)
            fed_in = [header(2), good, bad, second(1, 4.0), second(2, 4.0)]
            (cycle,) = detections_of([e for one in fed_in for e in decoder.feed(one, 0.0)])
            assert cycle.object_id.tolist() == [1]
            assert decoder.counters.bad_checksum == 1

    def test_a_counter_of_ego_messages(self, tmp_path: Path) -> None:
        """GEAR stands in for any signal that counts: repeated values are not used."""
        decoder = decoder_of(tmp_path, COUNTING_EGO)
        told = [
            len(decoder.feed(message(GEAR, bytes([n])), 0.02 * i))
            for i, n in enumerate([3, 4, 4, 5, 7, 6, 8, 9])
        ]
        assert told == [1, 1, 0, 1, 1, 0, 1, 1]
        assert decoder.counters.bad_counter == 4

    def test_a_counter_begins_again_behind_its_last_number_and_after_silence(
        self, tmp_path: Path
    ) -> None:
        """Eight bits. After more than half a second the sender may be one that has just started."""
        decoder = decoder_of(tmp_path, COUNTING_EGO)
        for at_s, counter in ((0.0, 255), (0.1, 0), (0.7, 100), (1.3, 100)):
            assert len(decoder.feed(message(GEAR, bytes([counter])), at_s)) == 1
        assert decoder.counters.bad_counter == 0

    def test_a_message_too_short_for_its_counter_tells_nothing(self, tmp_path: Path) -> None:
        decoder = decoder_of(tmp_path, COUNTING_EGO)
        told = [len(decoder.feed(message(GEAR, data), 0.0)) for data in (b"\3", b"", b"\5")]
        assert told == [1, 0, 1]
        assert (decoder.counters.bad_counter, decoder.counters.short) == (1, 1)

    def test_e2e_in_slots_with_a_data_id_each(self, tmp_path: Path) -> None:
        """A repeated slot takes no place in the next cycle; a sender that hangs is found out."""
        decoder = decoder_of(tmp_path, SLOTS_E2E)
        senders = [Sender(Profile5(data_id=FIRST + slot, offset=5)) for slot in range(4)]

        def cycle() -> Cycle:
            firsts = [first(slot + 1, 0, 0, slot=slot) for slot in range(4)]
            for slot, one in enumerate(firsts):
                one.data = bytearray(senders[slot].protect(one.data))
            return firsts

        messages = cycle()
        doubled = [messages[0], messages[0], *messages[1:]]
        (detections,) = detections_of([e for one in doubled for e in decoder.feed(one, 0.0)])
        assert detections.complete
        assert detections.object_id.tolist() == [0, 1, 2, 3]
        for i in range(MAX_WRONG):
            told = [e for one in messages for e in decoder.feed(one, 0.1 * (i + 1))]
            assert all(len(one.object_id) == 0 for one in detections_of(told))
        assert report_of(decoder, "tiny").state is SourceState.WRONG
        for i in range(MIN_RIGHT):
            told = [e for one in cycle() for e in decoder.feed(one, 0.1 * i + 0.7)]
        assert len(told) == 1

    def test_slots_whose_counters_cannot_be_read_are_not_compared_with_the_next(
        self, tmp_path: Path
    ) -> None:
        text = (
            SLOTS.replace(
                '"FIRST_{slot:02d}", counter = "COUNTER"',
                '"FIRST_{slot:02d}", counter = "COUNTER", checksum = { kind = "xor8" }',
            )
            .replace('second = "SECOND_{slot:X}"\n', "")
            .replace('length = "second.LENGTH"\n', "")
        )
        decoder = decoder_of(tmp_path, text)
        for i in range(3):
            for slot in range(4):
                one = first(slot, 0, 0, slot=slot, counter=i)
                one.data[7] = np.bitwise_xor.reduce(list(one.data[:7]))
                one.data[0] ^= i == 1
                decoder.feed(one, 0.1 * i)
        assert (decoder.counters.bad_checksum, decoder.counters.bad_counter) == (4, 0)
        assert report_of(decoder, "tiny").wrong == 1

    def test_a_damaged_header_without_a_count_begins_a_wrong_cycle(self, tmp_path: Path) -> None:
        text = SLOTS.replace(
            "[sensor.messages]",
            '[sensor.header]\nmessage = "LIST"\nchecksum = { kind = "xor8" }\n\n[sensor.messages]',
        )
        decoder = decoder_of(tmp_path, text)
        messages = [message(LIST, bytes([1, 0, 0, 0, 0, 0, 0, 2]))]
        messages += [first(i + 1, 0, 0, slot=i) for i in range(4)]
        messages += [second(0, 4.0, slot=i) for i in range(4)]
        assert [e for one in messages for e in decoder.feed(one, 0.0)] == []
        report = report_of(decoder, "tiny")
        assert (report.wrong, report.refused, report.state) == (1, 1, SourceState.WAITING)

    def test_silence_s(self, tmp_path: Path) -> None:
        slow = COUNTED.replace("timeout_s = 0.1", "timeout_s = 0.1\nsilence_s = 3.0")
        decoder = decoder_of(tmp_path, slow)
        decoder.feed(header(0), 0.0)
        decoder.poll(2.9)
        assert report_of(decoder, "tiny").valid
        decoder.poll(3.1)
        assert report_of(decoder, "tiny").state is SourceState.SILENT

    def test_a_sensor_with_a_long_timeout_is_not_silent_while_it_waits(
        self, tmp_path: Path
    ) -> None:
        profile = profile_of(tmp_path, COUNTED.replace("timeout_s = 0.1", "timeout_s = 2.0"))
        assert profile.sensor("tiny").silence_s == 4.0

    @pytest.mark.parametrize(
        ("checksum", "problem"),
        [
            ('kind = "e2e-p5", byte = 0', "byte does not go with kind = 'e2e-p5'"),
            ('kind = "e2e-p5", data_id = 65536', "data_id is 65536, not 0 to 65535"),
            ('kind = "e2e-p5", offset = 6', "offset is 6, and the header of 3 bytes must be in"),
            ('kind = "e2e-p5", offset = -1', "offset is -1"),
            ('kind = "sum8", order = "big"', "order does not go with kind = 'sum8'"),
            ('kind = "sum8", data_id = 1', "data_id does not go with kind = 'sum8'"),
            ('kind = "crc8", polynomial = 256', "polynomial is 256, not 0 to 255"),
            ('kind = "crc16", start = 65536', "start is 65536, not 0 to 65535"),
        ],
    )
    def test_what_makes_no_sense_is_refused(
        self, tmp_path: Path, checksum: str, problem: str
    ) -> None:
        text = COUNTED.replace(
            '"FIRST_00", counter = "COUNTER"', f'"FIRST_00", checksum = {{ {checksum} }}'
        )
        with pytest.raises(ProfileError, match=r"messages\.first\.checksum: " + problem):
            profile_of(tmp_path, text)

    def test_one_data_id_for_many_slots_is_refused(self, tmp_path: Path) -> None:
        text = SLOTS_E2E.replace("offset = 5", "offset = 5, data_id = 7")
        with pytest.raises(ProfileError, match="data_id is that of one message, and this has 4"):
            profile_of(tmp_path, text)

    @pytest.mark.parametrize("silence_s", [0.0, 0.1, 11.0])
    def test_a_silence_that_cannot_be_is_refused(self, tmp_path: Path, silence_s: float) -> None:
        text = COUNTED.replace("timeout_s = 0.1", f"timeout_s = 0.1\nsilence_s = {silence_s}")
        with pytest.raises(ProfileError, match="silence_s is"):
            profile_of(tmp_path, text)

    @pytest.mark.parametrize("silence_s", [0.0, 11.0])
    def test_so_is_that_of_an_ego(self, tmp_path: Path, silence_s: float) -> None:
        text = COUNTING_EGO.replace("[ego.fields]", f"silence_s = {silence_s}\n[ego.fields]")
        with pytest.raises(ProfileError, match="silence_s is"):
            profile_of(tmp_path, text)

    def test_a_counter_that_the_dbc_does_not_have_is_refused(self, tmp_path: Path) -> None:
        text = COUNTING_EGO.replace('counter = "GEAR"', 'counter = "ALIVE"')
        with pytest.raises(ProfileError, match=r"messages\.gear\.counter: .* no signal 'ALIVE'"):
            profile_of(tmp_path, text)


COUNTING_EGO = """
description = "a message that counts"

[[ego]]
bus = "car"
dbc = "tiny.dbc"
messages = { gear = { message = "GEAR", counter = "GEAR" } }

[ego.fields]
speed = { signal = "GEAR", unit = "m/s" }
"""

SLOTS_E2E = (
    SLOTS.replace(
        '"FIRST_{slot:02d}", counter = "COUNTER"',
        '"FIRST_{slot:02d}", checksum = { kind = "e2e-p5", offset = 5 }',
    )
    .replace('second = "SECOND_{slot:X}"\n', "")
    .replace('length = "second.LENGTH"\n', "")
    .replace('valid = "first.STATE != 0"\n', "")
)
