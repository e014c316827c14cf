"""Run a program on real SocketCAN buses, on a machine with or without CAN in its kernel.

`find_launcher` takes the host's own `vcan` driver, in a network namespace of its own, or else boots
a User-Mode Linux kernel on the host's files. Either way the program finds the fresh buses of
`machine.SETUP`, which no other test can see.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from socketcan import uml
from socketcan.machine import SETUP, Completed, environment

Launcher = Callable[[Sequence[str], Path, float], Completed]
"""`launch(command, work, timeout_s)` runs a command in the writable folder `work`, to its end."""

PROGRAMS = Path(__file__).parent / "programs"
_NAMESPACE = ["unshare", "--net", *([] if os.geteuid() == 0 else ["--map-root-user"])]


class NoCanKernelError(Exception):
    """This machine can make no SocketCAN bus; the message says why and what to install."""


def find_launcher() -> Launcher:
    """What makes buses on this machine; NoCanKernelError if nothing does."""
    attempt = [*_NAMESPACE, "sh", "-ec", SETUP]
    if subprocess.run(attempt, capture_output=True, check=False).returncode == 0:
        return run_in_namespace
    if missing := uml.missing():
        raise NoCanKernelError(
            f"no vcan in this kernel, and no User-Mode Linux either: {missing} not found; "
            "install the packages user-mode-linux, kmod, iproute2, and gcc if the processor has AMX"
        )
    return uml.run_in_uml


def run_in_namespace(command: Sequence[str], work: Path, timeout_s: float) -> Completed:
    """Run on the host's kernel, in a network namespace that ends with the program."""
    shell = f'{SETUP}\ncd "$0"\nexec timeout --kill-after=1 {timeout_s} "$@"'
    process = subprocess.run(
        [*_NAMESPACE, "sh", "-ec", shell, str(work), *command],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env=os.environ | environment(work),
        check=False,
    )
    return Completed(process.returncode, process.stdout, process.stderr)


def program(name: str, *arguments: object) -> list[str]:
    """The command that runs a file of `programs` with this interpreter."""
    return [sys.executable, str(PROGRAMS / name), *map(str, arguments)]
