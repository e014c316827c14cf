"""What a run costs beside time: memory, CPU time, switches, faults; and what others took meanwhile.

From getrusage and /proc, before and after a run; memory and clock frequency also once a second.
"""

from __future__ import annotations

import contextlib
import os
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eqrt.runtime.bench.schedule import CLOCK

PROC = Path("/proc")
_LOOK_NS = 1_000_000_000
_SETTLING = 0.25  # the share of a run that the slope of memory leaves out: pools fill up
_KIB = 1024
_RESET_PEAK = "5"  # proc(5), clear_refs: the peak starts again from the resident size now


@dataclass(frozen=True, slots=True, kw_only=True)
class Resources:
    """Of one case: all workloads and the measuring itself, from the first run to the last."""

    rss_start_mib: float
    rss_end_mib: float
    rss_peak_mib: float
    rss_slope_kib_per_s: float | None
    """Least-squares line through the last three quarters; None if too short to tell."""
    voluntary_switches: int
    involuntary_switches: int
    minor_faults: int
    major_faults: int
    cpu_s: float
    """Spent by this process, all threads."""
    others_share: float
    """Of the time of the allowed cores, used by anybody else."""
    steal_share: float
    """Of the time of the allowed cores, taken by the hypervisor for other machines."""
    frequency_low_mhz: float | None
    """The slowest that any allowed core was seen at; None where the kernel does not say."""
    frequency_high_mhz: float | None


@dataclass(frozen=True, slots=True)
class CoreTimes:
    """Seconds since boot, summed over some cores."""

    busy_s: float
    """Running anything, in the kernel or out of it."""
    steal_s: float
    all_s: float
    """Idle and waiting as well."""


class Watch:
    """Looks at this process from its creation to `finish`."""

    def __init__(self, cores: Sequence[int]) -> None:
        self._cores = cores
        _reset_peak()
        self._started_ns = self._looked_ns = CLOCK()
        self._memory = [(0.0, resident_mib())]
        self._frequencies = frequencies_mhz(cores)
        self._before = core_times((PROC / "stat").read_text(encoding="utf-8"), cores)
        self._usage = resource.getrusage(resource.RUSAGE_SELF)

    def look(self) -> None:
        """Between two runs: note memory and frequencies, once a second."""
        now_ns = CLOCK()
        if now_ns - self._looked_ns >= _LOOK_NS:
            self._looked_ns = now_ns
            self._memory.append(((now_ns - self._started_ns) / 1e9, resident_mib()))
            self._frequencies += frequencies_mhz(self._cores)

    def finish(self) -> Resources:
        """What it came to."""
        usage, before = resource.getrusage(resource.RUSAGE_SELF), self._usage
        after = core_times((PROC / "stat").read_text(encoding="utf-8"), self._cores)
        cpu_s = usage.ru_utime + usage.ru_stime - before.ru_utime - before.ru_stime
        others, steal = shares(self._before, after, cpu_s)
        end_s = (CLOCK() - self._started_ns) / 1e9
        memory = [*self._memory, (end_s, resident_mib())]
        seen = [*self._frequencies, *frequencies_mhz(self._cores)]
        return Resources(
            rss_start_mib=round(memory[0][1], 3),
            rss_end_mib=round(memory[-1][1], 3),
            rss_peak_mib=round(_status_mib("VmHWM"), 3),
            rss_slope_kib_per_s=slope_kib_per_s(memory),
            voluntary_switches=usage.ru_nvcsw - before.ru_nvcsw,
            involuntary_switches=usage.ru_nivcsw - before.ru_nivcsw,
            minor_faults=usage.ru_minflt - before.ru_minflt,
            major_faults=usage.ru_majflt - before.ru_majflt,
            cpu_s=round(cpu_s, 3),
            others_share=round(others, 4),
            steal_share=round(steal, 4),
            frequency_low_mhz=min(seen) if seen else None,
            frequency_high_mhz=max(seen) if seen else None,
        )


def cpu_ns() -> int:
    """CPU time of this process so far, all threads."""
    return time.process_time_ns()


def resident_mib() -> float:
    """Physical memory of this process now."""
    return _status_mib("VmRSS")


def slope_kib_per_s(memory: Sequence[tuple[float, float]]) -> float | None:
    """How fast memory grows: (seconds, MiB), in order -> KiB per second, after settling."""
    settled = [point for point in memory if point[0] >= _SETTLING * memory[-1][0]]
    if len(settled) < 4:
        return None
    seconds, mib = np.array(settled).T
    away = seconds - seconds.mean()
    return round(float(_KIB * (away * (mib - mib.mean())).sum() / (away**2).sum()), 3)


def core_times(stat: str, cores: Sequence[int]) -> CoreTimes:
    """From the text of /proc/stat (proc(5)): user nice system idle iowait irq softirq steal."""
    tick_s = 1.0 / os.sysconf("SC_CLK_TCK")
    rows = {words[0]: words[1:] for line in stat.splitlines() if (words := line.split())}
    ticks = np.array([[int(tick) for tick in rows[f"cpu{core}"][:8]] for core in cores])
    spent = tick_s * ticks.sum(axis=0)
    return CoreTimes(
        busy_s=float(spent[[0, 1, 2, 5, 6]].sum()),
        steal_s=float(spent[7]),
        all_s=float(spent.sum()),
    )


def shares(before: CoreTimes, after: CoreTimes, own_s: float) -> tuple[float, float]:
    """The shares of the cores' time that went to other programs, and to other machines.

    The kernel counts in hundredths of a second: over less than a second they say little.
    """
    passed_s = after.all_s - before.all_s
    if passed_s <= 0.0:
        return 0.0, 0.0
    others_s = after.busy_s - before.busy_s - own_s
    return max(0.0, others_s / passed_s), (after.steal_s - before.steal_s) / passed_s


def frequencies_mhz(cores: Sequence[int]) -> list[float]:
    """Of each core now; empty where the kernel does not say (most virtual machines)."""
    found = []
    for core in cores:
        path = Path(f"/sys/devices/system/cpu/cpu{core}/cpufreq/scaling_cur_freq")
        with contextlib.suppress(OSError, ValueError):
            found.append(int(path.read_text(encoding="ascii")) / 1e3)
    return found


def _reset_peak() -> None:
    with contextlib.suppress(OSError):  # then the peak is that since the process began
        (PROC / "self/clear_refs").write_text(_RESET_PEAK, encoding="ascii")


def _status_mib(key: str) -> float:
    for line in (PROC / "self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) / _KIB
    raise ValueError(f"/proc/self/status has no {key}")  # every Linux has them
