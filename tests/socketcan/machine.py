"""What a program finds on the machine that it is run on, whichever kernel that has."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from source_tree import ROOT, SOURCE_ROOTS

SETUP = """
for channel in vcan0 vcan1; do
    ip link add dev $channel type vcan
    ip link set up $channel mtu 72
done
ip link add dev vcan2 type vcan
ip link set up lo
"""
"""Shell lines that make two CAN FD buses, a third one that is down, and the loopback interface."""


@dataclass(frozen=True)
class Completed:
    """What a program left behind."""

    status: int
    """Exit status; 124 if it was ended for taking too long."""
    stdout: str
    stderr: str


def environment(work: Path) -> dict[str, str]:
    """Variables for a program that may write to the folder `work` only."""
    sources = [str(ROOT / name) for name in (*SOURCE_ROOTS, "tests")]
    return {
        "HOME": str(work),
        "TMPDIR": str(work),
        "PATH": os.environ["PATH"] + ":/usr/sbin:/sbin",
        "PYTHONPATH": os.pathsep.join(sources),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
