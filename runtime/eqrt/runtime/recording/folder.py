"""The folder of recordings: names, sizes, and which of them may be deleted."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from pathlib import Path

SUFFIX = ".mcap"
_NAME = re.compile(r"eqrt-\d{8}T\d{6}Z-([0-9a-f]{8})-(\d{4,})\.mcap")


def file_name(run: str, part: int, time_s: float) -> str:
    """Of part `part` of a run, begun at `time_s` (s since 1970): names sort by time."""
    begun = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(time_s))
    return f"eqrt-{begun}-{run}-{part:04d}{SUFFIX}"


def recordings_in(folder: Path) -> list[Path]:
    """Every file that has the name of a recording of eqrt, oldest first."""
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))


def run_of(path: Path) -> str:
    """Which run a file of `recordings_in` belongs to."""
    named = _NAME.fullmatch(path.name)
    return named[1] if named else ""


def part_of(path: Path) -> int:
    """Which part of its run it is: the order of the files, however the clock was set meanwhile."""
    named = _NAME.fullmatch(path.name)
    return int(named[2]) if named else 0


def total_bytes(folder: Path) -> int:
    """What all recordings there have together."""
    sizes = 0
    for path in recordings_in(folder):
        with contextlib.suppress(OSError):  # deleted by somebody in between
            sizes += path.stat().st_size
    return sizes


def free_bytes(folder: Path) -> int:
    """What the file system has left for everybody."""
    state = os.statvfs(folder)
    return state.f_bavail * state.f_frsize


def delete_oldest(folder: Path) -> bool:
    """Delete the oldest recording that nobody is writing; False = there is none."""
    for path in recordings_in(folder):
        with contextlib.suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held by whoever writes it
            path.unlink()
            return True
    return False
