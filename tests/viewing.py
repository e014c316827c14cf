"""`eqrt view` as a user runs it, and where its screenshots go."""

from __future__ import annotations

import contextlib
import itertools
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from drives import Drive
from eqrt.runtime.bus.buses import LOCAL
from processes import EQRT, PATIENCE_S, Heard, Serving, environment, playing
from source_tree import ROOT

ARTIFACTS = ROOT / ".artifacts"
"""What a run leaves to look at: git-ignored, kept by CI."""
CHANNELS = (f"view-{number}-{time.monotonic_ns()}" for number in itertools.count())


class Viewing:
    """`eqrt view` in a process, from when it serves; ended at the end of the `with` block."""

    def __init__(self, *arguments: str, port: int = 0) -> None:
        self.datagrams = f"127.0.0.1:{free_udp_port()}"
        """Where it listens, unless it shows a file."""
        if not arguments or arguments[0].startswith("--"):
            arguments = (*arguments, "--datagrams", self.datagrams)
        self.process = subprocess.Popen(
            [*EQRT, "view", *arguments, "--port", str(port)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
        )
        self.ready = self.address = ""

    @property
    def host(self) -> str:
        """HOST:PORT of the page."""
        return self.address.removeprefix("http://").rstrip("/")

    def end(self, by: signal.Signals = signal.SIGTERM) -> tuple[int, str, str]:
        """Tell it to end: exit status, the rest of its output, its errors."""
        self.process.send_signal(by)
        stdout, stderr = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, stdout, stderr

    def __enter__(self) -> Viewing:
        assert self.process.stdout is not None
        self.ready = self.process.stdout.readline()
        assert self.ready.startswith("eqrt view: http://"), self.end()
        self.address = self.ready.split()[2]
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()


@contextlib.contextmanager
def watched(drive: Drive, log: Path) -> Iterator[tuple[Viewing, Heard, Serving]]:
    """The demo's recording played in a loop to a service that a view and a listener follow."""
    channel = next(CHANNELS)
    can = ["--can", channel, "--can-interface", LOCAL]
    with contextlib.ExitStack() as stack:
        viewing = stack.enter_context(Viewing())
        heard = stack.enter_context(Heard(channel, []))
        to = [f"--datagrams={address}" for address in (viewing.datagrams, heard.address)]
        serving = stack.enter_context(Serving(*can, *drive.options, *to, "--quiet"))
        stack.enter_context(playing(log, "--can", channel, "--loop"))
        yield viewing, heard, serving


def free_udp_port() -> int:
    """A port that nobody listens at now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def artifact(name: str) -> Path:
    """Where a screenshot goes."""
    ARTIFACTS.mkdir(exist_ok=True)
    return ARTIFACTS / name
