"""How long candidate centerlines take, on a recorded junction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from eqrt.core.routes import RouteFinder
from eqrt.training.recordings.commonroad import lane_map, read_scenario

JUNCTION = Path(__file__).parents[1] / "data/ngsim/USA_Lanker-2_23_T-1.xml.gz"
BUDGET_S = 0.004  # for 32 targets, at the median, on two cores


def test_centerlines_for_32_targets(benchmark: Any) -> None:
    scenario = read_scenario(JUNCTION)
    tracks = scenario.tracks[:32]
    heading = np.array([track.heading_rad[0] for track in tracks])
    positions = np.array([track.position[0] for track in tracks])
    directions = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    routes = RouteFinder(lane_map(scenario))
    find = routes.centerlines_batch
    benchmark.pedantic(find, (positions, directions, 8, 20), rounds=300, warmup_rounds=20)
    if benchmark.enabled:
        assert np.median(benchmark.stats.stats.data) < BUDGET_S
