"""Each program on docs/use-predictions.md, run as it stands but for channel and port."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drives import DRIVES, first_seconds
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.output import can_output
from processes import PATIENCE_S, Serving, environment, eqrt, playing
from source_tree import ROOT

PAGE = (ROOT / "docs/use-predictions.md").read_text(encoding="utf-8")
DATAGRAMS, ON_CAN, LINES, LIBRARY = re.findall(
    r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL
)
NUMBER = r"-?\d+\.\d+"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A log and the DBC, as the page has them."""
    (tmp_path / "drive.log").write_text(first_seconds(DRIVES["ars408"].log, 3.0))
    dbc = Path(can_output.__file__).parent / "eqrt.dbc"
    (tmp_path / "eqrt.dbc").write_bytes(dbc.read_bytes())
    return tmp_path


def run_to_its_end(program: str, folder: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env=environment(),
        timeout=PATIENCE_S,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def heard_while_serving(program: str, folder: Path, channel: str, *options: str) -> str:
    """What a program prints that listens to a service, until it has told of an object."""
    on = ["--can", channel, "--can-interface", LOCAL, "--profile", "ars408", *options]
    command = [sys.executable, "-u", "-c", program]
    with (
        subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, cwd=folder, env=environment()
        ) as listening,
        Serving(*on),
        playing(folder / "drive.log", "--can", channel, "--loop"),
    ):
        assert listening.stdout is not None
        said = ""
        while "object " not in said and (line := listening.stdout.readline()):
            said += line
        listening.terminate()
    return said


def changed(program: str, old: str, new: str) -> str:
    assert old in program
    return program.replace(old, new)


def test_datagrams_are_read_by_a_program_beside_the_service(folder: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = changed(DATAGRAMS, "47310", str(port))
    to = f"--datagrams=127.0.0.1:{port}"
    said = heard_while_serving(program, folder, f"use-{time.monotonic_ns()}", to)
    assert re.search(r"^NO_(MAP|POSE): \d+ objects$", said, re.MULTILINE)
    assert re.search(rf"^  object \d+: in 3 s at {NUMBER}, {NUMBER} m$", said, re.MULTILINE)


def test_can_messages_are_read_with_cantools(folder: Path) -> None:
    channel = f"use-{time.monotonic_ns()}"
    program = changed(
        ON_CAN,
        'can.Bus(channel="can0", interface="socketcan", fd=True)',
        f"open_bus({channel!r}, {LOCAL!r})",
    )
    program = f"from eqrt.runtime.bus.buses import open_bus\n{program}"
    said = heard_while_serving(program, folder, channel)
    assert re.search(r"^NO_(MAP|POSE): \d+ objects$", said, re.MULTILINE)
    assert re.search(rf"^  object \d+: in 3000 ms at {NUMBER}, {NUMBER} m$", said, re.MULTILINE)


def test_lines_of_json_are_read_without_eqrt(folder: Path) -> None:
    (command,) = re.findall(r"^(eqrt replay .*)$", PAGE, re.MULTILINE)
    assert eqrt(*command.split()[1:], cwd=folder).returncode == 0
    said = run_to_its_end(LINES, folder)
    line = rf"\d+\.\d s NO_(MAP|POSE): object \d+ ends at {NUMBER}, {NUMBER} m"
    assert len(said) > 20
    assert all(re.fullmatch(line, one) for one in said)


def test_a_pipeline_is_used_as_a_library(folder: Path) -> None:
    said = run_to_its_end(LIBRARY, folder)
    assert len(said) > 20
    assert re.fullmatch(r"\d+\.\d s NO_MAP: [1-9]\d* objects", said[-1])
