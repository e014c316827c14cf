"""What is in deploy/ for systemd, judged by systemd, and what the service does on the system."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from eqrt.runtime.bus.buses import LOCAL
from installed import needed
from processes import EQRT, Serving
from source_tree import ROOT

UNIT = ROOT / "deploy/eqrt.service"
MAX_EXPOSURE = 2.0


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit as it would be installed, but for the program, which is not there."""
    text = UNIT.read_text(encoding="utf-8")
    assert "ExecStart=/opt/eqrt/bin/eqrt serve --config /etc/eqrt/eqrt.toml\n" in text
    path = tmp_path / "eqrt.service"
    path.write_text(text.replace("/opt/eqrt/bin/eqrt", "/bin/true"), encoding="utf-8")
    return path


@pytest.fixture
def drop_in(unit: Path) -> Path:
    """The unit with the rights that real-time settings need."""
    text = (ROOT / "deploy/realtime.conf").read_text(encoding="utf-8")
    unit.write_text(f"{unit.read_text(encoding='utf-8')}\n{text}", encoding="utf-8")
    return unit


@pytest.mark.parametrize("name", ["unit", "drop_in"])
def test_systemd_understands_every_line_of_the_unit(
    name: str, request: pytest.FixtureRequest
) -> None:
    path = request.getfixturevalue(name)
    done = run(needed("systemd-analyze", "systemd"), "verify", str(path))
    told = [line for line in done.stderr.splitlines() if "eqrt.service" in line]
    assert (done.returncode, told) == (0, [])


@pytest.mark.parametrize("name", ["unit", "drop_in"])
def test_systemd_finds_the_unit_little_exposed(name: str, request: pytest.FixtureRequest) -> None:
    """With the rights of real time, too."""
    path = request.getfixturevalue(name)
    done = run(needed("systemd-analyze", "systemd"), "security", "--offline=true", str(path))
    found = re.search(r"exposure level for eqrt\.service: (\d+\.\d)", done.stdout)
    assert found is not None, done.stderr
    assert float(found[1]) <= MAX_EXPOSURE


# --- under strace


CALL = re.compile(r"^(?:\d+ +)?(\w+)\((.*)\)\s+= (-?\w+)")
WRITING = re.compile(r"O_WRONLY|O_RDWR|O_CREAT|O_TRUNC")
NOT_FILES = ("/dev/null", "/dev/tty", "/proc/self/")
CHANGING = {"creat", "mkdir", "mkdirat", "unlink", "unlinkat", "rmdir", "rename", "renameat"}
CHANGING |= {"renameat2", "link", "linkat", "symlink", "symlinkat", "mknod", "mknodat", "truncate"}
CHANGING |= {"chmod", "fchmodat", "chown", "fchownat", "utimensat", "setxattr"}


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str]]:
    """Every system call on files and sockets of a service that does all it can, with a reload."""
    folder = tmp_path_factory.mktemp("strace")
    home = folder / "home"
    home.mkdir()
    trace = folder / "trace"
    strace = [needed("strace", "strace"), "-D", "-f", "-qq", "-y", "-s", "256", "-o", str(trace)]
    channel = f"strace-{time.monotonic_ns()}"
    options = ["--can", channel, "--can-interface", LOCAL, "--profile", "generic"]
    options += ["--datagrams", "127.0.0.1:47399", "--metrics", "127.0.0.1:0"]
    with Serving(
        *options,
        command=[*strace, "-e", "trace=%file,%network", *EQRT],
        HOME=str(home),
        XDG_CACHE_HOME=str(home / "cache"),
        PYTHONDONTWRITEBYTECODE="1",
    ) as service:
        os.kill(service.pid, signal.SIGHUP)
        time.sleep(2.5)
        _, stdout, _ = service.end()
    assert "reloaded: unchanged" in stdout
    assert "eqrt serve: " in stdout.splitlines()[-1]
    assert list(home.iterdir()) == []
    lines = trace.read_text(encoding="utf-8", errors="replace").splitlines()
    return [(found[1], found[2]) for line in lines if (found := CALL.match(line))]


def written(calls: list[tuple[str, str]]) -> Iterator[str]:
    """What would change a file or a folder."""
    for name, arguments in calls:
        opens = name in {"open", "openat", "openat2"} and WRITING.search(arguments)
        if (opens or name in CHANGING) and not any(f'"{path}' in arguments for path in NOT_FILES):
            yield f"{name}({arguments})"


def test_a_service_writes_no_file(calls: list[tuple[str, str]]) -> None:
    """Nothing is to be recorded, so there is nothing to be written."""
    assert len([name for name, _ in calls if name == "openat"]) > 100
    assert list(written(calls)) == []


def test_a_service_does_not_look_at_its_home(calls: list[tuple[str, str]]) -> None:
    """onnxruntime would keep a device's id and a queue of events there, unless told not to."""
    looked = [a for _, a in calls if "/strace0/home" in a]
    assert [a for a in looked if "/home/.local/lib/python" not in a] == []  # where pip --user puts


def test_a_service_talks_to_loopback_alone(calls: list[tuple[str, str]]) -> None:
    """No name is looked up, no other family of sockets opened; the local bus's group is lo's."""
    families = {a.split(",")[0] for name, a in calls if name == "socket"}
    assert families <= {"AF_INET", "AF_UNIX", "AF_NETLINK"}
    talks = [(name, a) for name, a in calls if name in {"connect", "bind", "sendto", "sendmsg"}]
    places = {m for _, a in talks for m in re.findall(r'inet_addr\("([^"]+)"\)', a)}
    assert "127.0.0.1" in places
    for place in places:
        assert place.startswith(("127.", "239.19")), place
    multicast = [a for name, a in calls if name == "setsockopt" and "IP_MULTICAST_IF" in a]
    loopback = int.from_bytes(bytes([127, 0, 0, 1]), sys.byteorder)
    assert [f"[{loopback}]" in a for a in multicast] == [True]
