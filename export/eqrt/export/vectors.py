"""Named scenes that every artifact carries as test vectors, with known answers to give.

A gently curving road of three lanes, the target in the middle one, cars around it: enough for the
map, the neighbours and every mask to matter. Nothing here is random, so the vectors are the same on
every machine. Tile frame, metres.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene

RADIUS_M = 220.0
LANE_WIDTH_M = 3.5
TURNED = Pose2(-431.7, 212.3, 2.1)
"""Where the turned and shifted twin of a scene lies."""
TWINS = {
    "driving_turned": "driving",
    "stopped_turned": "stopped_no_heading",
    "reversing_turned": "reversing",
}
"""Scenes that are others, turned and shifted by TURNED."""
FAR = Pose2(700.0, -700.0, 0.0)
"""The edge of a tile: 1 km from its origin."""

Float32 = NDArray[np.float32]


def named_scenes(contract: ModelContract) -> dict[str, Scene]:
    """One scene (B = 1) per name, for the sizes of `contract`."""
    return _driving_scenes(contract) | _standing_scenes(contract) | _scenes_with_holes(contract)


def _driving_scenes(contract: ModelContract) -> dict[str, Scene]:
    driving = road_scene(contract, speed_mps=12.0)
    bend = road_scene(contract, speed_mps=6.0, radius_m=18.0)
    west = move(road_scene(contract, speed_mps=9.0), Pose2(20.0, 5.0, np.pi))
    return {
        "driving": driving,
        "driving_turned": move(driving, TURNED),
        "driving_far": move(driving, FAR),
        "driving_heading_known": replace(driving, heading=np.array([[1.0, 0.0]], np.float32)),
        "fast": road_scene(contract, speed_mps=38.0),
        "braking": road_scene(contract, speed_mps=8.0, acceleration_mps2=-4.0),
        "bend": bend,
        "bend_turned": move(bend, TURNED),
        "heading_pi": replace(west, heading=np.array([[-1.0, 0.0]], np.float32)),
    }


def _standing_scenes(contract: ModelContract) -> dict[str, Scene]:
    stopped = road_scene(contract, speed_mps=0.0)
    creeping = road_scene(contract, speed_mps=0.7)
    reversing = replace(creeping, heading=np.array([[-1.0, 0.0]], np.float32))
    return {
        "crawling": road_scene(contract, speed_mps=0.6),
        "reversing": reversing,
        "reversing_turned": move(reversing, TURNED),
        "stopped": replace(stopped, heading=np.array([[1.0, 0.0]], np.float32)),
        "stopped_no_heading": stopped,
        "stopped_turned": move(stopped, TURNED),
        "lone_agent_no_map_stopped": without_neighbours(without_map(stopped)),
    }


def _scenes_with_holes(contract: ModelContract) -> dict[str, Scene]:
    driving = road_scene(contract, speed_mps=12.0)
    half = seen_for(driving, contract.history_steps // 2)
    return {
        "no_map": without_map(driving),
        "no_map_turned": move(without_map(driving), TURNED),
        "one_line": without_map(driving, but=1),
        "lone_agent": without_neighbours(driving),
        "seen_once": seen_for(driving, 1),
        "seen_half": half,
        "seen_now_and_then": seen_every(driving, 3),
        "nan_under_false": nan_where_invalid(half),
        "nan_under_false_everywhere": nan_where_invalid(
            without_map(without_neighbours(seen_every(driving, 4)), but=1)
        ),
    }


def road_scene(
    contract: ModelContract,
    speed_mps: float,
    *,
    acceleration_mps2: float = 0.0,
    radius_m: float = RADIUS_M,
) -> Scene:
    """The target at the origin heading along +x at `speed_mps`, others ahead, behind and beside.

    `acceleration_mps2` has been everybody's for all the history; the road bends by `radius_m`.
    """
    agents, lines = contract.num_agents, contract.num_centerlines
    time = (np.arange(contract.history_steps) - contract.history_steps + 1) * contract.dt_s
    gap = np.array([((i + 1) // 2) * 14.0 * (-1) ** (i + 1) for i in range(agents)])
    lane = np.array([(0, 1, 0, -1)[i % 4] for i in range(agents)])
    speed = speed_mps * (1.0 + 0.05 * np.sin(np.arange(agents)))
    speed[0] = speed_mps
    path = speed[:, None] * time + 0.5 * acceleration_mps2 * time**2
    history = on_road(gap[:, None] + path, lane[:, None] * LANE_WIDTH_M, radius_m)  # (N, T, 2)
    along = np.linspace(-10.0, 90.0, contract.centerline_points)
    offset = np.array([((q + 1) // 2) * (-1) ** q for q in range(lines)]) * LANE_WIDTH_M
    along = np.broadcast_to(along, (lines, len(along)))
    centerlines = on_road(along, offset[:, None], radius_m)
    valid = np.ones(centerlines.shape[:2], np.bool_)
    valid[lines // 2 :, -contract.centerline_points // 3 :] = False  # some lanes end early
    return Scene(
        history=history[None].astype(np.float32),
        history_valid=np.ones((1, agents, contract.history_steps), np.bool_),
        heading=np.zeros((1, 2), np.float32),
        centerlines=centerlines[None].astype(np.float32),
        centerlines_valid=valid[None],
        origin=np.zeros(2),
    )


def on_road(
    station: NDArray[np.float64], offset: NDArray[np.float64], radius_m: float
) -> NDArray[np.float64]:
    """Positions (..., 2) `station` metres along a left-hand bend, `offset` metres to its left.

    After a quarter of a circle the road goes on straight.
    """
    arc = np.clip(station, -0.5 * np.pi * radius_m, 0.5 * np.pi * radius_m)
    angle, beyond = arc / radius_m, station - arc
    radius = radius_m - offset
    bend = np.stack([radius * np.sin(angle), radius_m - radius * np.cos(angle)], axis=-1)
    onward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(bend + beyond[..., None] * onward)


def move(scene: Scene, tile_from_scene: Pose2) -> Scene:
    """The same scene, turned and shifted."""

    def points(values: Float32) -> Float32:
        return tile_from_scene.apply(values.astype(np.float64)).astype(np.float32)

    heading = tile_from_scene.rotate(scene.heading.astype(np.float64)).astype(np.float32)
    return replace(
        scene,
        history=points(scene.history),
        centerlines=points(scene.centerlines),
        heading=heading,
    )


def without_map(scene: Scene, but: int = 0) -> Scene:
    """No centerline is valid, `but` the first."""
    valid = scene.centerlines_valid.copy()
    valid[:, but:] = False
    return replace(scene, centerlines_valid=valid)


def without_neighbours(scene: Scene) -> Scene:
    """Only the target was ever seen."""
    valid = scene.history_valid.copy()
    valid[:, 1:] = False
    return replace(scene, history_valid=valid)


def seen_for(scene: Scene, steps: int) -> Scene:
    """Every agent was seen in the last `steps` steps only."""
    valid = scene.history_valid.copy()
    valid[:, :, :-steps] = False
    return replace(scene, history_valid=valid)


def seen_every(scene: Scene, steps: int) -> Scene:
    """Every agent was seen now, and before in every `steps`-th step only."""
    valid = scene.history_valid.copy()
    now = valid.shape[2] - 1
    valid[:, :, (now - np.arange(valid.shape[2])) % steps != 0] = False
    return replace(scene, history_valid=valid)


def nan_where_invalid(scene: Scene) -> Scene:
    """NaN wherever a mask is False: it must change nothing."""
    return replace(
        scene,
        history=np.where(scene.history_valid[..., None], scene.history, np.float32(np.nan)),
        centerlines=np.where(
            scene.centerlines_valid[..., None], scene.centerlines, np.float32(np.nan)
        ),
    )
