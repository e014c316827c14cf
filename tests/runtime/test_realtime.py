"""Priority, locked memory, cores, garbage: what the kernel grants, what is said if it does not."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.operation.realtime import (
    Realtime,
    may_be_realtime,
    may_lock_memory,
    parse_cpus,
    parse_priority,
)
from installed import needed
from processes import EQRT, Serving, environment

RIGHTS = "needs root, or limits that allow it: ulimit -r 99 -l unlimited"
ASKED = ["--realtime-priority", "40", "--realtime-lock-memory"]


def options(*more: str) -> list[str]:
    channel = f"realtime-{time.monotonic_ns()}"
    return ["--can", channel, "--can-interface", LOCAL, "--profile", "generic", *more]


def without_rights() -> list[str]:
    """Runs the rest of a command with no capability and the limits of an ordinary login.

    Root stays root, without what makes it mighty: it must still reach its own interpreter.
    """
    limits = ["prlimit", "--rtprio=0", "--memlock=8388608"]
    if os.geteuid() != 0:
        return limits
    return [*limits, needed("setpriv", "util-linux"), "--bounding-set=-all", "--inh-caps=-all"]


def refused(*more: str) -> subprocess.CompletedProcess[str]:
    """`eqrt serve` without rights, ended after ten seconds if it does not end by itself."""
    return subprocess.run(
        [
            "timeout",
            "--foreground",
            "--signal=TERM",
            "10",
            *without_rights(),
            *EQRT,
            "serve",
            *options(*more),
        ],
        capture_output=True,
        text=True,
        check=False,
        env=environment(PYTHONDONTWRITEBYTECODE="1"),
    )


def field(pid: int, file: str, name: str) -> str:
    found = re.search(rf"^{name}:\s*(.+)$", Path(f"/proc/{pid}/{file}").read_text(), re.MULTILINE)
    assert found is not None
    return found[1]


@pytest.mark.skipif(not (may_be_realtime() and may_lock_memory()), reason=RIGHTS)
def test_what_is_granted_holds_for_the_service() -> None:
    cpu = max(os.sched_getaffinity(0))
    with Serving(*options(*ASKED, "--realtime-cpus", str(cpu), "--realtime-strict")) as service:
        assert os.sched_getscheduler(service.pid) == os.SCHED_FIFO
        assert os.sched_getparam(service.pid).sched_priority == 40
        assert os.sched_getaffinity(service.pid) == {cpu}
        locked, resident = (
            int(field(service.pid, "status", name).split()[0]) for name in ("VmLck", "VmRSS")
        )
        assert locked > 30_000
        assert resident < 200_000  # what was never used is not brought in
        status, _, stderr = service.end()
    assert (status, stderr) == (0, "")


@pytest.mark.skipif(not (may_be_realtime() and may_lock_memory()), reason=RIGHTS)
def test_what_loads_in_the_background_does_not_run_before_others() -> None:
    """The thread inherits the service's priority, and gives it back."""
    code = (
        "import os, threading\n"
        "from eqrt.runtime.operation.realtime import Realtime, stand_back\n"
        "assert Realtime(priority=5).apply() == []\n"
        "found = []\n"
        "def work():\n"
        "    found.append(os.sched_getscheduler(0)); stand_back()\n"
        "    found.append(os.sched_getscheduler(0))\n"
        "thread = threading.Thread(target=work); thread.start(); thread.join()\n"
        "print(found == [os.SCHED_FIFO, os.SCHED_OTHER], os.sched_getscheduler(0) == os.SCHED_FIFO)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment()
    )
    assert done.stdout == "True True\n"


def test_what_is_refused_is_said_with_what_to_do_and_the_service_goes_on() -> None:
    done = refused(*ASKED, "--realtime-cpus", "4000")
    lines = [re.sub(r"^\d\d:\d\d:\d\d ", "", line) for line in done.stdout.splitlines()]
    assert re.fullmatch(
        r"warning: realtime cpus 4000: not to be had; this process may use [\d,]+", lines[0]
    )
    assert re.fullmatch(
        r"warning: realtime lock_memory: the limit is 8192 KiB; give LimitMEMLOCK=infinity .*",
        lines[1],
    )
    assert re.fullmatch(
        r"warning: realtime priority 40: refused \(Operation not permitted; the limit is 0\); give "
        r"LimitRTPRIO=40 .*CAP_SYS_NICE",
        lines[2],
    )
    assert lines[3].startswith("eqrt serve: generic on ")
    assert lines[-1].startswith("eqrt serve: 0 messages")
    assert done.stderr == ""


def test_strict_refuses_to_start() -> None:
    done = refused(*ASKED, "--realtime-strict")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("eqrt: realtime settings refused, and strict is set: lock_memory")
    assert done.stderr.count("\n") == 1


def test_nothing_is_asked_for_by_default() -> None:
    before = (os.sched_getscheduler(0), os.sched_getaffinity(0))
    assert Realtime().apply() == []
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before


@pytest.mark.parametrize(("text", "cpus"), [("0", (0,)), ("0,2-3", (0, 2, 3)), ("3,1", (1, 3))])
def test_cores_are_read(text: str, cpus: Sequence[int]) -> None:
    assert parse_cpus(text) == cpus


@pytest.mark.parametrize("text", ["", "a", "3-1", "-1", "1,,2", "99999"])
def test_what_names_no_cores_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="names no cores"):
        parse_cpus(text)


@pytest.mark.parametrize("text", ["0", "100", "-1", "1.5", ""])
def test_what_is_no_priority_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not a priority from 1 to 99"):
        parse_priority(text)


def test_garbage_is_collected_between_cycles_and_at_no_other_time() -> None:
    """In a process of its own, because the collector is switched off for good."""
    code = """
import gc, time
from drives import Car, traffic, shipped_predictor
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.operation.realtime import Sweeper
from eqrt.runtime.pipeline import Pipeline
pipeline = Pipeline(load_profile("generic"), shipped_predictor())
sweeper = Sweeper(lambda: pipeline.counters.cycles)
inside, collected = [False], []
gc.callbacks.append(lambda phase, info: collected.append(inside[0]) if phase == "start" else None)
for message in traffic([Car(object_id=1, x_m=5.0, y_m=0.0)], 20.0):
    ring = []; ring.append(ring)
    inside[0] = True
    pipeline.feed(message, message.timestamp)
    inside[0] = False
    sweeper()
print(len(collected), any(collected), gc.isenabled())
"""
    path = os.pathsep.join(sys.path)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env=environment(PYTHONPATH=path),
    )  # fmt: skip
    assert done.stdout == "4 False False\n"
    assert gc.isenabled()
