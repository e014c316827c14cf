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
from collections.abc import Iterator

import numpy as np

from service_latency import PERIOD_S, serve

SETTINGS = {
    "default": [],
    "realtime": [
        "--realtime-priority=50",
        "--realtime-lock-memory",
        "--realtime-gc-between-cycles",
        "--realtime-strict",
    ],
}


def main() -> None:
    """Measure each setting, without and with the hogs; a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for each row (default: 60)")
    parser.add_argument(
        "--hogs", type=int, nargs="+", default=[0, 3], help="programs beside it (default: 0 3)"
    )
    args = parser.parse_args()
    print("| hogs | settings | cycles | p50 ms | p99 | p99.9 | max | over 100 ms | shed |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for hogs in args.hogs:
        for name, options in SETTINGS.items():
            with eating(hogs):
                print(f"| {hogs} | {name} | {row(options, args.seconds)} |", flush=True)


def row(options: list[str], seconds: float) -> str:
    """The figures of one service."""
    latencies_ms, shed = serve(options, seconds)
    quantiles = np.quantile(latencies_ms, [0.5, 0.99, 0.999, 1.0])
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
