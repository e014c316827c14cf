"""`make load`: a bus as full as can be, for a while, and what `eqrt serve` made of it.

python -m load.run [--rate 4000]... [--seconds 30] [--objects 100] [--can CHANNEL] [--interface IF]
                   [--stall 0]

Every message is one that the profile wants: object lists at 10 Hz, and the ego motion in all the
room that is left. Sent, read and lost are counted by three that know: this program, the service,
and the kernel. Nothing may be missing: sent = read + lost.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import can

from drives import TILE
from eqrt.runtime.bench.service.crowd import PROFILE, crowded_cycles
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.bus.links import open_link
from processes import EQRT, PATIENCE_S, environment

CYCLES_PER_S = 10
TICK_S = 0.001
STATUS = re.compile(
    r"(?P<predictions>[\d.]+) predictions/s  latency +(?P<middle>[\d.]+) ms "
    r"\(worst +(?P<worst>[\d.]+)\)"
)
SUMMARY = re.compile(r"eqrt serve: (\d+) messages, (\d+) cycles, (\d+) predictions")


@dataclass(frozen=True)
class Buses:
    """Where the messages go, and where the predictions."""

    channel: str
    out_channel: str
    interface: str = LOCAL


@dataclass
class Outcome:
    """What happened to the messages."""

    rate_hz: float
    sent: int = 0
    seconds: float = 0.0
    read: int = 0
    lost: int = 0
    """By the kernel, whose receive queue was full; its own count."""
    predicted: int = 0
    """Objects."""
    latencies_ms: list[tuple[float, float]] = field(default_factory=list)
    """Median and worst of every second."""
    summary: str = ""

    @property
    def unexplained(self) -> int:
        """Sent, but neither read nor counted as lost."""
        return self.sent - self.read - self.lost

    def line(self) -> str:
        """For the terminal."""
        worst = max((worst for _, worst in self.latencies_ms), default=float("nan"))
        middles = sorted(middle for middle, _ in self.latencies_ms)
        middle = middles[len(middles) // 2] if middles else float("nan")
        return (
            f"{self.rate_hz:.0f} messages/s wanted, {self.sent / self.seconds:.0f} sent for "
            f"{self.seconds:.1f} s: sent {self.sent}, read {self.read}, lost {self.lost}, "
            f"unexplained {self.unexplained}; {self.predicted} objects predicted, "
            f"latency {middle:.1f} ms, worst {worst:.1f} ms"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0 if nothing was lost at any rate, else 1."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rate", type=float, action="append", help="messages/s (repeatable)")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--objects", type=int, default=100)
    parser.add_argument("--can", default=f"load-{os.getpid()}", metavar="CHANNEL")
    parser.add_argument("--out-can", default=f"load-out-{os.getpid()}", metavar="CHANNEL")
    parser.add_argument("--interface", default=LOCAL)
    parser.add_argument(
        "--stall", type=float, default=0.0, help="seconds for which the service is held up"
    )
    args = parser.parse_args(arguments)
    buses = Buses(args.can, args.out_can, args.interface)
    outcomes = []
    for rate_hz in args.rate or [4000.0, 10_000.0]:
        outcomes.append(
            load(buses, rate_hz, args.seconds, objects=args.objects, stall_s=args.stall)
        )
        print(outcomes[-1].line(), flush=True)
    return int(any(one.sent != one.read for one in outcomes))


def load(
    buses: Buses, rate_hz: float, seconds: float, *, objects: int, stall_s: float = 0.0
) -> Outcome:
    """Load a service of its own, held up meanwhile; its predictions go to the other channel."""
    outcome = Outcome(rate_hz)
    cycles = traffic(rate_hz, objects)
    options = ["--can", buses.channel, "--out-can", buses.out_channel]
    options += ["--can-interface", buses.interface]
    service = subprocess.Popen(
        [*EQRT, "serve", *options, "--profile", PROFILE, "--tile", str(TILE)],
        stdout=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    try:
        assert service.stdout is not None
        if not service.stdout.readline():  # what it says when it is ready
            raise RuntimeError("the service did not start")
        with (
            contextlib.closing(Sender(buses)) as sender,
            stalled(service.pid, stall_s),
        ):
            send(sender, cycles, rate_hz, seconds, outcome)
        for line in service.stdout:
            note(line, outcome)
            if line.rstrip().endswith(" 0 messages/s"):  # all is read
                break
        service.terminate()
        rest, _ = service.communicate(timeout=PATIENCE_S)
    finally:
        service.kill()
        service.wait()
    conclude(rest.splitlines()[-1], buses.channel, outcome)
    return outcome


def traffic(rate_hz: float, objects: int) -> list[list[can.Message]]:
    """Cycles of a tenth of a second, each with as many messages as the rate has room for."""
    room = round(rate_hz / CYCLES_PER_S)
    cycles = []
    for cycle in itertools.islice(crowded_cycles(objects), 100):
        if len(cycle) > room:
            raise ValueError(f"{objects} objects are {len(cycle)} messages, but there is {room}")
        motion = cycle[0]
        cycles.append(list(spread(cycle, [motion] * (room - len(cycle)))))
    return cycles


def spread(cycle: Sequence[can.Message], filling: Sequence[can.Message]) -> Iterator[can.Message]:
    """One after the other, both evenly."""
    total, taken = len(cycle) + len(filling), 0
    for place in range(total):
        if (place + 1) * len(cycle) // total > taken:
            yield cycle[taken]
            taken += 1
        else:
            yield filling[place - taken]


@contextlib.contextmanager
def stalled(pid: int, seconds: float) -> Iterator[None]:
    """Stop a process now, and let it go on after that time or at the end of the block."""
    if seconds <= 0.0:
        yield
        return
    os.kill(pid, signal.SIGSTOP)
    timer = threading.Timer(seconds, os.kill, (pid, signal.SIGCONT))
    timer.start()
    try:
        yield
    finally:
        timer.join()


class Sender:
    """A place on the bus that only sends."""

    def __init__(self, buses: Buses) -> None:
        self._link = open_link(buses.channel, buses.interface, fd=None, receive=())
        self.close = self._link.shutdown

    def put(self, message: can.Message) -> None:
        """However often the driver's own queue is full."""
        while True:
            try:
                return self._link.send(message)
            except (can.CanError, OSError):
                time.sleep(TICK_S)


def send(
    sender: Sender,
    cycles: Sequence[Sequence[can.Message]],
    rate_hz: float,
    seconds: float,
    outcome: Outcome,
) -> None:
    """On an absolute schedule: being late does not add up."""
    messages = itertools.chain.from_iterable(itertools.cycle(cycles))
    total = round(rate_hz * seconds)
    begun_s = time.perf_counter()
    while outcome.sent < total:
        due = min(total, int((time.perf_counter() - begun_s) * rate_hz))
        for message in itertools.islice(messages, due - outcome.sent):
            sender.put(message)
        outcome.sent = max(outcome.sent, due)
        time.sleep(TICK_S)
    outcome.seconds = time.perf_counter() - begun_s


def note(line: str, outcome: Outcome) -> None:
    """A second that the service reports."""
    if found := STATUS.search(line):
        outcome.latencies_ms.append((float(found["middle"]), float(found["worst"])))


def conclude(summary: str, channel: str, outcome: Outcome) -> None:
    """The service's last line."""
    found = SUMMARY.match(summary)
    if found is None:
        raise RuntimeError(f"the service ended with: {summary}")
    outcome.summary = summary
    outcome.read, _, outcome.predicted = map(int, found.groups())
    lost = re.search(rf"{re.escape(channel)}:[^;]*?(\d+) messages lost to a full", summary)
    outcome.lost = int(lost.group(1)) if lost else 0


if __name__ == "__main__":
    sys.exit(main())
