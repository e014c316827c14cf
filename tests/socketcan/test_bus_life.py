"""Channels that go down, vanish, fail and overflow, on the kernel's own CAN."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from socketcan.vcan import Launcher, program

LOST = re.compile(r"vcan\d is lost: (network is down|no such device)")  # first the one, then both
BACK = re.compile(r"vcan\d is (back|there) after \d+\.\d s")


@pytest.fixture(scope="module")
def found(launcher: Launcher, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What every scenario of programs/bus_life.py found, on one machine, by its name."""
    work = tmp_path_factory.mktemp("bus_life")
    done = launcher(program("bus_life.py"), work, 120.0)
    assert done.status == 0, done.stderr
    told: dict[str, Any] = {}
    for line in done.stdout.splitlines():
        told |= json.loads(line)
    return told


def test_a_message_is_read_and_sent_as_python_can_does_it(found: dict[str, Any]) -> None:
    """Of every kind, with its time; what we send ourselves does not come back."""
    told = found["messages"]
    assert told["read"] == [True] * 12
    assert told["sent"] == [True] * 11
    assert told["own"] == 0


def test_the_kernel_lets_through_what_was_asked_for(found: dict[str, Any]) -> None:
    """By id and its length, no remote frames; error frames always."""
    everything = ["123", "123X", "123 remote", "18FF1234X", "234", "123 FD", "error"]
    assert found["filters"] == {
        "all": everything,
        "some": ["123", "18FF1234X", "123 FD", "error"],
        "none": ["error"],
        "many": everything,  # more ids than the kernel takes
    }


def test_messages_that_find_the_queue_full_are_counted_exactly(found: dict[str, Any]) -> None:
    """Before and after the rest has been read; when there is room again, nothing is lost."""
    received = 0
    for told in found["overflow"]:
        received += told["received"]
        assert told["dropped_before_reading"] == told["dropped"] == told["sent"] - received
    assert [told["dropped"] > 0 for told in found["overflow"]] == [True] * 4
    assert found["overflow"][1]["dropped"] == found["overflow"][0]["dropped"]
    assert found["overflow"][3]["dropped"] == found["overflow"][2]["dropped"]


def test_a_channel_that_goes_down_is_opened_again_while_others_go_on(
    found: dict[str, Any],
) -> None:
    told = found["down_and_up"]
    assert told["before"] == ["vcan0 00000001"], "it had come before the channel went down"
    assert told["state"] == "DOWN"
    assert "is down; switch it on" in told["reason"]
    assert told["meanwhile"] == ["vcan1 00000002"]
    assert told["unsent"] == "CanOperationError"
    assert told["after"] == ["vcan0 00000004"]
    assert (told["resent"], told["arrived"]) == ("sent", True)
    assert (told["losses"], told["reconnects"]) == ([1, 0], [1, 0])
    lost, back = told["said"]
    assert lost == "vcan0 is lost: network is down"
    assert BACK.fullmatch(back)


def test_a_channel_that_is_removed_is_taken_up_when_it_is_there_again(
    found: dict[str, Any],
) -> None:
    """With its filters, and as what it is now: first classic CAN, then CAN FD."""
    told = found["gone_and_back"]
    assert told["states"] == ["CAN_FD", "DOWN", "CAN_20", "DOWN", "CAN_FD"]
    assert told["heard"] == ["vcan0 01", "vcan0 01"]
    assert all(map(LOST.fullmatch, told["said"][::2]))
    assert all(map(BACK.fullmatch, told["said"][1::2]))


def test_error_frames_tell_the_state_and_are_no_messages(found: dict[str, Any]) -> None:
    told = found["error_frames"]
    passive, off = "ERROR_PASSIVE", "BUS_OFF"
    states = ["UP", passive, passive, off, "UP", passive, "UP", "UP", off, "UP"]
    assert told["states"] == states
    assert told["heard"] == ["vcan0 00000001"]
    assert (told["error_frames"], told["bus_offs"], told["overruns"]) == (9, 2, 1)
    assert told["losses"] == 0
    assert all("bus-off" in line and "restart-ms" in line for line in told["said"][::2])
    assert all(map(BACK.fullmatch, told["said"][1::2]))
    assert len(told["said"]) == 4


def test_channels_that_come_later_are_waited_for(found: dict[str, Any]) -> None:
    told = found["waited_for"]
    assert told["states"] == ["UP", "DOWN", "DOWN"]
    assert told["heard"] == ["vcan0 00000001", "vcan2 00000002", "vcan5 00000002"]
    *waiting, one, other = told["said"]
    assert [line.partition(":")[0] for line in waiting] == [
        "waiting for vcan2",
        "waiting for vcan5",
    ]
    assert BACK.fullmatch(one)
    assert BACK.fullmatch(other)


def test_the_local_bus_outlives_its_network(found: dict[str, Any]) -> None:
    """`lo` is switched off and on."""
    assert found["loopback"] == {"heard": [True, False, True], "said": []}
