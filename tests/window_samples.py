"""Contracts, recordings and packed scenes that tests of prepared data share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from eqrt.core.contract import ModelContract
from eqrt.training.dataset.windows import WindowCutter, WindowOptions, Windows
from eqrt.training.recordings.commonroad_recordings import CommonRoadReader
from eqrt.training.recordings.recording import Recording
from packed_scenes import PackedScene, straight, write_packed
from source_tree import ROOT

NGSIM = ROOT / "tests/data/ngsim"
SCENARIO = NGSIM / "USA_Peach-4_8_T-1.xml.gz"
CONTRACT = ModelContract(
    name="test",
    version="0.0.0",
    num_agents=4,
    history_steps=20,
    num_centerlines=3,
    centerline_points=8,
    horizon_steps=30,
    num_modes=1,
    dt_s=0.1,
)
ROOMY = replace(CONTRACT, num_agents=7, num_centerlines=6)
"""What serves CONTRACT, too."""
OPTIONS = WindowOptions(stride=10)


def scenario() -> Recording:
    """One of NGSIM's, with lanes."""
    reader = CommonRoadReader()
    return next(iter(reader.read(reader.parts(SCENARIO)[0])))


def scenario_windows(contract: ModelContract = CONTRACT, number: int = 0) -> Windows:
    """Its windows."""
    return WindowCutter(contract, OPTIONS).cut(scenario(), number)


def packed_scenes(path: Path, scenes: int = 70) -> Path:
    """Scenes of a target that drives, ever faster from scene to scene, and three cars around it."""
    lanes = [np.array([[-60.0, y], [0.0, y], [140.0, y]]) for y in (0.0, 3.5, -3.5)]
    half_seen = straight(9.0) + np.array([0.0, 3.5])
    half_seen[:12] = np.nan
    return write_packed(
        path,
        [
            PackedScene(
                [
                    straight(4.0 + 0.1 * number),
                    straight(8.0) + np.array([-10.0, 0.0]),
                    half_seen,
                    straight(0.0) + np.array([20.0, -3.5]),
                ],
                lanes,
            )
            for number in range(scenes)
        ],
    )


def assert_same(one: Windows, other: Windows) -> None:
    """Every array, bit for bit and of the same type."""
    for name in Windows.__annotations__:
        ours, theirs = getattr(one, name), getattr(other, name)
        assert ours.dtype == theirs.dtype, name
        np.testing.assert_array_equal(ours, theirs, name)
