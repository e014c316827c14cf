"""`make view-figures`: what watching costs, measured. Wants a quiet machine and Chromium.

Frames of the page with 64 agents of 6 modes, and the latency of a service that nobody, programs,
browsers and a stopped browser watch, in turns, so that what else the machine does meets all alike.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from websockets.asyncio.client import connect

from browser import Browser
from drives import DRIVES
from processes import environment
from source_tree import ROOT
from viewing import Viewing, watched

AGENTS, WARM_S, MEASURED_S = 64, 8.0, 15.0
ROUNDS, SETTLE_S, CASE_S = 3, 4.0, 12.0
PAGES = 3
_TICKS = os.sysconf("SC_CLK_TCK")


def main() -> int:
    """Measure and print."""
    print(
        f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {ROUNDS} rounds of {CASE_S:.0f} s"
    )
    print(f"\npage with {AGENTS} agents of 6 modes, 1280 x 720, Chromium without a GPU")
    for line in frames():
        print(f"  {line}", flush=True)
    print("\nlatency of the service, from the last message of a cycle to its predictions sent")
    for line in latencies():
        print(f"  {line}", flush=True)
    return 0


def frames() -> Iterator[str]:
    """Frames per second, what a frame costs, and what the viewer's process takes."""
    with Viewing() as viewing, sending(viewing.datagrams), Browser() as browser:
        browser.resize(1280, 720)
        browser.open(viewing.address)
        time.sleep(WARM_S)
        before_s, began_s = cpu_s(viewing.process.pid), time.monotonic()
        browser.evaluate("window.eqrtBegan = window.eqrt.frames")
        bytes_before = browser.evaluate("return window.eqrt.bytes")
        time.sleep(MEASURED_S)
        timing = browser.evaluate("return window.eqrt.timing")
        spent_s = time.monotonic() - began_s
        count = browser.evaluate("return window.eqrt.frames - window.eqrtBegan")
        received = browser.evaluate("return window.eqrt.bytes") - bytes_before
        used = (cpu_s(viewing.process.pid) - before_s) / spent_s
        memory = resident_mib(viewing.process.pid)
    gaps_ms = np.diff(timing["frameTimes"])
    script_ms = np.array(timing["scriptMs"])
    yield f"{count / spent_s:.1f} frames/s; 99 % within {np.quantile(gaps_ms, 0.99):.0f} ms"
    p50, p99 = np.quantile(script_ms, [0.5, 0.99])
    yield f"script of a frame: p50 {p50:.1f} ms, p99 {p99:.1f} ms"
    yield f"stream {received / spent_s / 1e3:.0f} kB/s"
    yield f"eqrt view: {100 * used:.0f} % of a core, {memory:.0f} MiB resident"


@contextlib.contextmanager
def sending(address: str) -> Iterator[None]:
    """The crowd, from a process of its own."""
    command = [sys.executable, str(ROOT / "tests/crowd.py"), address, str(AGENTS)]
    path = os.pathsep.join(str(ROOT / folder) for folder in ("runtime", "tests"))
    with subprocess.Popen(command, env=environment(PYTHONPATH=path)) as process:
        try:
            yield
        finally:
            process.kill()


def latencies() -> Iterator[str]:
    """Every case in every round; percentiles over all rounds of a case."""
    drive = DRIVES["ngsim"]
    cases: dict[str, Callable[[Viewing], contextlib.AbstractContextManager[None]]] = {
        "nobody: no eqrt view": stopped_view,
        "eqrt view, no page": lambda _: contextlib.nullcontext(),
        f"{PAGES} pages read by a program": programs,
        f"{PAGES} Chromium on the same cores": browsers,
        "1 Chromium, stopped (SIGSTOP)": stopped_browser,
    }
    found_s: dict[str, list[float]] = {name: [] for name in cases}
    with watched(drive, drive.log) as (viewing, heard, _):
        for _round in range(ROUNDS):
            for name, case in cases.items():
                with case(viewing):
                    time.sleep(SETTLE_S)
                    seen = len(heard.statuses)
                    time.sleep(CASE_S)
                    for status in heard.statuses[seen + 1 :]:
                        found_s[name] += status.latencies_s
    yield f"{'':34}{'cycles':>7}{'p50':>8}{'p99':>8}{'worst':>8}  ms"
    for name, values in found_s.items():
        p50, p99 = 1e3 * np.quantile(values, [0.5, 0.99])
        yield f"{name:34}{len(values):7}{p50:8.1f}{p99:8.1f}{1e3 * max(values):8.1f}"


@contextlib.contextmanager
def stopped_view(viewing: Viewing) -> Iterator[None]:
    """A viewer that does nothing at all: for the service there is none."""
    os.kill(viewing.process.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(viewing.process.pid, signal.SIGCONT)


@contextlib.contextmanager
def programs(viewing: Viewing) -> Iterator[None]:
    """Pages whose pictures are drawn elsewhere, as over ssh: here, only their streams are read."""
    ended = threading.Event()

    async def read() -> None:
        async with connect(f"ws://{viewing.host}/stream", max_size=None) as page:
            while not ended.is_set():
                await page.recv()

    async def read_all() -> None:
        await asyncio.gather(*(read() for _ in range(PAGES)))

    thread = threading.Thread(target=lambda: asyncio.run(read_all()))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextlib.contextmanager
def browsers(viewing: Viewing) -> Iterator[None]:
    """Pages that are drawn by the machine's own two cores, without a GPU."""
    with contextlib.ExitStack() as stack:
        for _ in range(PAGES):
            browser = stack.enter_context(Browser())
            browser.resize(1280, 720)
            browser.open(viewing.address)
        yield


@contextlib.contextmanager
def stopped_browser(viewing: Viewing) -> Iterator[None]:
    """A page that is open and does not read."""
    with Browser() as browser:
        browser.open(viewing.address)
        time.sleep(1.0)
        family = browser.processes()
        for pid in family:
            os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            for pid in family:
                os.kill(pid, signal.SIGCONT)


def cpu_s(pid: int) -> float:
    """Time that a process has computed."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def resident_mib(pid: int) -> float:
    """Memory that a process holds."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


if __name__ == "__main__":
    sys.exit(main())
