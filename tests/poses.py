"""Random places and directions in a tile."""

from __future__ import annotations

import numpy as np

from eqrt.core.frames import Pose2


def random_pose(rng: np.random.Generator, reach_m: float) -> Pose2:
    """Up to `reach_m` away in x and y, at any rotation."""
    x, y, turn = rng.uniform(-1.0, 1.0, 3).tolist()
    return Pose2(reach_m * x, reach_m * y, np.pi * turn)
