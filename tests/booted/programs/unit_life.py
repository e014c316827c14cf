"""deploy/eqrt.service from its installation to its end, under systemd; found is printed as JSON.

unit_life.py LOG (of generic objects on one bus): everything is done as deploy/README.md says, as
root of a machine of its own.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Mapping
from pathlib import Path

from drives import TILE
from predicted_cycles import predicted_cycles
from source_tree import ROOT

EQRT = "/opt/eqrt/bin/eqrt"
CONFIG, UNIT = Path("/etc/eqrt/eqrt.toml"), Path("/etc/systemd/system/eqrt.service")
RIGHTS = Path("/etc/systemd/system/eqrt.service.d/realtime.conf")
TOWN = Path("/etc/eqrt/town.tile")
STATE = Path("/var/lib/eqrt")
CHANNEL = "vcan0"
SO_RCVBUFFORCE = 33  # socket(7); Python has no name for it
PATIENCE_S = 60.0
KEYS = {
    '#tile = "/var/lib/eqrt/town.tile"': f'tile = "{TOWN}"',
    "#quiet = false": "quiet = true",
    '"ars408"': '"generic"',
    '#datagrams = ["127.0.0.1:47310"]': 'datagrams = ["127.0.0.1:47310"]',
    '#metrics = "127.0.0.1:9464"': 'metrics = "127.0.0.1:9464"',
    "#record =": "record =",
    '#record_keep_free = "1G"': 'record_keep_free = "32M"',  # the machine has no disk but memory
}
REAL_TIME = {
    "#priority": "priority",
    "#lock_memory = false": "lock_memory = true",
    '#cpus = "1"': 'cpus = "0"',
    "#strict = false": "strict = true",
}
"""What is changed in deploy/eqrt.toml, besides the channel."""


def systemctl(*arguments: str) -> tuple[int, str]:
    done = subprocess.run(["systemctl", *arguments], capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


def shown(name: str) -> str:
    """A property of the unit, as systemd knows it."""
    command = ["systemctl", "show", "--value", "--property", name, "eqrt"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def states() -> dict[str, str]:
    return {name: shown(name) for name in ("ActiveState", "Result", "ExecMainStatus")}


def pid() -> int:
    return int(shown("MainPID"))


def said() -> list[str]:
    """All that the service has written to the journal so far."""
    subprocess.run(["journalctl", "--sync"], check=True)
    command = ["journalctl", "--unit", "eqrt", "--output", "cat", "--no-pager"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def wait_until(happened: Callable[[], bool]) -> float:
    """How many seconds it took."""
    begun_s = time.monotonic()
    while not happened():
        assert time.monotonic() < begun_s + PATIENCE_S, said()
        time.sleep(0.1)
    return time.monotonic() - begun_s


def configure(changes: Mapping[str, str]) -> None:
    text = (ROOT / "deploy/eqrt.toml").read_text(encoding="utf-8").replace('"can0"', f'"{CHANNEL}"')
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    CONFIG.parent.mkdir(exist_ok=True)
    CONFIG.write_text(text, encoding="utf-8")


def predictions(log: str) -> int:
    """How many cycles the service predicts while the log is played."""
    return predicted_cycles(log, CHANNEL, [EQRT])


def over_loopback(log: str) -> dict[str, object]:
    """What comes while the log is played to who may listen: the unit allows no other network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 1 << 24)  # read afterwards
        receiver.bind(("127.0.0.1", 47310))
        receiver.settimeout(0.0)
        predicted, datagrams = predictions(log), 0
        with contextlib.suppress(BlockingIOError):
            while receiver.recv(1 << 16):
                datagrams += 1
    with urllib.request.urlopen("http://127.0.0.1:9464/metrics", timeout=PATIENCE_S) as answer:
        metrics = answer.read().decode()
    counted = re.search(r"^eqrt_pipeline_cycles_total (\d+)", metrics, re.MULTILINE)
    return {
        "predicted": predicted,
        "datagrams": datagrams,
        "counted": int(counted[1]) if counted else None,
    }


def installed() -> dict[str, object]:
    """As the README says; it has started when `enable --now` returns."""
    shutil.copy(ROOT / "deploy/eqrt.service", UNIT)
    configure(KEYS)
    shutil.copy(TILE, TOWN)
    status, errors = systemctl("enable", "--now", "eqrt")
    process = pid()
    rights = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    found = re.findall(r"^(CapEff|NoNewPrivs|Seccomp):\s*(\w+)$", rights, re.MULTILINE)
    return {
        "enabled": (status, errors),
        "user": os.stat(f"/proc/{process}").st_uid,
        **states(),
        **dict(found),
    }


def reloaded() -> dict[str, object]:
    """A damaged tile, and then a right one, while the process stays the same."""
    process, found = pid(), {}
    for name, content in {"damaged": b"not a tile", "right": TILE.read_bytes()}.items():
        heard = len(said())
        TOWN.with_suffix(".new").write_bytes(content)
        TOWN.with_suffix(".new").rename(TOWN)
        status, errors = systemctl("reload", "eqrt")
        found[name] = {"reload": (status, errors), **states(), "said": said()[heard:]}
    return {**found, "same": process == pid()}


def struck(number: signal.Signals) -> dict[str, object]:
    """How long a signal keeps the service away, if nobody but systemd does anything."""
    process, restarts = pid(), int(shown("NRestarts"))
    os.kill(process, number)
    seconds = wait_until(
        lambda: int(shown("NRestarts")) > restarts and shown("ActiveState") == "active"
    )
    return {"seconds": seconds, "same": process == pid()}


def stopped() -> dict[str, object]:
    begun_s = time.monotonic()
    status, errors = systemctl("stop", "eqrt")
    recordings = sorted((STATE / "recordings").glob("*.mcap"))
    return {
        "stop": (status, errors),
        "seconds": time.monotonic() - begun_s,
        "recordings": [path.stat().st_size for path in recordings],
        **states(),
    }


def refused(changes: Mapping[str, str]) -> dict[str, object]:
    """What becomes of a service whose configuration is wrong: it is not started again."""
    configure(changes)
    status, _ = systemctl("start", "eqrt")
    time.sleep(3.0)  # RestartSec is 1
    return {"start": status, **states(), "restarts": shown("NRestarts"), "said": said()[-1]}


def in_real_time() -> dict[str, object]:
    """With the rights that realtime.conf gives."""
    RIGHTS.parent.mkdir()
    shutil.copy(ROOT / "deploy/realtime.conf", RIGHTS)
    systemctl("daemon-reload")
    systemctl("reset-failed", "eqrt")
    status, errors = systemctl("restart", "eqrt")
    process = pid()
    memory = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    locked = re.search(r"^VmLck:\s*(\d+) kB$", memory, re.MULTILINE)
    return {
        "restart": (status, errors),
        "is_fifo": os.sched_getscheduler(process) == os.SCHED_FIFO,
        "priority": os.sched_getparam(process).sched_priority,
        "cores": sorted(os.sched_getaffinity(process)),
        "locked_kib": int(locked[1]) if locked else 0,
        **states(),
    }


def main(log: str) -> dict[str, object]:
    """One thing after the other."""
    return {
        "installed": installed(),
        "over_loopback": over_loopback(log),
        "status_text": shown("StatusText"),
        "reloaded": reloaded(),
        "predicted_after_reload": predictions(log),
        "hung": struck(signal.SIGSTOP),
        "killed": struck(signal.SIGKILL),
        "predicted_after_restarts": predictions(log),
        "stopped": stopped(),
        "misspelt": refused(KEYS | {"#out_modes": "out_nodes"}),
        "without_rights": refused(KEYS | REAL_TIME),
        "in_real_time": in_real_time(),
        "predicted_in_real_time": predictions(log),
        "stopped_again": stopped(),
    }


if __name__ == "__main__":
    print(json.dumps(main(*sys.argv[1:])))
