"""Scenes: what the model reads, built the same way from a recording and in the car.

Axes, the same everywhere in eqrt:

    A  agents known (all tracks)         Q  centerlines, padded
    B  targets in a batch                L  points per centerline
    N  agents of one scene, padded       H  horizon steps
    T  history steps, the last is now    K  modes

Lengths in metres. `history` and `centerlines` are in the tile frame (map minus `origin`), which is
what float32 can hold to a tenth of a millimetre; everything handed in is float64 in the map frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

RECENT_STEPS = 5
"""A neighbour counts if it was seen in the last half second."""
DIRECTION_STEPS = 10
"""Motion over the last second says which way a target drives."""
MIN_MOTION_M = 1.0
"""Less motion than this says nothing: a parked car seen by a radar wanders that far."""
ORIGIN_GRID_M = 100.0
"""The tile origin snaps to this grid, so that it is the same for cars that are close."""


class CenterlineSource(Protocol):
    """Finds the centerlines a target may follow (`eqrt.core.routes.RouteFinder`)."""

    def centerlines_batch(
        self,
        positions: Float64,
        directions: Float64,
        num_centerlines: int,
        centerline_points: int,
    ) -> tuple[Float64, Bool]:
        """Positions, directions (B, 2) -> centerlines (B, Q, L, 2) map frame, valid (B, Q, L)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentHistories:
    """Every agent known now, on one model clock."""

    positions: Float64
    """(A, T, 2) metres, map frame; anything where not valid."""
    valid: Bool
    """(A, T) True = seen."""
    heading: Float64
    """(A, 2) measured heading as a unit vector, map frame; (0, 0) = not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """The model's inputs for B targets (contract version 1) and where their tile frame lies."""

    history: NDArray[np.float32]
    """(B, N, T, 2) tile frame, the target first; 0 where not valid."""
    history_valid: Bool
    """(B, N, T)"""
    heading: NDArray[np.float32]
    """(B, 2)"""
    centerlines: NDArray[np.float32]
    """(B, Q, L, 2) tile frame; 0 where not valid."""
    centerlines_valid: Bool
    """(B, Q, L)"""
    origin: Float64
    """(2,) map position of the tile frame's zero."""

    def inputs(self) -> dict[str, NDArray[np.float32] | Bool]:
        """The model's feed, by the contract's names."""
        return {
            "history": self.history,
            "history_valid": self.history_valid,
            "heading": self.heading,
            "centerlines": self.centerlines,
            "centerlines_valid": self.centerlines_valid,
        }


def build_scene(
    agents: AgentHistories,
    targets: NDArray[np.intp],
    contract: ModelContract,
    centerlines: CenterlineSource | None,
    origin: Float64,
) -> Scene:
    """The scenes of the agents `targets` (B,), each of which was seen at least once.

    Around every target stand its N - 1 nearest recently seen agents, by distance at their last seen
    step, and the Q centerlines it may follow; without `centerlines` there is no map.
    """
    return build_scenes([(agents, targets)], contract, centerlines, origin)


def build_scenes(
    groups: Sequence[tuple[AgentHistories, NDArray[np.intp]]],
    contract: ModelContract,
    centerlines: CenterlineSource | None,
    origin: Float64,
) -> Scene:
    """The scenes of several groups of targets as one batch, one group after the other.

    Each group has the agents on its own model clock, and is as `build_scene` makes it; lanes are
    looked for once for all.
    """
    lasts = [last_seen(agents.positions, agents.valid) for agents, _ in groups]
    history, history_valid, heading = _joined(
        [
            _agents_around(agents, last, targets, contract.num_agents, origin)
            for (agents, targets), last in zip(groups, lasts, strict=True)
        ]
    )
    shape = (len(history), contract.num_centerlines, contract.centerline_points)
    points, points_valid = np.zeros((*shape, 2)), np.zeros(shape, np.bool_)
    if centerlines is not None:
        position, direction = _joined(
            [
                (last[targets], direction_of_motion(agents, last)[targets])
                for (agents, targets), last in zip(groups, lasts, strict=True)
            ]
        )
        points, points_valid = centerlines.centerlines_batch(position, direction, *shape[1:])
        points = np.where(points_valid[..., None], points - origin, 0.0)
    return Scene(
        history=history.astype(np.float32),
        history_valid=history_valid,
        heading=heading.astype(np.float32),
        centerlines=points.astype(np.float32),
        centerlines_valid=points_valid,
        origin=origin,
    )


def tile_origin(position: Float64) -> Float64:
    """(2,) the origin of the tile frame for a car at `position` (2,), map frame."""
    return np.asarray(np.round(position / ORIGIN_GRID_M) * ORIGIN_GRID_M, np.float64)


def concatenate(scenes: Sequence[Scene]) -> Scene:
    """Scenes of one origin as one batch, so that one run predicts all."""
    if len(scenes) == 1:
        return scenes[0]
    if any(not np.array_equal(scene.origin, scenes[0].origin) for scene in scenes):
        raise ValueError("scenes of different tile origins cannot share a batch")
    names = ("history", "history_valid", "heading", "centerlines", "centerlines_valid")
    return Scene(
        **{name: np.concatenate([getattr(scene, name) for scene in scenes]) for name in names},
        origin=scenes[0].origin,
    )


def last_seen(positions: Float64, valid: Bool) -> Float64:
    """(A, 2) position at the last valid step; NaN for an agent that was never seen."""
    steps = valid.shape[1]
    step = steps - 1 - np.argmax(valid[:, ::-1], axis=1)
    last = positions[np.arange(len(positions)), step]
    return np.where(np.any(valid, axis=1, keepdims=True), last, np.nan)


def direction_of_motion(agents: AgentHistories, last: Float64) -> Float64:
    """(A, 2) unit vector of each agent's motion in the last second, (0, 0) if it hardly moved.

    Falls back to the measured heading. Only chooses candidate lanes: what the network itself takes
    as heading is computed inside the graph.
    """
    recent = agents.valid[:, -DIRECTION_STEPS - 1 :]
    first = agents.positions[np.arange(len(recent)), -recent.shape[1] + np.argmax(recent, axis=1)]
    moved = np.where(np.any(recent, axis=1, keepdims=True), last - first, 0.0)
    length = np.hypot(moved[:, :1], moved[:, 1:])
    unit = moved / np.maximum(length, MIN_MOTION_M)
    return np.where(length >= MIN_MOTION_M, unit, agents.heading)


def _agents_around(
    agents: AgentHistories,
    last: Float64,
    targets: NDArray[np.intp],
    num_agents: int,
    origin: Float64,
) -> tuple[Float64, Bool, Float64]:
    """history (B, N, T, 2) tile frame, history_valid (B, N, T) and heading (B, 2) of targets."""
    rows, present = _scene_rows(last, agents.valid, targets, num_agents)  # (B, N)
    valid = agents.valid[rows] & present[..., None]
    history = np.where(valid[..., None], agents.positions[rows] - origin, 0.0)
    return history, valid, agents.heading[targets]


def _joined(parts: list[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Arrays of the groups, one group after the other."""
    if len(parts) == 1:
        return parts[0]
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def _scene_rows(
    last: Float64, valid: Bool, targets: NDArray[np.intp], num_agents: int
) -> tuple[NDArray[np.intp], Bool]:
    """Agent index (B, N) of every scene row, the target first, and whether the row is taken."""
    recent = valid[:, -RECENT_STEPS:].any(axis=1)
    offset = last[None, :, :] - last[targets][:, None, :]  # (B, A, 2)
    distance = np.where(recent, np.square(offset).sum(-1), np.inf)
    distance[np.arange(len(targets)), targets] = -1.0  # the target comes first
    order = np.argsort(distance, axis=1, kind="stable")[:, :num_agents]
    rows = np.zeros((len(targets), num_agents), np.intp)
    present = np.zeros(rows.shape, np.bool_)
    rows[:, : order.shape[1]] = order
    present[:, : order.shape[1]] = np.isfinite(distance[np.arange(len(order))[:, None], order])
    return rows, present
