"""Checks of the machine: software, processor, rights, clock, disk."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from eqrt.runtime.bench.environment import parse_cpuinfo
from eqrt.runtime.doctor.finding import Finding, Verdict, ok, warn
from eqrt.runtime.operation.realtime import Realtime, may_be_realtime, may_lock_memory

_PACKAGES = ("eqrt", "numpy", "onnxruntime", "python-can", "cantools", "msgspec")
_CPUS = Path("/sys/devices/system/cpu")
_CLOCKSOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
_SLOW_CLOCKS = {"jiffies", "hpet", "acpi_pm"}  # microseconds per question, or milliseconds coarse
_TIMEX_BYTES = 512  # more than struct timex has anywhere
_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronized
_MIN_FREE_BYTES = 1 << 30


def check_machine(realtime: Realtime, state: Path, *, strict: bool) -> Iterator[Finding]:
    """`realtime`: what is asked for; `strict`: the service does not start if that is refused.

    `state`: the only folder that the service may write in.
    """
    yield _software()
    yield _processor()
    yield _governor()
    for finding in (_priority(realtime), _memory(realtime), _cores(realtime)):
        is_refused = finding.verdict is Verdict.WARN
        yield replace(finding, verdict=Verdict.FAIL) if strict and is_refused else finding
    yield _monotonic()
    yield _wall_clock()
    yield _disk(state)


def _software() -> Finding:
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES]
    return ok("software", f"Python {platform.python_version()}, {', '.join(versions)}")


def _processor() -> Finding:
    name, _, is_guest = parse_cpuinfo(_text(Path("/proc/cpuinfo")))
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    found = f"{name or platform.machine()}, {len(usable) or os.cpu_count()} of {os.cpu_count()}"
    found += f" cores usable, {platform.system()} {platform.release()}"
    where = [w for w, yes in (("virtual machine", is_guest), ("container", _in_container())) if yes]
    if where:
        return warn(
            "processor",
            f"{found}, in a {' and a '.join(where)}",
            "others on the host can delay the service; measure with eqrt bench --service",
        )
    return ok("processor", found)


def _in_container() -> bool:
    return Path("/.dockerenv").exists() or "container=" in _text(Path("/proc/1/environ"))


def _governor() -> Finding:
    found = {_text(path).strip() for path in _CPUS.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    found -= {""}
    if found <= {"performance"}:
        return ok("governor", "performance" if found else "none: the clock frequency is not ours")
    return warn(
        "governor",
        f"{', '.join(sorted(found))}: the processor may be slow to become fast",
        "sudo cpupower frequency-set --governor performance",
    )


def _priority(realtime: Realtime) -> Finding:
    if sys.platform != "linux":
        return ok("priority", "no real-time priority on this system")
    if may_be_realtime():
        return ok("priority", "a real-time priority would be granted")
    if realtime.priority is None:
        return ok("priority", "a real-time priority is neither asked for nor allowed")
    return warn(
        "priority",
        f"the real-time priority {realtime.priority} would be refused to this user",
        "install deploy/realtime.conf, or run this check as the service's user",
    )


def _memory(realtime: Realtime) -> Finding:
    if sys.platform != "linux":
        return ok("memory lock", "memory cannot be locked on this system")
    if may_lock_memory():
        return ok("memory lock", "locking all memory would be granted")
    if not realtime.lock_memory:
        return ok("memory lock", "locking all memory is neither asked for nor allowed")
    return warn(
        "memory lock",
        "locking all memory would be refused to this user",
        "install deploy/realtime.conf, or run this check as the service's user",
    )


def _cores(realtime: Realtime) -> Finding:
    """Asks for them as the service does, and gives them back."""
    if sys.platform != "linux" or realtime.cpus is None:
        return ok("cores", "any")
    before = os.sched_getaffinity(0)
    problems = Realtime(cpus=realtime.cpus).apply()
    os.sched_setaffinity(0, before)
    if problems:
        return warn("cores", problems[0], "give --realtime-cpus some of those")
    return ok("cores", f"{', '.join(map(str, realtime.cpus))} would be granted")


def _monotonic() -> Finding:
    resolution_ns = round(1e9 * time.get_clock_info("monotonic").resolution)
    source = _text(_CLOCKSOURCE).strip()
    found = f"monotonic, {resolution_ns} ns" + (f", from {source}" if source else "")
    if source in _SLOW_CLOCKS:
        return warn("clock", found, "slow or coarse; boot with a processor clock (clocksource=tsc)")
    return ok("clock", found)


def _wall_clock() -> Finding:
    """The service never depends on it; only log and recordings are dated by it."""
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (AttributeError, OSError, TypeError):
        return ok("wall clock", "cannot be asked here")
    if state == _TIME_ERROR:
        return warn(
            "wall clock",
            "not synchronized: dates in logs may be wrong, predictions are not concerned",
            "sudo timedatectl set-ntp true, or chrony",
        )
    return ok("wall clock", "synchronized" if state >= 0 else "cannot be asked here")


def _disk(state: Path) -> Finding:
    try:
        free = shutil.disk_usage(state).free
    except OSError as error:
        return warn("disk", f"{state}: {error.strerror}", "make the folder")
    found = f"{state}: {free / 1e9:.1f} GB free"
    if free < _MIN_FREE_BYTES:
        return warn("disk", found, "recordings would soon stop; make room")
    return ok("disk", found)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
