"""What `--record` costs the service in latency.

    make recording-cost

The service of `make under-load` with and without a recording, in turns, so that whatever else the
machine does meets both. A ratio is that of a turn with to the turn without that stands beside it.
Wants an otherwise quiet machine.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service_latency import serve

QUANTILES = {"median": 0.5, "p99": 0.99}


def main() -> None:
    """Take turns; a table of every turn, then of all together."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0, help="for each turn (default: 30)")
    parser.add_argument("--pairs", type=int, default=6, help="of turns (default: 6)")
    args = parser.parse_args()
    print("| pair | cycles | without: median ms | p99 | with: median ms | p99 | load average |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    found = np.array([pair(number, args.seconds) for number in range(args.pairs)])
    for name, column in zip(QUANTILES, range(len(QUANTILES)), strict=True):
        without, with_ = found[:, 0, column], found[:, 1, column]
        ratios = np.sort(with_ / without)
        print(
            f"{name}: {np.median(without):.2f} ms without, {np.median(with_):.2f} ms with; ratio "
            f"{np.median(ratios):.3f} (median of {len(ratios)} pairs, {ratios[0]:.3f} to "
            f"{ratios[-1]:.3f})"
        )


def pair(number: int, seconds: float) -> NDArray[np.float64]:
    """(2, 2) ms, without and with a recording, median and p99; every other pair begins with it."""
    turns = [False, True] if number % 2 == 0 else [True, False]
    latencies_ms = {is_recorded: turn(is_recorded, seconds) for is_recorded in turns}
    quantiles = np.array(
        [np.quantile(latencies_ms[one], list(QUANTILES.values())) for one in (False, True)]
    )
    told = " | ".join(f"{value:.2f}" for value in quantiles.ravel())
    cycles = sum(map(len, latencies_ms.values()))
    print(f"| {number + 1} | {cycles} | {told} | {os.getloadavg()[0]:.1f} |", flush=True)
    return quantiles


def turn(is_recorded: bool, seconds: float) -> NDArray[np.float64]:
    """Latencies of one service, ms."""
    with tempfile.TemporaryDirectory() as folder:
        options = ["--record", str(Path(folder) / "rec")] if is_recorded else []
        latencies_ms, _ = serve(options, seconds)
    return latencies_ms


if __name__ == "__main__":
    main()
