"""How far off an object is predicted that was just found: `python tests/bench/just_found.py`.

For the recordings in tests/data, by the number of steps seen in the last second: where the model,
the velocity that the sensor measured and the velocity fitted to the history end after 3 s, against
where the same track is measured then. From this comes `guard.MIN_STEPS`.
"""

from __future__ import annotations

from collections import defaultdict
from unittest.mock import patch

import can
import numpy as np
from numpy.typing import NDArray

from drives import DRIVES, Drive, shipped_predictor
from eqrt.core.kinematics import FIT_STEPS, fit_motion
from eqrt.runtime import pipeline as pipelines
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.guard import Guarded, guard
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay

Float64 = NDArray[np.float64]

AHEAD_S = 3.0
STEPS = (1, 2, 3, 4, 5, 6, 8, 10)


def main() -> None:
    """Print a table per recording."""
    for name, drive in DRIVES.items():
        print(f"{name}: mean distance after {AHEAD_S:g} s, m")
        print("steps  objects   model  sensor's velocity  fitted velocity")
        errors = _errors(drive)
        for steps in STEPS:
            rows = np.array(errors[steps])
            model, measured, fitted = rows.mean(axis=0)
            print(f"{steps:5}  {len(rows):7}  {model:6.2f}  {measured:17.2f}  {fitted:15.2f}")


def _errors(drive: Drive) -> dict[int, list[Float64]]:
    """Steps seen -> (3,) metres for each prediction: model, measured and fitted velocity."""
    asked: list[tuple[Float64, ...]] = []

    def spy(
        trajectories: Float64,
        probabilities: Float64,
        history: Float64,
        valid: NDArray[np.bool_],
        dt_s: float,
        *,
        object_class: NDArray[np.uint8],
        measured: Float64,
        covariances: Float64 | None,
    ) -> Guarded:
        steps = round(AHEAD_S / dt_s)
        fitted = np.nan_to_num(fit_motion(history, valid, dt_s)[0])
        place = history[:, -1]
        ends = [trajectories[:, 0, steps - 1], *(place + AHEAD_S * v for v in (measured, fitted))]
        asked.append((np.stack(ends, 1), valid[:, -FIT_STEPS:].sum(1)))
        return guard(
            trajectories,
            probabilities,
            history,
            valid,
            dt_s,
            object_class=object_class,
            measured=measured,
            covariances=covariances,
        )

    tile = load_tile(drive.tile) if drive.tile else None
    pipeline = Pipeline(load_profile(drive.profile), shipped_predictor(), tile)
    places: dict[int, list[tuple[float, float, float]]] = defaultdict(list)
    made: list[tuple[int, float, Float64, int]] = []
    with patch.object(pipelines, "guard", spy):
        for forecast in replay(pipeline, _messages(drive)):
            ends, steps = asked.pop()
            for i, (track, time_s) in enumerate(
                zip(forecast.track_id.tolist(), forecast.anchor_s.tolist(), strict=True)
            ):
                places[track].append((time_s, *forecast.position[i]))
                made.append((track, time_s + AHEAD_S, ends[i], int(steps[i])))
    return _scored(made, {track: np.array(way) for track, way in places.items()})


def _messages(drive: Drive) -> list[can.Message]:
    """With the buses of the profile for the channels of the log."""
    roles = {channel: role for role, channel in drive.roles.items()}
    messages = [message for message in read_log(drive.log) if message.channel in roles]
    for message in messages:
        message.channel = roles[str(message.channel)]
    return messages


def _scored(
    made: list[tuple[int, float, Float64, int]], places: dict[int, Float64]
) -> dict[int, list[Float64]]:
    errors: dict[int, list[Float64]] = defaultdict(list)
    for track, time_s, ends, steps in made:
        way = places[track]
        if time_s <= way[-1, 0]:
            truth = [np.interp(time_s, way[:, 0], way[:, axis]) for axis in (1, 2)]
            errors[steps].append(np.linalg.norm(ends - truth, axis=1))
    return errors


if __name__ == "__main__":
    main()
