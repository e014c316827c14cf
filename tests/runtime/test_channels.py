"""`--can`: which channel is which of a profile's buses."""

from __future__ import annotations

import pytest

from eqrt.core.errors import UsageError
from eqrt.runtime.bus.channels import parse_channels

ROLES = ("radar", "car")


def test_one_channel_is_every_bus() -> None:
    assert parse_channels(["vcan0"], ROLES) == {"radar": "vcan0", "car": "vcan0"}


def test_every_bus_can_have_a_channel_of_its_own() -> None:
    channels = parse_channels(["car=can0", "radar=can1"], ROLES)
    assert channels == {"radar": "can1", "car": "can0"}


def test_the_channel_without_a_role_is_for_the_others() -> None:
    assert parse_channels(["can0", "radar=can1"], ROLES) == {"radar": "can1", "car": "can0"}
    assert parse_channels(["radar=can1", "can0"], ROLES) == {"radar": "can1", "car": "can0"}


def test_two_buses_may_share_a_channel() -> None:
    assert parse_channels(["car=can0", "radar=can0"], ROLES) == {"radar": "can0", "car": "can0"}


def test_without_options_no_bus_has_a_channel() -> None:
    assert parse_channels([], ROLES) == {}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([""], "--can '' names no channel; write CHANNEL or ROLE=CHANNEL"),
        (["radar="], "--can 'radar=' names no channel"),
        (["=can0"], "--can '=can0' names no channel"),
        (["can0", "can1"], "say what each is: --can radar=CHANNEL --can car=CHANNEL"),
        (["lidar=can0"], "--can lidar=can0: the profile has no bus 'lidar', only radar, car"),
        (["radar=can0"], "no channel for the bus 'car'; add --can car=CHANNEL"),
        (["radar=can0", "radar=can1"], "--can radar=can1: the bus 'radar' already is 'can0'"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: list[str], said: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_channels(options, ROLES)
    assert said in str(caught.value)
