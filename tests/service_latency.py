"""How long `eqrt serve` takes for 32 objects ten times a second, by its own count."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drives import Car, cycle
from eqrt.core.frames import Pose2
from eqrt.runtime.bus.buses import LOCAL, open_bus
from processes import Heard, Serving

OBJECTS = 32
PERIOD_S = 0.1
WARM_UP_S = 3
CARS = [Car(object_id=i, x_m=8.0 * i, y_m=4.0 * (i % 3), speed_mps=0.5) for i in range(OBJECTS)]


def serve(options: Sequence[str], seconds: float) -> tuple[NDArray[np.float64], int]:
    """Of a service on the local bus with `options`, after its warm-up: latencies of its cycles in
    ms, from the arrival of the last message (stamped by the kernel) until the predictions had been
    sent; and how many targets it had no time for.
    """
    channel = f"latency-{time.monotonic_ns()}"
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
    shed = statuses[-1].totals["pipeline_shed"] - statuses[0].totals["pipeline_shed"]
    return latencies_ms, shed
