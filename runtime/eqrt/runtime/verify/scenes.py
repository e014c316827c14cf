"""Scenes to try a model on: the stored ones cleaned, new ones made from them, and hostile ones.

Each is one target (B = 1). Metres; the origin is 0, so that the tile frame is the map frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.frames import Pose2
from eqrt.core.kinematics import fit_motion
from eqrt.core.scene import Scene, concatenate
from eqrt.runtime.prediction.stored_vectors import StoredVector

REACH_M = 1000.0
"""How far from the tile frame's zero a target may be."""
DRAWN = 50
"""New scenes made from the stored ones."""
LANE_M = 3.5

Scenes = dict[str, Scene]


def stored_scenes(vectors: Sequence[StoredVector]) -> Scenes:
    """Every target of the test vectors, 0 where a mask is False."""
    scenes: Scenes = {}
    for vector in vectors:
        for row in range(len(vector.scene.history)):
            name = vector.name if row == 0 else f"{vector.name}, target {row}"
            scenes[name if name not in scenes else vector.folder.name] = cleared(
                rows_of(vector.scene, [row])
            )
    return scenes


def drawn_scenes(stored: Scenes, rng: np.random.Generator) -> Scenes:
    """Scenes that no vector holds: targets, neighbours and lines of different ones, distorted."""
    known = [centred(scene) for scene in stored.values() if target_is_seen(scene)]
    return {f"drawn {index}": _draw(known, rng) for index in range(DRAWN if known else 0)}


def _draw(known: Sequence[Scene], rng: np.random.Generator) -> Scene:
    """Distorted smoothly: what noise does to a heading is the model's own affair."""
    target, others, lines = (known[i] for i in rng.integers(len(known), size=3))
    history, valid = others.history.copy(), others.history_valid.copy()
    history[:, 0], valid[:, 0] = target.history[:, 0], target.history_valid[:, 0]
    agents, steps = valid.shape[1:]
    time = np.arange(1 - steps, 1) / max(steps - 1, 1)  # (T,) -1 to 0
    bend = rng.normal(0.0, 1.0, (agents, 1, 2)) * np.square(time)[:, None]
    shift = rng.normal(0.0, 2.0, (agents, 1, 2)) * (np.arange(agents) > 0)[:, None, None]
    valid &= rng.random(valid.shape) > rng.choice([0.0, 0.1, 0.5])
    valid[:, 0, -1] = True
    lines_valid = lines.centerlines_valid & (
        rng.random((1, lines.centerlines_valid.shape[1], 1)) > rng.choice([0.0, 0.3])
    )
    moved = rng.uniform(0.4, 1.6, (agents, 1, 1)) * history[0] + bend + shift
    return cleared(
        Scene(
            history=moved[None].astype(np.float32),
            history_valid=valid,
            heading=target.heading,
            centerlines=lines.centerlines,
            centerlines_valid=lines_valid,
            origin=np.zeros(2),
        )
    )


def hostile_scenes(contract: ModelContract) -> Scenes:
    """What no road shows, and some sensor or map will: the output must stay finite."""
    plain = _plain(contract, 12.0)
    still = _plain(contract, 0.0)
    now = np.zeros_like(plain.history_valid)
    now[:, :, -1] = True
    target_now = now.copy()
    target_now[:, 1:] = False
    no_map = np.zeros_like(plain.centerlines_valid)
    first_points = no_map.copy()
    first_points[:, :, 0] = True
    teleport = plain.history.copy()
    teleport[:, 0, : contract.history_steps // 2] += 500.0
    every_other = plain.history_valid.copy()
    every_other[:, :, -2::-2] = False
    heading = np.array([[1.0, 0.0]], np.float32)
    scenes = {
        "plain": plain,
        "standing": replace(still, heading=heading),
        "standing, heading (0, 0)": still,
        "standing, heading (0, 0), no map": replace(still, centerlines_valid=no_map),
        "heading against the motion": replace(plain, heading=-heading),
        "all seen once": replace(plain, history_valid=now),
        "every other step seen": replace(plain, history_valid=every_other),
        "all agents at one place": replace(still, history=np.zeros_like(plain.history)),
        "all agents the same": replace(
            plain, history=np.broadcast_to(plain.history[:, :1], plain.history.shape).copy()
        ),
        "all lines the same": replace(
            plain,
            centerlines=np.broadcast_to(plain.centerlines[:, :1], plain.centerlines.shape).copy(),
        ),
        "lines of zero length": replace(
            plain,
            centerlines=np.broadcast_to(
                plain.centerlines[:, :, :1], plain.centerlines.shape
            ).copy(),
        ),
        "lines that are one point, the target": replace(
            still, centerlines=np.zeros_like(plain.centerlines)
        ),
        "lines of one valid point": replace(plain, centerlines_valid=first_points),
        "100 m/s": _plain(contract, 100.0),
        "500 m between two steps": replace(plain, history=teleport),
        "no map": replace(plain, centerlines_valid=no_map),
        "only the target, only now, no map": replace(
            plain, history_valid=target_now, centerlines_valid=no_map
        ),
        "only the target, only now, no map, standing": replace(
            still, history_valid=target_now, centerlines_valid=no_map
        ),
    }
    return {name: cleared(scene) for name, scene in scenes.items()}


def _plain(contract: ModelContract, speed_mps: float) -> Scene:
    """Cars in parallel lanes along +x, the target at 0."""
    agents, steps = contract.num_agents, contract.history_steps
    lines, points = contract.num_centerlines, contract.centerline_points
    along = speed_mps * contract.dt_s * np.arange(1 - steps, 1)
    lane = LANE_M * np.array([(0, 1, 0, -1)[agent % 4] for agent in range(agents)])
    history = np.zeros((1, agents, steps, 2), np.float32)
    history[0, :, :, 0] = along + 12.0 * np.arange(agents)[:, None]
    history[0, :, :, 1] = lane[:, None]
    centerlines = np.zeros((1, lines, points, 2), np.float32)
    centerlines[0, :, :, 0] = np.linspace(-10.0, 90.0, points)
    centerlines[0, :, :, 1] = LANE_M * (np.arange(lines) - lines // 2)[:, None]
    return Scene(
        history=history,
        history_valid=np.ones((1, agents, steps), np.bool_),
        heading=np.zeros((1, 2), np.float32),
        centerlines=centerlines,
        centerlines_valid=np.ones((1, lines, points), np.bool_),
        origin=np.zeros(2),
    )


def rows_of(scene: Scene, rows: Sequence[int] | NDArray[np.intp]) -> Scene:
    """Some targets of a scene, in this order."""
    return replace(
        scene,
        history=scene.history[rows],
        history_valid=scene.history_valid[rows],
        heading=scene.heading[rows],
        centerlines=scene.centerlines[rows],
        centerlines_valid=scene.centerlines_valid[rows],
    )


def cleared(scene: Scene) -> Scene:
    """0 wherever a mask is False."""
    return filled(scene, 0.0)


def filled(scene: Scene, value: float) -> Scene:
    """`value` wherever a mask is False."""
    what = np.float32(value)
    return replace(
        scene,
        history=np.where(scene.history_valid[..., None], scene.history, what),
        centerlines=np.where(scene.centerlines_valid[..., None], scene.centerlines, what),
    )


def target_is_seen(scene: Scene) -> bool:
    """Whether the target was seen now."""
    return bool(scene.history_valid[0, 0, -1])


def speed_mps(scene: Scene, dt_s: float) -> float:
    """How fast the target was over the last second."""
    history, valid = scene.history[:, 0].astype(np.float64), scene.history_valid[:, 0]
    velocity, _ = fit_motion(history, valid, dt_s)
    return float(np.hypot(*velocity[0]))


def place(scene: Scene) -> NDArray[np.float64]:
    """(2,) where the target is now."""
    return np.asarray(scene.history[0, 0, -1], np.float64)


def centred(scene: Scene) -> Scene:
    """The scene with its target at 0."""
    x, y = -place(scene)
    return moved(scene, Pose2(x, y, 0.0))


def random_pose(scene: Scene, rng: np.random.Generator) -> Pose2:
    """Turns the scene by any angle and puts its target anywhere within REACH_M of zero."""
    turn = Pose2(0.0, 0.0, rng.uniform(-np.pi, np.pi))
    angle, distance = rng.uniform(-np.pi, np.pi), REACH_M * np.sqrt(rng.random())
    goal = distance * np.array([np.cos(angle), np.sin(angle)])
    x, y = goal - turn.rotate(place(scene))
    return Pose2(float(x), float(y), turn.yaw_rad)


def moved(scene: Scene, pose: Pose2) -> Scene:
    """The scene turned and shifted, 0 where a mask is False."""

    def points(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return pose.apply(values.astype(np.float64)).astype(np.float32)

    return cleared(
        replace(
            scene,
            history=points(scene.history),
            heading=pose.rotate(scene.heading.astype(np.float64)).astype(np.float32),
            centerlines=points(scene.centerlines),
        )
    )


def stacked(scenes: Mapping[str, Scene]) -> Scene:
    """All of them as one batch."""
    return concatenate(list(scenes.values()))
