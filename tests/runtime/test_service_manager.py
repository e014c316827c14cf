"""What `eqrt serve` tells the service manager that started it, over a real socket."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drives import Car, cycle
from eqrt.core.frames import Pose2
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.operation.service_manager import ServiceManager
from processes import PATIENCE_S, Heard, Serving
from source_tree import ROOT


class Manager:
    """The socket of a service manager, and what came to it."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(f"\0{address[1:]}" if address.startswith("@") else address)
        self._socket.settimeout(0.05)
        self.said: list[str] = []

    def hear(self, done: Callable[[], bool], patience_s: float = PATIENCE_S) -> None:
        give_up_s = time.monotonic() + patience_s
        while not done():
            assert time.monotonic() < give_up_s, self.said
            self.hear_once()

    def hear_once(self) -> None:
        try:
            self.said.append(self._socket.recv(4096).decode())
        except TimeoutError:
            return

    def hear_what_waits(self) -> None:
        self._socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self.said.append(self._socket.recv(4096).decode())
        self._socket.settimeout(0.05)

    def count(self, line: str) -> int:
        return self.said.count(line)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, Manager]]:
    address = str(tmp_path / "notify") if request.param == "path" else f"@eqrt-{os.getpid()}"
    made = Manager(address)
    yield address, made
    made.close()


def options(channel: str, *more: str) -> list[str]:
    return ["--can", channel, "--can-interface", LOCAL, "--profile", "generic", "--quiet", *more]


def test_the_manager_hears_of_start_reload_and_end_and_the_watchdog_on_a_silent_bus(
    manager: tuple[str, Manager],
) -> None:
    address, heard = manager
    channel = f"manager-{time.monotonic_ns()}"
    with Serving(*options(channel), NOTIFY_SOCKET=address, WATCHDOG_USEC="800000") as service:
        heard.hear(lambda: heard.count("WATCHDOG=1") >= 8)
        assert heard.said[0] == "READY=1"
        heard.hear(lambda: any(line.startswith("STATUS=no object cycle") for line in heard.said))
        begun_us = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
        os.kill(service.pid, signal.SIGHUP)
        heard.hear(lambda: heard.count("READY=1") == 2)
        (reloading,) = (line for line in heard.said if line.startswith("RELOADING=1\n"))
        usec = int(reloading.removeprefix("RELOADING=1\nMONOTONIC_USEC="))
        assert begun_us <= usec <= begun_us + 1e6 * PATIENCE_S
        status, _, stderr = service.end()
        heard.hear(lambda: "STOPPING=1" in heard.said)
    assert (status, stderr) == (0, "")
    assert "STOPPING=1" in heard.said[-2:]


def test_the_units_reload_ends_after_the_service_has_told_that_it_begins(
    manager: tuple[str, Manager],
) -> None:
    """Else systemd takes the reload for done: it looks when the last command has ended."""
    address, heard = manager
    unit = (ROOT / "deploy/eqrt.service").read_text(encoding="utf-8")
    commands = re.findall(r"^ExecReload=(.+)$", unit, re.MULTILINE)
    channel = f"manager-{time.monotonic_ns()}"
    with Serving(*options(channel), NOTIFY_SOCKET=address) as service:
        heard.hear(lambda: heard.count("READY=1") == 1)
        for times in range(1, 7):
            for command in commands:
                subprocess.run(command.replace("$MAINPID", str(service.pid)).split(), check=True)
            heard.hear_what_waits()
            assert sum(line.startswith("RELOADING=1\n") for line in heard.said) == times
            heard.hear(lambda: heard.count("READY=1") == times + 1)  # noqa: B023 (called at once)


def test_a_watchdog_of_another_process_is_not_fed(manager: tuple[str, Manager]) -> None:
    """$WATCHDOG_PID says whose it is (sd_watchdog_enabled(3))."""
    address, heard = manager
    channel = f"manager-{time.monotonic_ns()}"
    with Serving(
        *options(channel), NOTIFY_SOCKET=address, WATCHDOG_USEC="400000", WATCHDOG_PID="1"
    ):
        heard.hear(lambda: sum(line.startswith("STATUS=") for line in heard.said) >= 2)
    assert heard.count("WATCHDOG=1") == 0


HANGING = [
    sys.executable,
    "-c",
    """
import sys, time
import eqrt.runtime.pipeline as pipeline
from eqrt.cli import main
guard = pipeline.guard
runs = []
def hang(*what, **more):
    runs.append(1)
    if len(runs) > 20:
        time.sleep(3600)
    return guard(*what, **more)
pipeline.guard = hang
sys.exit(main(sys.argv[1:]))
""",
]


def test_a_loop_that_hangs_starves_the_watchdog(manager: tuple[str, Manager]) -> None:
    """While cycles are completed it is fed; from the one that does not end on, never again."""
    address, heard = manager
    channel = f"manager-{time.monotonic_ns()}"
    with (
        Heard(channel, []) as out,
        Serving(
            *options(channel, "--datagrams", out.address),
            command=HANGING,
            NOTIFY_SOCKET=address,
            WATCHDOG_USEC="400000",
        ),
        open_bus(channel, LOCAL, receive_ids=[]) as bus,
    ):
        fed = []
        for step in range(50):
            for message in cycle([Car(object_id=1, x_m=5.0, y_m=0.0)], step / 10, pose=Pose2()):
                bus.send(message)
            heard.hear_once()
            heard.hear_once()
            fed.append((len(out.forecasts), heard.count("WATCHDOG=1")))
    made, feeds = zip(*fed, strict=True)
    assert made[-1] < 35
    assert feeds[-1] > 5
    assert feeds[-1] == feeds[-10]


def test_without_a_manager_nothing_is_said_and_with_one_that_is_gone_nothing_fails(
    tmp_path: Path,
) -> None:
    for manager in (ServiceManager.of({}), ServiceManager(str(tmp_path / "gone"), 1.0)):
        with manager:
            manager.ready()
            manager()
            manager.reload(True)
