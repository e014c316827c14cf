"""`eqrt` as a user runs it: in processes of its own, from an installation or this checkout."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

import can

from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.output.datagrams import decode_datagram
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from source_tree import ROOT

PATIENCE_S = 60.0  # for anything that a process should do at once
EQRT = [sys.executable, "-m", "eqrt"]


def environment(**more: str) -> dict[str, str]:
    """Ours, and the car's sources on the path, which are compiled once, as installed ones are."""
    ours = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return ours | {"PYTHONPATH": str(ROOT / "runtime")} | more


def eqrt(
    *arguments: str, cwd: Path | None = None, command: Sequence[str] = EQRT, **more: str
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; `command`: what to run instead of `eqrt`, `more` goes into its
    environment.
    """
    return subprocess.run(
        [*command, *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=cwd,
        env=environment(**more),
        timeout=PATIENCE_S,
    )


@contextlib.contextmanager
def files_of_at_most(max_bytes: int) -> Iterator[None]:
    """As on a disk that is full: this process writes no longer file, OSError. Unix only."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


class Serving:
    """`eqrt serve` in a process, from when it is ready; ended at the end of the `with` block."""

    def __init__(
        self,
        *arguments: str,
        command: Sequence[str] = EQRT,
        stderr: int = subprocess.PIPE,
        **more: str,
    ) -> None:
        """`command`: what to run instead of `eqrt`; `stderr`: a file for its errors; `more` goes
        into its environment.
        """
        self._process = subprocess.Popen(
            [*command, "serve", *arguments],
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            env=environment(**more),
        )
        self.ready = ""
        """The first line it printed."""

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def wait_until_ready(self) -> Self:
        """Wait until it listens; it says so."""
        self.ready = self._line()
        assert self.ready.startswith("eqrt serve: "), self.end()
        return self

    def read_until(self, pattern: str) -> str:
        """Read its output up to a line in which the pattern is: what its first group is there."""
        while line := self._line():
            if found := re.search(pattern, line):
                return found[1]
        raise AssertionError(self.end())

    def _line(self) -> str:
        """The next line, and nothing beyond it: what a stream takes along, `end` would not get."""
        assert self._process.stdout is not None
        line = b""
        while not line.endswith(b"\n") and (byte := os.read(self._process.stdout.fileno(), 1)):
            line += byte
        return line.decode()

    def stop_reading(self) -> None:
        """Close our end of its standard output."""
        assert self._process.stdout is not None
        self._process.stdout.close()

    def stop_reading_errors(self) -> None:
        """Close our end of its standard error."""
        assert self._process.stderr is not None
        self._process.stderr.close()

    def writer_pid(self) -> int:
        """The process that writes its recording."""
        children = Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text(encoding="utf-8")
        (writer,) = children.split()
        return int(writer)

    def send(self, number: signal.Signals) -> None:
        """A signal."""
        self._process.send_signal(number)

    def wait(self) -> int:
        """Its exit status, without reading anything of what it says; `end` does that."""
        return self._process.wait(PATIENCE_S)

    def end(self, by: signal.Signals = signal.SIGTERM) -> tuple[int, str, str]:
        """Tell it to end: exit status, the rest of its output, its errors."""
        self._process.send_signal(by)
        stdout, stderr = self._process.communicate(timeout=PATIENCE_S)
        return self._process.returncode, stdout, stderr

    def __enter__(self) -> Self:
        return self.wait_until_ready()

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()


def fill_pipe(pid: int, descriptor: int) -> int:
    """Fill the pipe that a process writes to, as one that nobody reads: bytes that it took."""
    pipe = os.open(f"/proc/{pid}/fd/{descriptor}", os.O_WRONLY | os.O_NONBLOCK)
    filled = 0
    with contextlib.suppress(BlockingIOError):
        while True:
            filled += os.write(pipe, b"\n")
    os.close(pipe)
    return filled


class Heard:
    """What comes on a channel of the local bus and at a port, gathered while it comes."""

    def __init__(self, channel: str, ids: Sequence[int] | None = None) -> None:
        self.messages: list[can.Message] = []
        self.forecasts: list[ForecastSet] = []
        self.statuses: list[ServiceStatus] = []
        self._bus = open_bus(channel, LOCAL, receive_ids=ids)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        self.address = f"127.0.0.1:{self._socket.getsockname()[1]}"
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=work) for work in (self._hear, self._receive)]

    def _hear(self) -> None:
        while not self._ended.is_set():
            if (message := self._bus.recv(0.05)) is not None:
                self.messages.append(message)

    def _receive(self) -> None:
        while not self._ended.is_set():
            with contextlib.suppress(TimeoutError):
                heard = decode_datagram(self._socket.recv(65_535))
                if isinstance(heard, ServiceStatus):
                    self.statuses.append(heard)
                else:
                    self.forecasts.append(heard.forecasts)

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._bus.shutdown()
        self._socket.close()


@contextlib.contextmanager
def playing(log: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """`eqrt play` on the local bus, in a process."""
    command = [*EQRT, "play", str(log), "--can-interface", LOCAL, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment()) as process:
        try:
            yield process
        finally:
            process.terminate()
