"""Settings that keep other programs from delaying the service: priority, memory, cores, garbage.

Each needs a right that the system must grant. What is refused is said in a line, with what to do;
the service runs without it unless told to be strict.
"""

from __future__ import annotations

import ctypes
import gc
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from eqrt.core.errors import UsageError

MAX_PRIORITY = 99
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # mlockall(2), the same on all of Linux's CPUs
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23  # capabilities(7)
_UNLIMITED = -1  # RLIM_INFINITY, in Python
_COLLECT_CYCLES = 50  # five seconds at 10 Hz; a collection takes a millisecond


@dataclass(frozen=True, slots=True, kw_only=True)
class Realtime:
    """What is asked for."""

    priority: int | None = None
    """SCHED_FIFO, 1 to 99; None = as other programs."""
    lock_memory: bool = False
    """Nothing of the process is paged out."""
    cpus: tuple[int, ...] | None = None
    """The only cores to run on; None = any."""
    gc_between_cycles: bool = False
    """Python collects garbage after a prediction has been sent, never during one."""

    def apply(self) -> list[str]:
        """Ask the system; a line for everything that it refuses. Linux only."""
        steps: list[Callable[[], str | None]] = [self._cpus, self._lock, self._priority]
        return [problem for step in steps if (problem := step()) is not None]

    def _cpus(self) -> str | None:
        if self.cpus is None:
            return None
        wanted, usable = (
            ",".join(map(str, cpus)) for cpus in (self.cpus, sorted(os.sched_getaffinity(0)))
        )
        try:
            os.sched_setaffinity(0, self.cpus)
        except PermissionError as error:
            return (
                f"cpus {wanted}: refused ({error.strerror}); give SystemCallFilter=@resources in "
                "the unit"
            )
        except (OSError, ValueError, OverflowError):
            return f"cpus {wanted}: not to be had; this process may use {usable}"
        return None

    def _lock(self) -> str | None:
        if not self.lock_memory:
            return None
        if not may_lock_memory():  # it may succeed, and the next allocation beyond the limit fail
            limit = _limit("RLIMIT_MEMLOCK")
            return (
                f"lock_memory: the limit is {limit >> 10} KiB; give LimitMEMLOCK=infinity in the "
                f"unit (ulimit -l unlimited in a shell), or the capability CAP_IPC_LOCK"
            )
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
            return f"lock_memory: refused ({os.strerror(ctypes.get_errno())})"
        return None

    def _priority(self) -> str | None:
        if self.priority is None:
            return None
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(self.priority))
        except OSError as error:
            return (
                f"priority {self.priority}: refused ({error.strerror}; the limit is "
                f"{_limit('RLIMIT_RTPRIO')}); give "
                f"LimitRTPRIO={self.priority} and RestrictRealtime=no in the unit (ulimit -r in a "
                f"shell), or the capability CAP_SYS_NICE"
            )
        return None


def parse_priority(text: str) -> int:
    """`50` -> 50. Raises ValueError outside of 1 to 99."""
    priority = int(text) if text.isdecimal() else 0
    if not 1 <= priority <= MAX_PRIORITY:
        raise ValueError(f"{text!r} is not a priority from 1 to {MAX_PRIORITY}")
    return priority


def parse_cpus(text: str) -> tuple[int, ...]:
    """`0,2-3` -> (0, 2, 3). Raises ValueError."""
    cpus: set[int] = set()
    for part in text.split(","):
        found = re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", part.strip())
        if not found or int(found[2] or found[1]) < int(found[1]):
            raise ValueError(f"{text!r} names no cores; give them as in 0 or 0,2-3")
        cpus.update(range(int(found[1]), int(found[2] or found[1]) + 1))
    return tuple(sorted(cpus))


def has_capability(number: int) -> bool:
    """Whether this process has a capability in effect. Linux only."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    found = re.search(r"^CapEff:\s*([0-9a-f]+)", status, re.MULTILINE)
    return bool(found and int(found[1], 16) >> number & 1)


def may_be_realtime() -> bool:
    """Whether a real-time priority would be granted, as far as limits tell."""
    return _limit("RLIMIT_RTPRIO") != 0 or has_capability(_CAP_SYS_NICE)


def may_lock_memory() -> bool:
    """Whether all memory could be locked."""
    return _limit("RLIMIT_MEMLOCK") == _UNLIMITED or has_capability(_CAP_IPC_LOCK)


def _limit(name: str) -> int:
    import resource  # noqa: PLC0415 (Unix only, and this module is for every system)

    return int(resource.getrlimit(getattr(resource, name))[0])


def stand_back() -> None:
    """This thread has time: it leaves the priority that it inherited. Nothing elsewhere."""
    if hasattr(os, "sched_setscheduler") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def refuse(problems: list[str]) -> None:
    """Raises UsageError if there are any: for whoever asked to be strict."""
    if problems:
        raise UsageError(f"realtime settings refused, and strict is set: {'; '.join(problems)}")


class Sweeper:
    """Collects garbage between cycles (`service.Chore`) instead of whenever Python would."""

    def __init__(self, cycles: Callable[[], int]) -> None:
        """`cycles` tells how many predictions have been made."""
        gc.disable()
        self._cycles = cycles
        self._due_cycle = _COLLECT_CYCLES

    def __call__(self) -> None:
        """Now and then, right after a prediction has been sent."""
        cycles = self._cycles()
        if cycles >= self._due_cycle:
            self._due_cycle = cycles + _COLLECT_CYCLES
            gc.collect()
