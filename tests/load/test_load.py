"""No message is lost without being counted: `make load`, for a few seconds."""

from __future__ import annotations

import os
import time

from load.run import Buses, load


def buses(name: str) -> Buses:
    unique = f"{name}-{os.getpid()}-{time.monotonic_ns()}"
    return Buses(unique, f"{unique}-out")


def test_a_full_bus_is_read_to_the_last_message() -> None:
    found = load(buses("full"), 1000.0, 3.0, objects=10)
    assert (found.sent, found.read, found.lost) == (3000, 3000, 0)
    assert found.predicted > 100
    assert "lost" not in found.summary


def test_what_a_held_up_service_loses_is_counted_by_the_kernel_and_said() -> None:
    """To the message, while it goes on with those that it has."""
    found = load(buses("stall"), 15_000.0, 3.0, objects=10, stall_s=2.0)
    assert found.sent == 45_000
    assert found.lost > 0
    assert found.read > 100
    assert found.read + found.lost == found.sent
    assert f"{found.lost} messages lost to a full receive queue" in found.summary
