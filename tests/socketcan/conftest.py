"""The machine with SocketCAN that these tests need."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from socketcan.machine import Completed
from socketcan.vcan import Launcher, NoCanKernelError, find_launcher

RunOnVcan = Callable[[Sequence[str], float], Completed]


@pytest.fixture(scope="session")
def launcher() -> Launcher:
    """Fails where tests must not be left out (CI is set), skips where a developer has no CAN."""
    try:
        return find_launcher()
    except NoCanKernelError as error:
        if os.environ.get("CI"):
            pytest.fail(str(error))
        pytest.skip(str(error))


@pytest.fixture
def run_on_vcan(launcher: Launcher, tmp_path: Path) -> RunOnVcan:
    """Runs a command to its end, on a machine with vcan0 and vcan1 up and vcan2 down."""
    return lambda command, timeout_s: launcher(command, tmp_path, timeout_s)
