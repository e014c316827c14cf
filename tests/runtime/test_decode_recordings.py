"""Real bytes of real sensors, decoded to what others decoded from them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from can_recordings import detections_of, feed_all, messages_of, rav4_array, srr520_objects
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import Detections, EgoMotion, ObjectClass, VelocityKind
from eqrt.runtime.decoding.profile import load_profile
from tiny_sensor import profile_of

Float64 = NDArray[np.float64]

RAV4_BUSES = {"radar": "can1", "car": "can0"}
TO_CENTER_M = 2.7  # the dataset's forward distances are from the middle of the car
COARSE_M = 0.04  # and without the two lowest bits, which its DBC did not know


@dataclass(frozen=True)
class Decoded:
    """A recording, through the decoder."""

    decoder: Decoder
    events: list[Event]

    @property
    def cycles(self) -> list[Detections]:
        return detections_of(self.events)

    @property
    def motions(self) -> list[EgoMotion]:
        return [event for event in self.events if isinstance(event, EgoMotion)]


def decoded(recording: str, decoder: Decoder) -> Decoded:
    return Decoded(decoder, feed_all(decoder, messages_of(recording)))


@pytest.fixture(scope="module")
def ars408() -> Decoded:
    return decoded("ars408", Decoder(load_profile("ars408")))


@pytest.fixture(scope="module")
def rav4() -> Decoded:
    return decoded("rav4", Decoder(load_profile("toyota-rav4"), RAV4_BUSES))


@pytest.fixture(scope="module")
def srr520() -> Decoded:
    return decoded("srr520", Decoder(load_profile("srr520")))


def test_ars408_has_5609_objects_in_2001_cycles(ars408: Decoded) -> None:
    cycles, counters = ars408.cycles, ars408.decoder.counters
    assert len(cycles) == counters.cycles == 2001
    assert sum(len(cycle.object_id) for cycle in cycles) == counters.objects == 5609
    assert all(cycle.complete for cycle in cycles)
    assert counters.messages == 24_878 == counters.used + counters.other_id
    assert (counters.incomplete_cycles, counters.invalid_objects, counters.bad_counter) == (0, 0, 0)


def test_the_first_ars408_object_is_as_calculated_by_hand(ars408: Decoded) -> None:
    """60B#5F5F2BCC80200193: 0x5F2B >> 3 is 3045, times 0.2, less 500, is 109 m; and so on."""
    first = ars408.cycles[0]
    assert first.object_id.tolist() == [0x5F]
    np.testing.assert_allclose(first.position, [[109.0, -10.2]], atol=1e-9)
    np.testing.assert_allclose(first.velocity, [[0.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose([first.length_m, first.width_m], [[2.0], [2.4]], atol=1e-9)
    assert first.object_class.tolist() == [ObjectClass.CAR]
    assert first.existence.tolist() == [1.0]
    assert first.is_new.tolist() == [False]
    assert first.velocity_kind is VelocityKind.RELATIVE
    assert (first.timestamp_s, first.received_s) == (1591372012.436348, 1591372012.438365)


def test_an_ars408_cycle_is_closed_by_its_last_message(ars408: Decoded) -> None:
    """Within 9 ms of its header, although the next header comes 70 ms later."""
    cycles = ars408.cycles
    assert max(cycle.received_s - cycle.timestamp_s for cycle in cycles) < 0.009
    assert min(np.diff([cycle.timestamp_s for cycle in cycles])) > 0.065


def crowded_ars408(step_s: float, period_s: float, lost: int | None = None) -> list[can.Message]:
    """The recording's first cycle with its object a hundred times, in 301 messages, four times."""
    recorded = messages_of("ars408")
    header, *parts = (
        next(one for one in recorded if one.arbitration_id == each) for each in range(0x60A, 0x60E)
    )
    messages = []
    for cycle in range(4):
        opening = bytes([100, 0, cycle, *header.data[3:]])
        bodies = [(part, bytes([i, *part.data[1:]])) for part in parts for i in range(100)]
        for place, (one, data) in enumerate([(header, opening), *bodies]):
            again = copy(one)
            again.data, again.timestamp = bytearray(data), cycle * period_s + place * step_s
            messages += [again] if place != lost else []
    return messages


@pytest.mark.parametrize("step_s", [0.00022, 0.00027])
def test_a_crowded_ars408_list_is_complete_however_long_it_takes(step_s: float) -> None:
    """Messages of 111 to 135 bits at 500 kbit/s: 67 to 81 ms."""
    decoder = Decoder(load_profile("ars408"))
    cycles = detections_of(feed_all(decoder, crowded_ars408(step_s, 0.09)))
    assert len(cycles) == 4
    for i, cycle in enumerate(cycles):
        assert cycle.complete
        assert cycle.object_id.tolist() == list(range(100))
        assert (cycle.object_class == ObjectClass.CAR).all()
        assert cycle.timestamp_s == pytest.approx(0.09 * i)
        assert cycle.received_s == pytest.approx(0.09 * i + 300 * step_s)
    assert (decoder.counters.incomplete_cycles, decoder.counters.stray) == (0, 0)


@pytest.mark.parametrize(("period_s", "told_s"), [(0.08, 0.08), (0.2, 0.105)])
def test_a_crowded_ars408_list_without_its_last_message_is_told_soon(
    period_s: float, told_s: float
) -> None:
    """With the next header, or 30 ms after the last message; and it is as old as its header."""
    decoder, waiting = Decoder(load_profile("ars408")), crowded_ars408(0.00025, period_s, lost=300)
    cycles: list[Detections] = []
    now_s = 0.0
    while not cycles:
        now_s += 0.001
        while waiting[0].timestamp < now_s:
            one = waiting.pop(0)
            cycles += detections_of(decoder.feed(one, one.timestamp))
        cycles += detections_of(decoder.poll(now_s))
    assert now_s == pytest.approx(told_s, abs=0.0011)
    (cycle,) = cycles
    assert (cycle.complete, cycle.timestamp_s) == (False, 0.0)
    assert np.flatnonzero(cycle.object_class != ObjectClass.CAR).tolist() == [99]


def test_rav4_radar_points_are_those_of_the_dataset(rav4: Decoded) -> None:
    """All 10,100: place, relative speed along the line of sight, slot, new-track flag."""
    cycles = rav4.cycles
    assert len(cycles) == 1200
    assert rav4.decoder.counters.objects == 10_100 == len(rav4_array("radar_value"))
    assert all(cycle.complete for cycle in cycles)
    np.testing.assert_allclose(points_of(cycles), dataset_points(), atol=1e-9)


def points_of(cycles: list[Detections]) -> Float64:
    """(D, 5) x, y, relative speed, arbitration id, new; slot by slot, each in order of time."""
    position = np.concatenate([cycle.position for cycle in cycles])
    velocity = np.concatenate([cycle.velocity for cycle in cycles])
    columns = [
        np.floor(position[:, 0] / COARSE_M + 1e-9) * COARSE_M + TO_CENTER_M,
        position[:, 1],
        (velocity * position).sum(axis=1) / np.hypot(*position.T),
        0x210 + np.concatenate([cycle.object_id for cycle in cycles]),
        np.concatenate([cycle.is_new for cycle in cycles]),
    ]
    time_s = np.repeat([c.timestamp_s for c in cycles], [len(c.object_id) for c in cycles])
    return np.column_stack(columns)[np.lexsort((time_s, columns[3]))]


def dataset_points() -> Float64:
    value, time_s = rav4_array("radar_value"), rav4_array("radar_t")
    return value[np.lexsort((time_s, value[:, 5]))][:, [0, 1, 2, 5, 6]]


def test_rav4_messages_are_whole(rav4: Decoded) -> None:
    """Not one of 24,174 checksums fails, and no cycle of the radar is missing."""
    counters = rav4.decoder.counters
    assert counters.used == 1200 * 16 + 2 * 4974 + 66
    assert counters.messages == counters.used + counters.other_id == 98_800
    assert (counters.bad_checksum, counters.bad_counter) == (0, 0)
    assert (counters.stray, counters.short) == (0, 0)


def test_rav4_speed_is_that_of_the_dataset(rav4: Decoded) -> None:
    speeds = [motion for motion in rav4.motions if motion.speed_mps is not None]
    decoded = np.array([(e.timestamp_s, e.speed_mps) for e in speeds], np.float64)
    np.testing.assert_allclose(decoded[:, 0], rav4_array("speed_t"), atol=1e-6)
    np.testing.assert_allclose(decoded[:, 1], rav4_array("speed_value")[:, 0], atol=1e-12)


def test_rav4_yaw_rate_is_positive_to_the_left(rav4: Decoded) -> None:
    """It follows the change of the GNSS course, counter-clockwise seen from above."""
    turns = [motion for motion in rav4.motions if motion.yaw_rate_rad_s is not None]
    times_s, up = rav4_array("frame_times"), rav4_array("frame_positions")[0]
    velocity = rav4_array("frame_velocities")
    before, after = velocity[:-20], velocity[20:]  # one second apart
    turned = (np.cross(before, after) @ up) / np.linalg.norm(up) / (before * after).sum(axis=1)
    rate = [
        np.mean([e.yaw_rate_rad_s for e in turns if start <= e.timestamp_s < start + 1.0])
        for start in times_s[:-20:20]
    ]
    assert np.corrcoef(turned[::20], rate)[0, 1] > 0.8


def test_a_role_on_another_channel_is_not_heard() -> None:
    decoder = Decoder(load_profile("toyota-rav4"), {"radar": "can0", "car": "can1"})
    assert feed_all(decoder, messages_of("rav4")) == []
    assert decoder.counters.wrong_bus == 1200 * 16 + 2 * 4974 + 66


PAIRS = """
description = "the same radar, both messages of every track"

[[sensor]]
name = "pairs"
bus = "radar"
dbc = "opendbc/toyota_adas.dbc"
framing = "slots"
slots = { first = 0, last = 15 }
timeout_s = 0.03
velocity = "radial"

[sensor.messages]
a = { message = "TRACK_A_{slot}", counter = "COUNTER" }
b = { message = "TRACK_B_{slot}", counter = "COUNTER" }

[sensor.fields]
x = "a.LONG_DIST"
y = { signal = "a.LAT_DIST", sign = -1 }
range_rate = "a.REL_SPEED"
existence = { signal = "b.SCORE", unit = "%" }
new_track = "a.NEW_TRACK == 1"
valid = "a.VALID == 1"
"""


def test_rav4_tracks_with_their_second_messages_are_the_same_points(tmp_path: Path) -> None:
    decoder = Decoder(profile_of(tmp_path, PAIRS), {"radar": "can1"})
    cycles = detections_of(feed_all(decoder, messages_of("rav4")))
    assert len(cycles) == 1200
    assert all(cycle.complete for cycle in cycles)
    np.testing.assert_allclose(points_of(cycles), dataset_points(), atol=1e-9)
    score = np.concatenate([cycle.existence for cycle in cycles])
    assert (score.min(), score.max()) == (0.0, 1.0)
    assert decoder.counters.bad_counter == 0


def test_srr520_has_the_40_objects_of_its_publisher(srr520: Decoded) -> None:
    (cycle,) = srr520.cycles
    truth = {key: [item[key] for item in srr520_objects()] for key in srr520_objects()[0]}
    assert cycle.complete
    assert cycle.object_id.tolist() == truth["object_id"]
    np.testing.assert_allclose(cycle.position.T, [truth["dist_x"], truth["dist_y"]], atol=1e-4)
    np.testing.assert_allclose(cycle.velocity.T, [truth["v_abs_x"], truth["v_abs_y"]], atol=1e-9)
    np.testing.assert_allclose(100 * cycle.existence, truth["score"], atol=1e-4)
    boxed = np.array(truth["box_valid"]) == 1
    for values, name in (
        (cycle.length_m, "box_length"),
        (cycle.width_m, "box_width"),
        (cycle.heading_rad, "orientation"),
    ):
        np.testing.assert_allclose(values, np.where(boxed, truth[name], np.nan), atol=1e-5)
    assert cycle.is_new.tolist() == [life <= 1 for life in truth["life_cycles"]]


def test_srr520_repeats_the_ego_motion_it_was_given(srr520: Decoded) -> None:
    (motion,) = srr520.motions
    assert motion.speed_mps == pytest.approx(6.78121, abs=1e-4)
    assert motion.yaw_rate_rad_s == pytest.approx(-0.0063293, abs=1e-6)
