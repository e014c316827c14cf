"""`eqrt top` in a real terminal, seen through a pseudo-terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import termios
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
from rich.console import Console, ConsoleDimensions

from crowd import crowd, cycles
from eqrt.cli import main
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.view.top import State, render
from processes import EQRT, PATIENCE_S, environment
from viewing import free_udp_port

ROWS, COLUMNS = 24, 80


class Terminal:
    """`eqrt top` in a terminal of its own."""

    def __init__(self, address: str) -> None:
        self._master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        self._slave = slave
        self.before = termios.tcgetattr(slave)
        self._process = subprocess.Popen(
            [*EQRT, "top", "--datagrams", address],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            env=environment(TERM="xterm-256color", COLUMNS="", LINES=""),
        )
        self._said = b""

    def press(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def wait_for(self, pattern: str) -> str:
        """The newest whole screen, once the pattern is on it."""
        end_s = time.monotonic() + PATIENCE_S
        while not re.search(pattern, screen := self.screen()):
            assert time.monotonic() < end_s, f"no {pattern!r} on the screen:\n{screen}"
        return screen

    def screen(self) -> str:
        """What is on the screen now: what came since the cursor last went home."""
        while select.select([self._master], [], [], 0.1)[0]:
            self._said += os.read(self._master, 1 << 16)
        screens = re.split(rb"\x1b\[H", self._said)
        self._said = b"\x1b[H".join(screens[-2:])
        return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screens[-1].decode(errors="replace"))

    def wait(self) -> int:
        return self._process.wait(timeout=PATIENCE_S)

    def settings(self) -> list[object]:
        return list(termios.tcgetattr(self._slave))

    def close(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._master)
        os.close(self._slave)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    """Before a service that sends a crowd of 12."""
    address = f"127.0.0.1:{free_udp_port()}"
    ended = threading.Event()

    def send() -> None:
        with DatagramPublisher([address]) as publisher:
            for forecast in cycles(12):
                if ended.is_set():
                    return
                publisher.publish(forecast)

    thread = threading.Thread(target=send)
    thread.start()
    terminal = Terminal(address)
    yield terminal
    ended.set()
    thread.join()
    terminal.close()


def test_the_table_shows_tracks_modes_and_how_the_service_is(terminal: Terminal) -> None:
    screen = terminal.wait_for(r"car +\d+\.\d +\d+\.\d +full history +\d+ +0\.00")
    assert "No map here: predicting without lanes" in screen
    assert "12 of 12 tracks" in screen
    lines = screen.splitlines()
    assert len(lines) <= ROWS
    assert max(map(len, lines)) <= COLUMNS


def test_p_pauses_and_f_filters_and_q_quits_and_leaves_the_terminal_as_it_was(
    terminal: Terminal,
) -> None:
    terminal.wait_for("12 of 12 tracks")
    terminal.press("p")
    held = terminal.wait_for("paused")
    time.sleep(0.5)
    assert table_of(terminal.screen() or held) == table_of(held)
    terminal.press("p")
    terminal.press("/bicycle\r")
    screen = terminal.wait_for(r'\d of 12 tracks with "bicycle"')
    assert "bicycle " in screen
    assert " car " not in screen
    terminal.press("\x1b")
    terminal.wait_for("12 of 12 tracks")
    terminal.press("s")
    terminal.wait_for("track v")
    terminal.press("q")
    assert terminal.wait() == 0
    assert terminal.settings() == terminal.before


def table_of(screen: str) -> list[str]:
    return [line.strip() for line in screen.splitlines() if "history" in line]


def test_before_anything_comes_it_says_what_to_run() -> None:
    terminal = Terminal(address := f"127.0.0.1:{free_udp_port()}")
    terminal.wait_for(f"eqrt serve ... --datagrams {address}")
    terminal.press("q")
    assert terminal.wait() == 0
    terminal.close()


def test_without_a_terminal_it_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["top"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("eqrt: eqrt top needs a terminal")
    assert error.count("\n") == 1


def test_while_a_filter_is_typed_letters_are_letters() -> None:
    state = State(address="here")
    for cycle in range(3):
        state.take(crowd(cycle, 64), 0.0)
    for key in "fqp":
        state.press(key)
    assert (state.ended, state.paused, state.pattern) == (False, False, "qp")
    assert state.shown() == []
    for key in ("\x7f", "\x7f", *"tru", "\r", "q"):
        state.press(key)
    assert state.pattern == "tru"
    assert state.ended
    assert {track.kind for track in state.shown()} == {"truck"}


def test_it_says_for_how_long_no_input_has_come() -> None:
    state = State(address="here")
    last = crowd(0, 3)
    for number in range(80):
        made_s = last.made_s + 0.3 + 0.1 * number
        silent = replace(last, cycle=1 + number, mode=Mode.SILENT, made_s=made_s)
        state.take(silent.targets(slice(0)), 0.0)
    console = Console(width=100, height=30)
    with console.capture() as capture:
        console.print(render(state, console.size, 0.0))
    assert "No input from the sensor: earlier predictions are void, for 8 s" in capture.get()


def test_the_nearest_track_comes_first_and_no_screen_is_too_small() -> None:
    state = State(address="here")
    state.take(crowd(0, 64), 0.0)
    ranges_m = [track.range_m for track in state.shown()]
    assert ranges_m == sorted(ranges_m)
    render(state, ConsoleDimensions(80, 3), 0.0)


def test_a_narrow_terminal_has_fewer_columns_and_none_is_cut() -> None:
    state = State(address="here")
    state.take(crowd(0, 12), 0.0)
    for width, last in ((80, "3s"), (66, "age ms"), (30, "range m v")):
        console = Console(width=width, height=30)
        with console.capture() as capture:
            console.print(render(state, console.size, 0.0))
        lines = capture.get().splitlines()
        heading = next(line for line in lines if line.lstrip().startswith("track"))
        assert heading.rstrip().endswith(last)
        assert "…" not in heading
        assert max(map(len, lines)) <= width
        assert lines[-1].startswith("q quit")
