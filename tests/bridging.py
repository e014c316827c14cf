"""`eqrt bridge` as a user runs it."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator

from processes import EQRT, environment
from source_tree import ROOT, SOURCE_ROOTS
from viewing import free_udp_port


@contextlib.contextmanager
def bridge(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`eqrt bridge` in a process that listens, and where it does."""
    datagrams = f"127.0.0.1:{free_udp_port()}"
    path = ":".join(str(ROOT / root) for root in SOURCE_ROOTS)
    with subprocess.Popen(
        [*EQRT, "bridge", *arguments, "--datagrams", datagrams],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(PYTHONPATH=path),
    ) as process:
        try:
            assert process.stdout is not None
            ready = process.stdout.readline()
            assert ready.startswith(f"eqrt bridge: from {datagrams} to "), process.communicate()
            yield process, datagrams
        finally:
            if process.poll() is None:
                process.kill()
