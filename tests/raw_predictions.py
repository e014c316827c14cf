"""What a model says about targets that drive straight on, before the guard has seen it."""

from __future__ import annotations

import numpy as np

from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.prediction.forecaster import Raw
from eqrt.runtime.prediction.targets import Targets

DT_S = 0.1
STEPS = 30
AHEAD_S = DT_S * np.arange(1, STEPS + 1)


def driving(
    speed_mps: float = 12.0, kind: int = ObjectClass.CAR, targets: int = 1, modes: int = 2
) -> Raw:
    """Targets that drive along +x and are at (0, 0) now; every mode goes on like that."""
    history = np.stack([speed_mps * DT_S * np.arange(-19, 1), np.zeros(20)], axis=-1)
    ahead = np.stack([speed_mps * AHEAD_S, np.zeros(STEPS)], axis=-1)
    unknown = np.full(targets, np.nan)
    return Raw(
        targets=Targets(
            track_id=np.arange(targets),
            object_id=np.arange(targets),
            anchor_s=np.zeros(targets),
            velocity=np.full((targets, 2), np.nan),
            heading_rad=unknown,
            object_class=np.full(targets, kind, np.uint8),
            length_m=unknown,
            width_m=unknown,
            history=np.tile(history, (targets, 1, 1)),
            valid=np.ones((targets, 20), np.bool_),
        ),
        trajectories=np.tile(ahead, (targets, modes, 1, 1)),
        probabilities=np.full((targets, modes), 1.0 / modes),
        covariances=None,
        late=np.zeros(targets, np.bool_),
    )
