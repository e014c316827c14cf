"""A model that a reader can compute: everything goes on as in its last step."""

from __future__ import annotations

import numpy as np

from eqrt.core.contract import ModelContract
from eqrt.core.scene import Scene
from eqrt.runtime.prediction.predictor import Prediction

DT_S = 0.125  # which a float holds exactly
CONTRACT = ModelContract(
    name="steady",
    version="1.0.0",
    num_agents=3,
    history_steps=4,
    num_centerlines=2,
    centerline_points=5,
    horizon_steps=3,
    num_modes=2,
    dt_s=DT_S,
)


class Steady:
    """Every target goes on as in its last step, or stands. Keeps the scenes that it read."""

    def __init__(self, contract: ModelContract = CONTRACT) -> None:
        self.contract = contract
        self.model_id = "steady"
        self.scenes: list[Scene] = []

    def predict(self, scene: Scene) -> Prediction:
        """Two modes, of which the first is thrice as probable, and the same path."""
        self.scenes.append(scene)
        last = scene.history[:, 0, -1].astype(np.float64)
        seen = scene.history_valid[:, 0, -2, None]
        step = np.where(seen, last - scene.history[:, 0, -2], 0.0)
        ahead = np.arange(1, self.contract.horizon_steps + 1)[:, None]
        path = scene.origin + last[:, None] + step[:, None] * ahead
        probabilities = np.tile(np.array([0.75, 0.25], np.float32), (len(path), 1))
        trajectories = np.stack([path, path], axis=1)
        covariances = np.zeros((*trajectories.shape, 2)) + np.eye(2)
        return Prediction(
            trajectories, probabilities, covariances if self.contract.covariances else None
        )

    def again(self) -> Steady:
        """Another one."""
        return Steady(self.contract)
