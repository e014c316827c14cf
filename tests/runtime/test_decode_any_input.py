"""Whatever comes over the bus: nothing raises, everything is counted, and sense comes back."""

from __future__ import annotations

import math
import random
from dataclasses import asdict

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_recordings import detections_of, feed_all, messages_of
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.profile import builtin_profiles, load_profile
from soundness import assert_sound

PROFILES = {name: load_profile(name) for name in builtin_profiles()}


@pytest.mark.parametrize("name", PROFILES)
@given(seed=st.integers(0, 2**32 - 1))
def test_any_message_is_taken(name: str, seed: int) -> None:
    """Ids of the profile and others, of both lengths; any data; errors, remote frames; any time."""
    chance = random.Random(seed)
    decoder, events = Decoder(PROFILES[name]), list[Event]()
    ids = [*sorted(decoder.arbitration_ids), chance.randrange(0x800)]
    for _ in range(chance.randrange(60)):
        time_s = chance.choice([chance.random(), chance.random(), math.nan, math.inf, -1e9])
        events += decoder.feed(any_message(chance, ids), time_s)
        events += decoder.poll(time_s)
    assert_sound(decoder, events)


def any_message(chance: random.Random, ids: list[int]) -> can.Message:
    length = chance.choice([0, chance.randrange(65), 8, 64])
    data = chance.choice(
        [chance.randbytes(length), bytes(length), b"\xff" * length, b"\1" * length]
    )
    message = can.Message(
        arbitration_id=chance.choice(ids),
        data=data,
        is_extended_id=chance.random() < 0.05,
        is_fd=length > 8,
        is_remote_frame=chance.random() < 0.05,
        is_error_frame=chance.random() < 0.05,
        channel=chance.choice([None, "can0", 1]),
    )
    message.dlc = chance.randrange(65)  # it may lie
    return message


@pytest.mark.parametrize(
    ("recording", "name"), [("ars408", "ars408"), ("rav4", "toyota-rav4"), ("srr520", "srr520")]
)
def test_a_damaged_recording_is_decoded_as_far_as_it_goes(recording: str, name: str) -> None:
    """One message in five lost, doubled, cut short, made longer, or with a bit flipped."""
    chance = random.Random(60)
    decoder = Decoder(PROFILES[name])
    damaged = [
        one for message in messages_of(recording)[:20_000] for one in damage(message, chance)
    ]
    events = feed_all(decoder, damaged)
    assert_sound(decoder, events)
    assert decoder.counters.objects > 0


def damage(message: can.Message, chance: random.Random) -> list[can.Message]:
    if chance.random() > 0.2:
        return [message]
    data = bytearray(message.data)
    kind = chance.choice(["lose", "double", "cut", "lengthen", "flip"])
    if kind == "lose":
        return []
    if kind == "cut":
        data = data[: chance.randrange(len(data) + 1)]
    elif kind == "lengthen":
        data += bytes(chance.randrange(1, 9))
    elif kind == "flip" and data:
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    changed = can.Message(
        timestamp=message.timestamp,
        arbitration_id=message.arbitration_id,
        is_extended_id=message.is_extended_id,
        channel=message.channel,
        data=data,
        is_fd=True,
    )
    return [message, changed] if kind == "double" else [changed]


def test_after_damage_the_next_whole_cycle_is_whole() -> None:
    """Half a cycle, without its header, then one that is complete."""
    messages = messages_of("ars408")
    headers = [i for i, message in enumerate(messages) if message.arbitration_id == 0x60A]
    start, end = headers[100] + 1, headers[102]
    cycles = detections_of(feed_all(Decoder(PROFILES["ars408"]), messages[start:end]))
    whole = detections_of(feed_all(Decoder(PROFILES["ars408"]), messages[headers[101] : end]))
    assert [cycle.object_id.tolist() for cycle in cycles] == [
        cycle.object_id.tolist() for cycle in whole
    ]
    assert cycles[-1].complete


def test_every_fate_of_a_message_has_its_counter() -> None:
    decoder = Decoder(PROFILES["toyota-rav4"], {"radar": "can1", "car": 0})
    track = next(m for m in messages_of("rav4") if m.arbitration_id == 0x210)

    def feed(**changes: object) -> None:
        values = {"arbitration_id": 0x210, "data": track.data, "channel": "can1"} | changes
        message = can.Message(**{"is_extended_id": False, **values})  # type: ignore[arg-type]
        decoder.feed(message, 0.0)

    feed()
    feed(data=bytes(8))  # the sum over id, length and data would be 0x12 + 0x08
    feed(data=track.data[:3])
    feed(arbitration_id=0x211, channel="can0")
    feed(arbitration_id=0x2FF)
    feed(arbitration_id=0x212, is_extended_id=True)
    feed(arbitration_id=0x212, is_remote_frame=True, data=None)
    feed(arbitration_id=0x212, is_error_frame=True)
    counters = {name: count for name, count in asdict(decoder.counters).items() if count}
    assert counters == {
        "messages": 8,
        "used": 3,
        "bad_checksum": 2,
        "short": 1,
        "wrong_bus": 1,
        "other_id": 1,
        "not_data": 3,
        "cycles": 2,
        "incomplete_cycles": 2,
        "objects": 1,
        "invalid_objects": 31,
    }
