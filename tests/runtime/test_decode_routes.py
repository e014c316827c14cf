"""From the bus to what takes a message: several may, each on its own bus."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_recordings import detections_of
from eqrt.core.errors import UsageError
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import EgoMotion
from eqrt.runtime.decoding.profile import Profile
from tiny_sensor import COUNTED, EGO, GEAR, first, header, message, profile_of, second

EGOS = """
description = "two buses that carry the same message, and a gear"

[[ego]]
bus = "left"
dbc = "tiny.dbc"
messages = { wheels = "EGO" }
fields = { speed = "LEFT" }

[[ego]]
bus = "right"
dbc = "tiny.dbc"
messages = { wheels = "EGO" }
fields = { speed = "RIGHT" }

[[ego]]
bus = "right"
dbc = "tiny.dbc"
messages = { gear = "GEAR" }
fields = { speed = { signal = "GEAR", unit = "m/s" } }
"""
SENSOR = COUNTED.partition('name = "tiny"')[2]
TWINS = f'{COUNTED}\n[[sensor]]\nname = "twin"{SENSOR}'
WHEELS = (360).to_bytes(2, "little") + (720).to_bytes(2, "little") + bytes(4)  # 36 and 72 km/h


@pytest.fixture
def egos(tmp_path: Path) -> Profile:
    return profile_of(tmp_path, EGOS)


@pytest.fixture
def twins(tmp_path: Path) -> Profile:
    return profile_of(tmp_path, TWINS)


def speeds(events: list[Event]) -> list[float]:
    return [round(event.speed_mps or 0.0) for event in events if isinstance(event, EgoMotion)]


def test_all_that_a_message_is_for_take_it(egos: Profile) -> None:
    decoder = Decoder(egos)
    assert speeds(decoder.feed(message(EGO, WHEELS), 0.0)) == [10, 20]
    assert (decoder.counters.messages, decoder.counters.used) == (1, 1)


@pytest.mark.parametrize(
    ("channel", "told"), [("can0", [10]), ("can1", [20]), (None, [10, 20]), ("can2", [])]
)
def test_a_message_is_for_those_on_its_bus(
    egos: Profile, channel: str | None, told: list[int]
) -> None:
    decoder = Decoder(egos, {"left": "can0", "right": "can1"})
    assert speeds(decoder.feed(message(EGO, WHEELS, channel=channel), 0.0)) == told
    assert (decoder.counters.used, decoder.counters.wrong_bus) == (bool(told), not told)


def test_all_ids_of_a_profile_are_said_whatever_their_bus(egos: Profile) -> None:
    assert set(Decoder(egos).arbitration_ids) == {EGO, GEAR}


def test_two_sensors_that_send_alike_both_tell(twins: Profile) -> None:
    decoder = Decoder(twins)
    messages = [header(1), first(1, 0, 7), second(7, 4.0)]
    told = detections_of([event for one in messages for event in decoder.feed(one, 0.0)])
    assert [cycle.sensor for cycle in told] == ["tiny", "twin"]
    assert [source.name for source in decoder.sources] == ["tiny", "twin"]


def test_two_sensors_that_have_waited_too_long_both_tell(twins: Profile) -> None:
    decoder = Decoder(twins)
    for one in (header(1), first(1, 0, 7)):
        decoder.feed(one, 0.0)
    assert [cycle.sensor for cycle in detections_of(decoder.poll(1.0))] == ["tiny", "twin"]
    assert (decoder.counters.cycles, decoder.counters.incomplete_cycles) == (2, 2)


def test_every_message_has_one_fate(egos: Profile) -> None:
    """One of another bus, two that hold no data, one of another id, one that is used; all twice."""
    decoder = Decoder(egos, {"left": "can0", "right": "can1"})
    for _ in range(2):
        decoder.feed(message(EGO, WHEELS, channel="can2"), 0.0)
        decoder.feed(message(EGO, b"", channel="can0", is_remote_frame=True), 0.0)
        decoder.feed(message(EGO, WHEELS, channel="can0", is_error_frame=True), 0.0)
        decoder.feed(message(0x7FF, WHEELS, channel="can0"), 0.0)
        decoder.feed(message(EGO, WHEELS[:3], channel="can1"), 0.0)
    counters = decoder.counters
    assert (counters.messages, counters.used, counters.short) == (10, 2, 2)
    assert (counters.wrong_bus, counters.not_data, counters.other_id) == (2, 4, 2)


@pytest.mark.parametrize("channel", ["0", 0])
def test_a_numbered_channel_may_be_spelled_as_text(egos: Profile, channel: str | int) -> None:
    """Logs and interfaces differ in whether a channel is 0 or '0'; some do not say."""
    decoder = Decoder(egos, {"left": channel, "right": "can1"})
    for spelled in ("0", 0, None):
        assert 10 in speeds(decoder.feed(message(EGO, WHEELS, channel=spelled), 0.0))
    assert speeds(decoder.feed(message(EGO, WHEELS, channel=1), 0.0)) == []


@pytest.mark.parametrize(
    ("channels", "problem"),
    [
        ({"left": "can0"}, "no channel for its bus 'right'"),
        ({"left": "can0", "right": "can1", "rear": "can2"}, "no bus 'rear'"),
    ],
)
def test_what_is_wrong_with_channels_is_said_with_what_to_do(
    egos: Profile, channels: dict[str, str | int], problem: str
) -> None:
    with pytest.raises(UsageError) as refusal:
        Decoder(egos, channels)
    assert str(refusal.value) == (
        f"the profile {egos.name!r} has {problem}; give --can left=CHANNEL --can right=CHANNEL, "
        "or one channel for everything: --can CHANNEL"
    )
