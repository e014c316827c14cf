"""What the contract promises of predictions, tried on the model: one function per promise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.runtime.prediction.predictor import MAX_BATCH, SELF_CHECK_M, Prediction, Predictor
from eqrt.runtime.prediction.stored_vectors import StoredVector
from eqrt.runtime.verify.check import Check, Result, check_of
from eqrt.runtime.verify.compare import Difference, differences
from eqrt.runtime.verify.predictions import bits, joined, predict, targets_of, turned
from eqrt.runtime.verify.scenes import (
    REACH_M,
    Scenes,
    centred,
    filled,
    hostile_scenes,
    moved,
    random_pose,
    rows_of,
    speed_mps,
    stacked,
    target_is_seen,
)

MIN_VECTORS = 20
"""Fewer test vectors do not show much."""
TURNS = 6
"""Every scene is turned and shifted so often."""
SUM = 1e-4
"""Probabilities add up to 1 within this."""
THREADS_M = 1e-4
"""Two threads may add in another order than one."""
MOVING_MPS = 2.0
"""Over the last second: from here on a target's motion is its heading (docs/frames.md)."""
HEADINGS = {"heading not known": (0.0, 0.0)} | {
    f"heading {degrees} degrees": (np.cos(np.radians(degrees)), np.sin(np.radians(degrees)))
    for degrees in (30, 120, 210, 300)
}
"""What is said of a target that moves; as unit vectors."""
FILLERS = (np.nan, np.inf, -np.inf, 1e30)
"""Put where a mask is False."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A model and what it is tried on."""

    predictor: Predictor
    twin: Predictor
    """The same file, loaded with two threads."""
    vectors: Sequence[StoredVector]
    """At least one: the Predictor has run it."""
    unreadable: tuple[str, ...]
    """What is wrong with the others."""
    scenes: Scenes
    """The stored targets, and new ones made from them."""
    rng: np.random.Generator

    @property
    def centred(self) -> Scenes:
        """The same with the target at 0, where float32 resolves a hundredth of a millimetre."""
        return {name: centred(scene) for name, scene in self.scenes.items()}


def check_vectors(trial: Trial) -> Check:
    """Every stored test vector comes out as stored."""
    found: list[Difference] = []
    for vector in trial.vectors:
        expected = Prediction(
            vector.outputs["trajectories"].astype(np.float64),
            vector.outputs["probabilities"],
            vector.outputs.get("covariances"),
        )
        names = [f"{vector.folder.name} ({vector.name})"] * len(vector.scene.history)
        after = predict(trial.predictor, vector.scene)
        found += differences(names, after, expected, covariance=SELF_CHECK_M)
    check = _judged("test vectors", found)
    few = len(trial.vectors) < MIN_VECTORS
    lack = [f"{len(trial.vectors)} test vectors, allowed at least {MIN_VECTORS}"] if few else []
    return check_of(
        check.name,
        (*lack, *trial.unreadable, *check.failures),
        f"{len(trial.vectors)}, {check.figure}",
        f">= {MIN_VECTORS}, {check.limit}",
    )


def check_equivariance(trial: Trial) -> Check:
    """Turning and shifting a scene turns and shifts its prediction, and nothing else.

    Far from zero float32 rounds a scene; the scene it is compared with is that rounded one, brought
    back, so that what the model makes of the rounding does not count here (`check_rounding`).
    """
    found: list[Difference] = []
    for poses in _poses(trial):
        there = {name: moved(scene, poses[name]) for name, scene in trial.centred.items()}
        back = {name: moved(scene, poses[name].inverse()) for name, scene in there.items()}
        before = predict(trial.predictor, stacked(back))
        expected = joined(
            [turned(targets_of(before, [row]), pose) for row, pose in enumerate(poses.values())]
        )
        after = predict(trial.predictor, stacked(there))
        found += differences([_placed(name, pose) for name, pose in poses.items()], after, expected)
    check = _judged("equivariance", found)
    figure = f"{'not equivariant: ' if check.failures else ''}{check.figure}"
    return replace(check, figure=figure)


def check_rounding(trial: Trial) -> Check:
    """What the rounding of a scene's coordinates far from zero does to the prediction: said only.

    Nothing can undo it. A target seen in two steps, 0.1 s apart, leads 30 times the rounding astray
    in 3 s. A service that keeps its zero near the car has less of it.
    """
    before = predict(trial.predictor, stacked(trial.centred))
    found: list[Difference] = []
    for poses in _poses(trial):
        rounded = {
            name: moved(moved(scene, poses[name]), poses[name].inverse())
            for name, scene in trial.centred.items()
        }
        after = predict(trial.predictor, stacked(rounded))
        found += differences(list(poses), after, before)
    figure = _length(max(d.trajectory_m for d in found))
    return Check("rounding", Result.NOTED, figure, f"any: float32 within {REACH_M / 1e3:g} km")


def check_batch(trial: Trial) -> Check:
    """A target's prediction does not depend on what else is in the batch, even nonsense.

    All targets in random order, in batches of every size; the last of each batch is not a number.
    """
    names, everyone = list(trial.scenes), stacked(trial.scenes)
    alone = joined([predict(trial.predictor, scene) for scene in trial.scenes.values()])
    found: list[Difference] = []
    rows = trial.rng.permutation(len(names))
    size = 1
    while len(rows):
        some, rows = rows[:size], rows[size:]
        batch = rows_of(everyone, some)
        poison = replace(rows_of(batch, [0]), history=np.full_like(batch.history[:1], np.nan))
        together = predict(trial.predictor, stacked({"": batch, "poison": poison}))
        where = [f"{names[row]}, in a batch of {len(some) + 1}" for row in some]
        found += differences(where, targets_of(together, range(len(some))), targets_of(alone, some))
        size = size % (MAX_BATCH - 1) + 1
    return _judged("batch", found)


def check_neighbours(trial: Trial) -> Check:
    """The order of the neighbours means nothing."""
    agents = trial.predictor.contract.num_agents

    def shuffled(scene: Scene) -> Scene:
        order = np.concatenate([[0], 1 + trial.rng.permutation(agents - 1)])
        return replace(
            scene, history=scene.history[:, order], history_valid=scene.history_valid[:, order]
        )

    return _judged("order of neighbours", _after(trial, shuffled))


def check_lines(trial: Trial) -> Check:
    """The order of the lines means nothing, unless the contract's lane choice sorts them."""
    contract = trial.predictor.contract

    def shuffled(scene: Scene) -> Scene:
        order = trial.rng.permutation(contract.num_centerlines)
        return replace(
            scene,
            centerlines=scene.centerlines[:, order],
            centerlines_valid=scene.centerlines_valid[:, order],
        )

    check = _judged("order of lines", _after(trial, shuffled))
    if contract.lane_choice != "nearest" or check.result is Result.OK:
        return check
    figure = f"depends on it: {check.figure}"
    return Check(check.name, Result.NOTED, figure, "any: lines are sorted, the nearest first")


def check_heading(trial: Trial) -> Check:
    """The measured heading is for targets that stand: of one that moves it changes nothing.

    Whatever heading is said of a moving target, or none, its prediction stays.
    """
    contract = trial.predictor.contract
    scenes = trial.scenes | {"plain": hostile_scenes(contract)["plain"]}
    moving = {
        name: scene
        for name, scene in scenes.items()
        if target_is_seen(scene) and speed_mps(scene, contract.dt_s) >= MOVING_MPS
    }
    before = predict(trial.predictor, stacked(moving))
    found: list[Difference] = []
    for said, heading in HEADINGS.items():
        measured = np.array([heading], np.float32)
        after = {name: replace(scene, heading=measured) for name, scene in moving.items()}
        names = [f"{name}, {said}" for name in moving]
        found += differences(names, predict(trial.predictor, stacked(after)), before)
    check = _judged("heading", found)
    figure = f"{len(moving)} targets at {MOVING_MPS:g} m/s or more, {check.figure}"
    return replace(check, figure=figure)


def check_padding(trial: Trial) -> Check:
    """Values under False masks change nothing, bit for bit."""
    names, scene = list(trial.scenes), stacked(trial.scenes)
    clean = predict(trial.predictor, scene)
    failures = []
    for filler in FILLERS:
        dirty = predict(trial.predictor, filled(scene, filler))
        failures += [
            f"{name}: {filler:g} under False masks changes the prediction, allowed is no bit"
            for row, name in enumerate(names)
            if bits(clean, row) != bits(dirty, row)
        ]
    hidden = sum(int((~valid).sum()) for valid in (scene.history_valid, scene.centerlines_valid))
    figure = f"{hidden} masked places, {len(failures)} predictions changed"
    return check_of("padding", failures, figure, "0, bit for bit")


def check_finite(trial: Trial) -> Check:
    """Finite, and probabilities in order, on anything that a sensor or map may give."""
    hostile = hostile_scenes(trial.predictor.contract)
    away = {
        f"{name}, turned and far": moved(scene, random_pose(scene, trial.rng))
        for name, scene in hostile.items()
    }
    scenes = trial.scenes | hostile | away
    prediction = predict(trial.predictor, stacked(scenes))
    failures = [
        f"{name}: {line}" for row, name in enumerate(scenes) for line in _improper(prediction, row)
    ]
    figure = f"{len(scenes)} scenes, {len(failures)} faults"
    return check_of("finite", failures, figure, "0; probabilities fall, sum 1")


def check_determinism(trial: Trial) -> Check:
    """The same input gives the same bytes."""
    names, scene = list(trial.scenes), stacked(trial.scenes)
    first, second = predict(trial.predictor, scene), predict(trial.predictor, scene)
    failures = [
        f"{name}: the second run differs from the first, allowed is no bit"
        for row, name in enumerate(names)
        if bits(first, row) != bits(second, row)
    ]
    return check_of(
        "determinism", failures, f"{len(names)} scenes, {len(failures)} differ", "0, bit for bit"
    )


def check_threads(trial: Trial) -> Check:
    """Two threads predict what one does."""
    scene = stacked(trial.scenes)
    one, two = predict(trial.predictor, scene), predict(trial.twin, scene)
    return _judged("2 threads", differences(list(trial.scenes), two, one, base_m=THREADS_M))


CHECKS: dict[str, Callable[[Trial], Check]] = {
    "test vectors": check_vectors,
    "equivariance": check_equivariance,
    "rounding": check_rounding,
    "batch": check_batch,
    "order of neighbours": check_neighbours,
    "order of lines": check_lines,
    "heading": check_heading,
    "padding": check_padding,
    "finite": check_finite,
    "determinism": check_determinism,
    "2 threads": check_threads,
}
"""In the order of the table."""


def _poses(trial: Trial) -> Iterator[dict[str, Pose2]]:
    """For every centred scene another place and direction, TURNS times."""
    for _ in range(TURNS):
        yield {name: random_pose(scene, trial.rng) for name, scene in trial.centred.items()}


def _after(trial: Trial, change: Callable[[Scene], Scene]) -> list[Difference]:
    """What a change of every scene does to its prediction."""
    changed = {name: change(scene) for name, scene in trial.scenes.items()}
    before = predict(trial.predictor, stacked(trial.scenes))
    return differences(list(changed), predict(trial.predictor, stacked(changed)), before)


def _judged(name: str, found: Sequence[Difference]) -> Check:
    """The worst difference is the figure; failures come the worst first."""
    ordered = sorted(found, key=lambda difference: difference.excess, reverse=True)
    failures = [line for difference in ordered for line in difference.failures]
    figure = _length(max(d.trajectory_m for d in found))
    probability = max(d.probability for d in found)
    if probability > 0.0:
        figure += f", probabilities {probability:.1g}"
    covariance = max(d.covariance for d in found)
    if covariance > 0.0:
        figure += f", covariances {covariance:.1g}"
    near, far = (_length(bound(d.allowed_m for d in found)) for bound in (min, max))
    return check_of(name, failures, figure, near if near == far else f"{near}, far {far}")


def _length(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if metres < 1.0 else f"{metres:.3g} m"


def _placed(name: str, pose: Pose2) -> str:
    turn, away = np.degrees(pose.yaw_rad), np.hypot(pose.x_m, pose.y_m)
    return f"{name}, turned by {turn:.0f} degrees and shifted by {away:.0f} m"


def _improper(prediction: Prediction, row: int) -> list[str]:
    """What no prediction may be, of one target."""
    trajectories, shares = prediction.trajectories[row], prediction.probabilities[row]
    failures = []
    if not np.isfinite(trajectories).all():
        failures.append("trajectories are not finite")
    if not (np.isfinite(shares).all() and abs(float(shares.sum()) - 1.0) <= SUM):
        failures.append(f"probabilities add up to {shares.sum():.6g}, allowed 1 +- {SUM:g}")
    elif (shares < 0.0).any() or (np.diff(shares) > 0.0).any():
        failures.append(f"probabilities are {shares.tolist()}, allowed: none below 0, falling")
    if prediction.covariances is not None and not _positive(prediction.covariances[row]):
        failures.append("a covariance is not finite, symmetric and positive")
    return failures


def _positive(covariances: np.ndarray) -> bool:
    """Whether all of (..., 2, 2) are covariances."""
    x, y = covariances[..., 0, 0], covariances[..., 1, 1]
    xy, yx = covariances[..., 0, 1], covariances[..., 1, 0]
    symmetric = np.abs(xy - yx) <= 1e-5 * (x + y)
    return bool(
        np.isfinite(covariances).all() and (symmetric & (x > 0.0) & (x * y > xy * yx)).all()
    )
