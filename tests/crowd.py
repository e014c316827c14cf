"""A crowd to watch: agents of every class around a moving ego vehicle, with modes that fan out.

`python tests/crowd.py HOST:PORT [AGENTS]` sends it as datagrams, ten cycles a second, until ended.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.forecasts import ForecastSet, Mode

DT_S, T, K, H = 0.1, 20, 6, 30
EGO_MPS = 12.0
LANE_M = 3.5
ROAD_M = 240.0  # what is seen of it
LENGTHS_M = np.array([np.nan, 4.6, 9.0, 2.2, 1.8, 0.6, 1.0, np.nan])
WIDTHS_M = np.array([np.nan, 1.8, 2.5, 0.8, 0.6, 0.6, 0.5, np.nan])
CURVATURES = np.array([0.0, 0.012, -0.012, 0.004, -0.004, 0.025])  # 1/m, one for each mode
PROBABILITIES = np.array([0.42, 0.2, 0.16, 0.11, 0.08, 0.03])


def crowd(cycle: int, agents: int = 64, *, start_s: float = 0.0) -> ForecastSet:
    """Cycle after cycle of a drive to the north-east; `start_s` is the time of the first."""
    time_s = cycle * DT_S
    random = np.random.default_rng(5)
    lane = np.arange(agents) % 8 - 4
    along_m = random.uniform(0.0, ROAD_M, agents)
    speed_mps = np.where(lane < 0, -1.0, 1.0) * random.uniform(7.0, 14.0, agents)
    kind = random.choice([0, 1, 1, 1, 1, 2, 3, 4, 5], agents)
    ego = Pose2(EGO_MPS * time_s * math.cos(0.6), EGO_MPS * time_s * math.sin(0.6), 0.6)

    turns, ahead_m = np.divmod(along_m + (speed_mps - EGO_MPS) * time_s, ROAD_M)

    def places(at_s: float) -> NDArray[np.float64]:
        """(A, 2) in a frame along the road; who leaves it comes from its other end as another."""
        moved_m = EGO_MPS * time_s + ahead_m - ROAD_M / 2.5 + speed_mps * (at_s - time_s)
        return np.stack([moved_m, LANE_M * (lane + 0.5)], axis=-1)

    steps_s = DT_S * np.arange(1, H + 1)
    way_m = speed_mps[:, None] * steps_s
    bend = CURVATURES[None, :, None] / 2.0 * (way_m[:, None] ** 2)
    future = places(time_s)[:, None, None] + np.stack(
        [np.broadcast_to(way_m[:, None], bend.shape), bend], axis=-1
    )
    history = np.stack([places(time_s - DT_S * back) for back in range(T - 1, -1, -1)], axis=1)
    spread = (0.1 + 0.35 * steps_s) ** 2
    covariance = np.einsum("h,ij->hij", spread, np.diag([3.0, 0.7]))
    turned = _rotation(0.6)
    return ForecastSet(
        cycle=cycle,
        timestamp_s=start_s + time_s,
        received_s=start_s + time_s + 0.003,
        made_s=start_s + time_s + 0.011,
        compute_s=0.008,
        mode=Mode.NO_MAP,
        model_id="c0ffee000000",
        tile_id="",
        map_from_ego=ego,
        ego_speed_mps=EGO_MPS,
        dt_s=DT_S,
        track_id=np.arange(1, agents + 1) + 100 * (turns.astype(np.int64) + 100),
        object_id=np.arange(agents),
        anchor_s=np.full(agents, start_s + time_s),
        agent_mode=np.where(np.arange(agents) % 9 == 4, Mode.PARTIAL, Mode.RUN).astype(np.uint8),
        position=places(time_s) @ turned.T,
        velocity=np.stack([speed_mps, np.zeros(agents)], axis=-1) @ turned.T,
        heading_rad=0.6 + np.where(speed_mps < 0, math.pi, 0.0),
        object_class=kind.astype(np.uint8),
        length_m=LENGTHS_M[kind],
        width_m=WIDTHS_M[kind],
        history=history @ turned.T,
        history_valid=np.ones((agents, T), np.bool_),
        trajectories=future @ turned.T,
        probabilities=np.tile(PROBABILITIES, (agents, 1)),
        covariances=np.broadcast_to(turned @ covariance @ turned.T, (agents, K, H, 2, 2)).copy(),
    )


def cycles(agents: int = 64) -> Iterator[ForecastSet]:
    """Ten a second, from now on, stamped with the monotonic clock."""
    start_s = time.monotonic()
    cycle = 0
    while True:
        time.sleep(max(0.0, start_s + cycle * DT_S + 0.011 - time.monotonic()))
        made = crowd(cycle, agents, start_s=start_s)
        yield replace(made, made_s=time.monotonic())
        cycle += 1


def _rotation(angle_rad: float) -> NDArray[np.float64]:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


def main() -> None:
    """Send."""
    with DatagramPublisher([sys.argv[1]]) as publisher:
        for forecast in cycles(int(sys.argv[2]) if len(sys.argv) > 2 else 64):
            publisher.publish(forecast)


if __name__ == "__main__":
    main()
