"""One cycle's predictions: the nearest targets first, for as long as there is time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.scene import (
    AgentHistories,
    CenterlineSource,
    Scene,
    build_scenes,
    tile_origin,
)
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.targets import Bool, Float64, Targets
from eqrt.runtime.prediction.watched import Failed, Runner, TooLate
from eqrt.runtime.tracking.ego import EgoState, EgoTracker
from eqrt.runtime.tracking.tracks import Tracks, TrackStore

Index = NDArray[np.intp]
BATCH = 32
"""Targets whose scenes are built, and given to the model, at once. Every batch searches all agents
and lanes anew; a smaller one would leave less undone when time runs out.
"""


@dataclass(slots=True)
class Raw:
    """What the model said, before the guard.

    Arrays share the axis B: the nearest BATCH targets first, in a batch by time of measurement.
    """

    targets: Targets
    trajectories: Float64
    """(B, K, H, 2) map frame; NaN = the model said nothing."""
    probabilities: Float64
    """(B, K) likewise."""
    covariances: Float64 | None
    """(B, K, H, 2, 2) likewise; None from a model that predicts none."""
    late: Bool
    """(B,) there was no time for it."""
    has_lanes: bool = False
    """The model was given some centerline."""
    scene_s: float = 0.0
    infer_s: float = 0.0

    @classmethod
    def silent(cls, targets: Targets, contract: ModelContract) -> Raw:
        """As if the model had said nothing."""
        shape = (len(targets), contract.num_modes, contract.horizon_steps, 2)
        return cls(
            targets=targets,
            trajectories=np.full(shape, np.nan),
            probabilities=np.full(shape[:2], np.nan),
            covariances=np.full((*shape, 2), np.nan) if contract.covariances else None,
            late=np.zeros(len(targets), np.bool_),
        )

    def take(self, rows: slice, said: Prediction) -> None:
        """The model's word on some targets."""
        self.trajectories[rows] = said.trajectories
        self.probabilities[rows] = said.probabilities
        if self.covariances is not None and said.covariances is not None:
            self.covariances[rows] = said.covariances


@dataclass(frozen=True, slots=True)
class Deadline:
    """Until when the model may work on a cycle, by a clock of the caller's."""

    clock: Callable[[], float]
    shed_s: float
    """No run is begun that would end later, if it took as long as the longest so far."""
    end_s: float
    """A run that is not over then is given up."""


class Forecaster:
    """Builds scenes from tracks and runs the model on them."""

    def __init__(
        self,
        contract: ModelContract,
        runner: Runner,
        lanes: CenterlineSource | None,
        tracks: TrackStore,
        ego: EgoTracker,
    ) -> None:
        self._contract = contract
        self._runner = runner
        self._lanes = lanes
        self._tracks = tracks
        self._ego = ego

    def predict(self, tracks: Tracks, alive: Bool, ego: EgoState, deadline: Deadline) -> Raw:
        """Every track that is alive as a target, its history ending at its own last measurement.

        Targets measured at the same time share a clock. Runs are of up to BATCH targets, and
        those that would end too late are left out.
        """
        begun_s = deadline.clock()
        batches = [_by_time(tracks, rows) for rows in _nearest_first(tracks, alive, ego)]
        agents = {time_s: self._agents(tracks, time_s) for batch in batches for time_s in batch}
        raw = Raw.silent(_targets(tracks, agents, batches), self._contract)
        raw.scene_s = deadline.clock() - begun_s
        longest_s = 0.0
        for number, batch in enumerate(batches):
            begun_s = deadline.clock()
            part = slice(BATCH * number, BATCH * (number + 1))
            if begun_s + longest_s > deadline.shed_s:
                raw.late[part.start :] = True
                break
            scene = self._scene(batch, agents, ego)
            built_s = deadline.clock()
            self._run(raw, part, scene, deadline.end_s - built_s)
            ended_s = deadline.clock()
            raw.scene_s += built_s - begun_s
            raw.infer_s += ended_s - built_s
            longest_s = max(longest_s, ended_s - begun_s)
        return raw

    def _run(self, raw: Raw, part: slice, scene: Scene, patience_s: float) -> None:
        try:
            raw.take(part, self._runner.run(scene, patience_s))
        except TooLate:
            raw.late[part] = True
        except Failed:
            return  # its NaN says so
        raw.has_lanes |= bool(scene.centerlines_valid.any())

    def _scene(
        self, batch: dict[float, Index], agents: dict[float, AgentHistories], ego: EgoState
    ) -> Scene:
        origin = tile_origin(np.array([ego.map_from_ego.x_m, ego.map_from_ego.y_m]))
        lanes = self._lanes if ego.has_map_pose else None
        groups = [(agents[time_s], rows) for time_s, rows in batch.items()]
        return build_scenes(groups, self._contract, lanes, origin)

    def _agents(self, tracks: Tracks, anchor_s: float) -> AgentHistories:
        """All tracks, and the ego vehicle after them, on the clock that ends at `anchor_s`."""
        steps, dt_s = self._contract.history_steps, self._contract.dt_s
        positions, valid = self._tracks.history(anchor_s, steps, dt_s, tracks.row)
        facing = np.stack([np.cos(tracks.heading_rad), np.sin(tracks.heading_rad)], axis=1)
        heading = np.where(np.isfinite(facing), facing, 0.0)
        past = [self._ego.map_from_ego(anchor_s - k * dt_s) for k in range(steps - 1, -1, -1)]
        own = [(np.nan, np.nan) if pose is None else (pose.x_m, pose.y_m) for pose in past]
        seen = [pose is not None for pose in past]
        return AgentHistories(
            positions=np.concatenate([positions, np.array(own)[None]]),
            valid=np.concatenate([valid, np.array(seen)[None]]),
            heading=np.concatenate([heading, np.zeros((1, 2))]),
        )


def _nearest_first(tracks: Tracks, alive: Bool, ego: EgoState) -> list[Index]:
    """The tracks that are alive, in batches, the nearest to the ego vehicle in the first."""
    rows = np.flatnonzero(alive)
    offset = tracks.position[rows] - (ego.map_from_ego.x_m, ego.map_from_ego.y_m)
    rows = rows[np.argsort(np.hypot(offset[:, 0], offset[:, 1]), kind="stable")]
    return [rows[start : start + BATCH] for start in range(0, len(rows), BATCH)]


def _by_time(tracks: Tracks, rows: Index) -> dict[float, Index]:
    """Time of the last measurement -> the tracks measured then."""
    time_s = tracks.timestamp_s[rows]
    return {float(t): rows[time_s == t] for t in np.unique(time_s)}


def _targets(
    tracks: Tracks, agents: dict[float, AgentHistories], batches: list[dict[float, Index]]
) -> Targets:
    parts = [
        Targets.of(tracks, agents[time_s], rows)
        for batch in batches
        for time_s, rows in batch.items()
    ]
    return Targets.join(parts)
