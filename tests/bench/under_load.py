"""What three programs that use all they can get do to the service, with and without `[realtime]`.

    make under-load

`eqrt serve` as installed, on the local bus, 32 objects ten times a second. Its own latencies are
counted: from the arrival of a cycle's last message (stamped by the kernel) until its predictions
have been sent. Needs the rights of docs/operations.md; wants an otherwise quiet machine.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import time
from collections.abc import Iterator

import numpy as np

from drives import Car, cycle
from eqrt.core.frames import Pose2
from eqrt.runtime.bus.buses import LOCAL, open_bus
from processes import Heard, Serving

OBJECTS = 32
PERIOD_S = 0.1
WARM_UP_S = 3
SETTINGS = {
    "default": [],
    "realtime": [
        "--realtime-priority=50",
        "--realtime-lock-memory",
        "--realtime-gc-between-cycles",
        "--realtime-strict",
    ],
}
CARS = [Car(object_id=i, x_m=8.0 * i, y_m=4.0 * (i % 3), speed_mps=0.5) for i in range(OBJECTS)]


def main() -> None:
    """Measure each setting, without and with the hogs; a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for each row (default: 60)")
    parser.add_argument("--hogs", type=int, default=3, help="programs beside it (default: 3)")
    args = parser.parse_args()
    print("| hogs | settings | cycles | p50 ms | p99 | p99.9 | max | over 100 ms | shed |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for hogs in (0, args.hogs):
        for name, options in SETTINGS.items():
            with eating(hogs):
                print(f"| {hogs} | {name} | {row(options, args.seconds)} |", flush=True)


def row(options: list[str], seconds: float) -> str:
    """The figures of one service."""
    channel = f"load-{time.monotonic_ns()}"
    with (
        Heard(channel, []) as heard,
        Serving(
            "--can", channel, "--can-interface", LOCAL, "--profile", "generic", "--quiet",
            "--datagrams", heard.address, *options,
        ),
        open_bus(channel, LOCAL, receive_ids=[]) as bus,
    ):  # fmt: skip
        begun_s = time.monotonic()
        step = 0
        while time.monotonic() < begun_s + WARM_UP_S + seconds:
            for message in cycle(CARS, step * PERIOD_S, pose=Pose2()):
                bus.send(message)
            step += 1
            time.sleep(max(0.0, begun_s + step * PERIOD_S - time.monotonic()))
        statuses = heard.statuses[WARM_UP_S:]
    latencies_ms = 1e3 * np.array([one for status in statuses for one in status.latencies_s])
    quantiles = np.quantile(latencies_ms, [0.5, 0.99, 0.999, 1.0])
    shed = statuses[-1].totals["pipeline_shed"] - statuses[0].totals["pipeline_shed"]
    late = int(np.count_nonzero(latencies_ms > 1e3 * PERIOD_S))
    told = " | ".join(f"{value:.1f}" for value in quantiles)
    return f"{len(latencies_ms)} | {told} | {late} | {shed}"


@contextlib.contextmanager
def eating(hogs: int) -> Iterator[None]:
    """So many programs that never wait."""
    programs = [multiprocessing.Process(target=_eat, daemon=True) for _ in range(hogs)]
    for program in programs:
        program.start()
    try:
        yield
    finally:
        for program in programs:
            program.terminate()
            program.join()


def _eat() -> None:
    while True:
        pass


if __name__ == "__main__":
    main()
