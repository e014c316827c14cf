"""What comes of predictions on a bus that is as slow, and has as little room, as a real one."""

from __future__ import annotations

import json
from typing import Any

import pytest

from socketcan.vcan import Launcher, program

CYCLES, OBJECTS, CARS = 10, 32, 6  # of programs/slow_bus.py


@pytest.fixture(scope="module")
def found(launcher: Launcher, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What programs/slow_bus.py found."""
    done = launcher(program("slow_bus.py"), tmp_path_factory.mktemp("slow_bus"), 180.0)
    assert done.status == 0, done.stderr
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def test_a_cycle_is_sent_whole_though_the_interface_has_room_for_ten(found: dict[str, Any]) -> None:
    """130 classic messages, or 33 CAN FD ones."""
    classic = {"6E2": 1, "6E3": 1, "6E4": OBJECTS, "6E5": 3 * OBJECTS}
    assert found["classic"] == {"cycles": [classic] * CYCLES, "failed": 0}
    assert found["fd"] == {"cycles": [{"6E0": 1, "6E1": OBJECTS}] * CYCLES, "failed": 0}


def test_a_bus_too_slow_for_all_carries_the_status_and_whole_objects(found: dict[str, Any]) -> None:
    """What is left when the next cycle comes is given up, and counted."""
    told = found["too slow"]
    came = 0
    for cycle in told["cycles"]:
        assert (cycle["6E2"], cycle["6E3"]) == (1, 1)
        assert 0 < cycle["6E4"] < OBJECTS
        assert 0 <= 3 * cycle["6E4"] - cycle["6E5"] <= 3  # the last object may be cut short
        came += sum(cycle.values())
    assert came + told["failed"] == CYCLES * (2 + 4 * OBJECTS)


def test_a_service_sends_all_while_it_waits_for_messages(found: dict[str, Any]) -> None:
    """26 messages after each object list; those that a busy machine was too slow for aside."""
    answers = found["serve"]["answers"]
    assert len(answers) > CYCLES / 2
    assert answers == [[1, CARS, 3 * CARS]] * len(answers)
    assert found["serve"]["status"] == 0
