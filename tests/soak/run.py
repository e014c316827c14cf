"""`make soak`: a day and more of traffic, and whether anything grows, is missed or goes wrong.

    python -m soak.run [--simulated-hours 24] [--simulated-objects 8]
                       [--real-hours 1] [--objects 32]

Simulated: the pipeline, its encoders and its status on a virtual clock, as fast as the machine can.
Real: `eqrt serve` beside a process that sends ten object lists a second. Memory is resident size
(RSS); its slope is fitted over the second half of the time, when pools have filled.
"""

from __future__ import annotations

import argparse
import gc
import os
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from drives import TILE, shipped_predictor
from eqrt.runtime.bench.service.crowd import PROFILE, crowded_cycles
from eqrt.runtime.bench.service.orders import BusOrder, TrafficOrder
from eqrt.runtime.bench.service.programs import Program
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.bus.outbox import Outbox
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.datagrams import Datagram, decode_datagram, encode_datagrams
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.publish_can import CanPublisher
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from faults.promises import Promises, sound
from processes import Serving

PERIOD_S = 0.1
DAY_S = 86_400.0
MIB = 1 << 20
WARM_UP = 0.5  # of the time


@dataclass
class Soak:
    """What was seen."""

    name: str
    seconds: float
    times_s: list[float] = field(default_factory=list)
    memory_mib: list[tuple[float, float]] = field(default_factory=list)
    """Of the process's own data, and of pages of files (programs and libraries)."""
    modes: Counter[str] = field(default_factory=Counter)
    targets: Counter[str] = field(default_factory=Counter)
    latest_s: float = 0.0
    notes: str = ""

    def look(self, time_s: float, pid: int) -> None:
        """Note the memory of a process: every page counted (`statm` may be some pages off)."""
        _, *lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8").splitlines()
        mib = {name: int(size.split()[0]) / 1024 for name, size in (x.split(":") for x in lines)}
        own = mib["Anonymous"]
        self.times_s.append(time_s)
        self.memory_mib.append((own, mib["Rss"] - own))

    def heard(self, forecast: ForecastSet) -> None:
        """Count a cycle."""
        self.modes[forecast.mode.name] += 1
        values, counts = np.unique(forecast.agent_mode, return_counts=True)
        for value, count in zip(values.tolist(), counts.tolist(), strict=True):
            self.targets[Mode(value).name] += count

    @property
    def resident_mib(self) -> NDArray[np.float64]:
        """All of it, at every look."""
        own, files = np.array(self.memory_mib).T
        resident: NDArray[np.float64] = own + files
        return resident

    def slopes_mib_per_day(self) -> tuple[float, float]:
        """Of the least-squares lines through both kinds of memory, after the warm-up."""
        times_s, memory = np.array(self.times_s), np.array(self.memory_mib)
        kept = times_s >= times_s[0] + WARM_UP * (times_s[-1] - times_s[0])
        own, files = np.polyfit(times_s[kept], memory[kept], 1)[0] * DAY_S
        return float(own), float(files)

    def lines(self) -> Iterator[str]:
        """For the terminal."""
        hours = self.seconds / 3600.0
        yield f"{self.name}: {hours:.2f} h, {sum(self.modes.values())} cycles"
        yield f"  modes of cycles: {_counted(self.modes)}; of objects: {_counted(self.targets)}"
        resident, (own, files) = self.resident_mib, self.slopes_mib_per_day()
        middle = float(np.interp(WARM_UP * self.seconds, self.times_s, resident))
        yield (
            f"  memory: {resident[0]:.1f} MiB at first, {middle:.1f} after the warm-up, "
            f"{resident[-1]:.1f} in the end, at most {max(resident):.1f}"
        )
        yield (
            f"  slope: {own + files:+.2f} MiB a day, of which {own:+.2f} its own data, "
            f"{files:+.2f} pages of programs and libraries"
        )
        if self.notes:
            yield f"  {self.notes}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0 if every promise was kept."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--simulated-hours", type=float, default=24.0)
    parser.add_argument("--real-hours", type=float, default=1.0)
    parser.add_argument("--objects", type=int, default=32, help="of the service in real time")
    parser.add_argument("--simulated-objects", type=int, default=8, help="few: a day takes a while")
    args = parser.parse_args(arguments)
    if args.simulated_hours > 0.0:
        _print(simulated(3600.0 * args.simulated_hours, args.simulated_objects))
    if args.real_hours > 0.0:
        _print(real(3600.0 * args.real_hours, args.objects))
    return 0


def _print(soak: Soak) -> None:
    for line in soak.lines():
        print(line, flush=True)


class Nowhere:
    """A bus that takes everything."""

    protocol = can.CanProtocol.CAN_FD

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Forget it."""


def simulated(seconds: float, objects: int) -> Soak:
    """On a virtual clock; every promise is looked at."""
    soak = Soak("simulated", seconds)
    pipeline = Pipeline(load_profile(PROFILE), shipped_predictor(), load_tile(TILE))
    promises = Promises(pipeline.predictor.contract.dt_s)
    publisher = CanPublisher(Outbox(Nowhere()))
    drive = list(crowded_cycles(objects))
    blocks = []
    for number in range(round(seconds / PERIOD_S)):
        begun_s = number * PERIOD_S
        for message in drive[number % len(drive)]:
            now_s = begun_s + message.timestamp
            for forecast in [*pipeline.poll(now_s), *pipeline.feed(message, now_s)]:
                promises.look(forecast, now_s)
                promises.tick(now_s)
                publisher.publish(forecast)
                for _ in encode_datagrams(forecast):
                    pass
                soak.heard(forecast)
        if number % 6000 == 0:
            soak.look(begun_s, os.getpid())
            print(f"  {begun_s / 3600.0:5.2f} h {soak.resident_mib[-1]:.1f} MiB", flush=True)
        if number % len(drive) == 0:  # so that every look finds the drive at the same place
            gc.collect()
            blocks.append(sys.getallocatedblocks())
    soak.look(seconds, os.getpid())
    tracks = pipeline.tracks.counters
    middle = blocks[round(WARM_UP * (len(blocks) - 1))]
    soak.notes = (
        f"{tracks.tracks} tracks begun, {publisher.sent} CAN messages; Python's blocks of memory: "
        f"{middle} after the warm-up, {blocks[-1]} in the end"
    )
    return soak


def real(seconds: float, objects: int) -> Soak:
    """In real time, in processes."""
    soak = Soak("real", seconds)
    channel = f"soak-{os.getpid()}"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 * MIB)
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(5.0)
        options = ["--can", channel, "--can-interface", LOCAL, "--profile", PROFILE]
        options += ["--tile", str(TILE), "--datagrams", f"127.0.0.1:{ear.getsockname()[1]}"]
        order = TrafficOrder(
            bus=BusOrder(channel=channel, interface=LOCAL, fd=None),
            cores=tuple(sorted(os.sched_getaffinity(0))),
            objects=objects,
            period_s=PERIOD_S,
            log=None,
        )
        with Serving(*options, "--quiet") as service, Program(order, lambda: False) as traffic:
            traffic.wait_for("ready")
            last = _listen(soak, ear, service.pid, seconds)
            traffic.stop()
    totals = last.totals
    told = ("bus_dropped", "decoder_bad_counter", "pipeline_shed", "pipeline_fallbacks")
    missed = round(seconds / PERIOD_S) - sum(soak.modes.values())
    soak.notes = ", ".join([f"{name} {totals[name]}" for name in told])
    soak.notes += f", cycles not heard {missed}, latest {1e3 * soak.latest_s:.0f} ms"
    return soak


def _listen(soak: Soak, ear: socket.socket, pid: int, seconds: float) -> ServiceStatus:
    last: ServiceStatus | None = None
    begun_s = time.monotonic()
    while (now_s := time.monotonic()) < begun_s + seconds:
        told = decode_datagram(ear.recv(65_535))
        if isinstance(told, Datagram):
            sound(told.forecasts)
            soak.heard(told.forecasts)
        else:
            last = told
            soak.latest_s = max([soak.latest_s, *told.latencies_s])
            if not soak.times_s or now_s - begun_s >= soak.times_s[-1] + 10.0:
                soak.look(now_s - begun_s, pid)
                if len(soak.times_s) % 30 == 1:
                    own, files = soak.memory_mib[-1]
                    print(f"  {soak.times_s[-1] / 60.0:5.1f} min {own:.2f} + {files:.2f} MiB")
    assert last is not None, "no status came"
    return last


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.most_common())


if __name__ == "__main__":
    sys.exit(main())
