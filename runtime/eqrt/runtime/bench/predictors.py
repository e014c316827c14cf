"""The workloads of `eqrt bench`: the model, and beside it what physics costs.

All answer the same question with the same result: trajectories in the map frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eqrt.core.contract import ModelContract
from eqrt.core.kalman import kalman
from eqrt.core.kinematics import constant_turn, constant_velocity, fit_motion
from eqrt.core.scene import Scene
from eqrt.runtime.bench.report import MODEL
from eqrt.runtime.bench.scenes import ScenePool
from eqrt.runtime.bench.schedule import CLOCK, Clock
from eqrt.runtime.prediction.predictor import Predictor


class TimedSession:
    """An onnxruntime session that adds up the time spent in it."""

    def __init__(self, session: Any, clock: Clock) -> None:
        self._session = session
        self._clock = clock
        self.spent_ns = 0

    def run(self, outputs: list[str], feed: dict[str, Any]) -> Any:
        """As the session's own."""
        started_ns = self._clock()
        found = self._session.run(outputs, feed)
        self.spent_ns += self._clock() - started_ns
        return found


class TimedPredictor(Predictor):
    """The predictor of the car, unchanged, that knows how long its model ran."""

    def __init__(self, session: Any, contract: ModelContract, sha256: str, metadata: Any) -> None:
        self.session = TimedSession(session, CLOCK)
        super().__init__(self.session, contract, sha256, metadata)
        self.sha256 = sha256
        """Of `model.onnx`, all 64 digits."""
        self._metadata = metadata

    def with_session(self, session: Any) -> TimedPredictor:
        """The same model, run by another session."""
        return TimedPredictor(session, self.contract, self.sha256, self._metadata)


def load_timed(artifact: Path, threads: int) -> TimedPredictor:
    """Check and load an artifact. Raises ContractError, as `Predictor.load`."""
    return TimedPredictor.load(artifact, threads)


class ModelWorkload:
    """One prediction of so many targets."""

    stages = ("gather", "infer", "map frame")
    """Taking the targets' inputs from the pool; running the graph; everything else that
    `Predictor.predict` does: cutting batches, joining results, going back to the map frame."""

    def __init__(
        self, predictor: TimedPredictor, pool: ScenePool, targets: int, name: str = MODEL
    ) -> None:
        self.name = name
        self._predictor = predictor
        self._pool = pool
        self._targets = targets

    def run(self, number: int) -> Sequence[int]:
        """Predict once; nanoseconds per stage."""
        session = self._predictor.session
        session.spent_ns = 0
        started_ns = CLOCK()
        scene = self._pool.draw(number, self._targets)
        gathered_ns = CLOCK()
        self._predictor.predict(scene)
        ended_ns = CLOCK()
        spent_ns = session.spent_ns
        return gathered_ns - started_ns, spent_ns, ended_ns - gathered_ns - spent_ns


class PhysicsWorkload:
    """The same targets, by physics alone, in numpy."""

    stages = ("gather", "predict")

    def __init__(
        self, name: str, pool: ScenePool, targets: int, horizon_steps: int, dt_s: float
    ) -> None:
        """`name`: one of PHYSICS."""
        self.name = name
        self._predict = PHYSICS[name]
        self._pool = pool
        self._targets = targets
        self._horizon_steps = horizon_steps
        self._dt_s = dt_s

    def run(self, number: int) -> Sequence[int]:
        """Predict once; nanoseconds per stage."""
        started_ns = CLOCK()
        scene = self._pool.draw(number, self._targets)
        gathered_ns = CLOCK()
        self._predict(scene, self._horizon_steps, self._dt_s)
        return gathered_ns - started_ns, CLOCK() - gathered_ns


def _constant_velocity(scene: Scene, horizon_steps: int, _dt_s: float) -> Any:
    history, valid = _own_history(scene)
    return constant_velocity(history, valid, horizon_steps) + scene.origin


def _constant_turn(scene: Scene, horizon_steps: int, dt_s: float) -> Any:
    history, valid = _own_history(scene)
    velocity, turn_rate_rad_s = fit_motion(history, valid, dt_s)
    now = history[:, -1]
    return constant_turn(now, velocity, turn_rate_rad_s, horizon_steps, dt_s) + scene.origin


def _kalman(scene: Scene, horizon_steps: int, dt_s: float) -> Any:
    history, valid = _own_history(scene)
    return kalman(history, valid, horizon_steps, dt_s) + scene.origin


PHYSICS = {
    "constant velocity": _constant_velocity,
    "constant turn rate": _constant_turn,
    "Kalman filter": _kalman,
}


def _own_history(scene: Scene) -> tuple[Any, Any]:
    """Of the targets alone: (B, T, 2), valid (B, T)."""
    return scene.history[:, 0].astype(np.float64), scene.history_valid[:, 0]


def physics(contract: ModelContract, pool: ScenePool, targets: int) -> tuple[PhysicsWorkload, ...]:
    """All of PHYSICS, on the scenes that a model of this contract is asked about."""
    steps, dt_s = contract.horizon_steps, contract.dt_s
    return tuple(PhysicsWorkload(name, pool, targets, steps, dt_s) for name in PHYSICS)
