"""A full SocketCAN bus: what the kernel delivers is read, what it does not is counted."""

from __future__ import annotations

import re
import sys

import pytest

from socketcan.conftest import RunOnVcan

OUTCOME = re.compile(r"sent (\d+), read (\d+), lost (\d+), unexplained (-?\d+);")


@pytest.mark.parametrize(
    ("rate", "seconds", "stall", "loses"), [("500", "4", "0", False), ("9000", "3", "2.5", True)]
)
def test_sent_is_read_or_lost(
    rate: str, seconds: str, stall: str, loses: bool, run_on_vcan: RunOnVcan
) -> None:
    """With and without a service that is held up for longer than the receive queue lasts."""
    options = ["--rate", rate, "--seconds", seconds, "--stall", stall, "--objects", "10"]
    buses = ["--can", "vcan0", "--out-can", "vcan1", "--interface", "socketcan"]
    done = run_on_vcan([sys.executable, "-m", "load.run", *options, *buses], 120.0)
    found = OUTCOME.search(done.stdout)
    assert found, done.stderr
    sent, read, lost, unexplained = map(int, found.groups())
    assert sent == float(rate) * float(seconds)
    assert unexplained == 0
    assert read > 0
    assert (lost > 0) is loses
    assert done.status == int(loses)
