"""Makes the scene that the examples for other stacks show: `python -m eqrt.export.example_scene`.

One moment of the recorded drive that comes with `eqrt demo`, as the service sees it, with what
happened next. It holds more agents, steps, lines and points than a model reads, so that an example
packs it for the sizes in a model's contract as an engineer packs tracks and lanes of their own.

`agents`: where every track that is seen now was at the last ticks of `dt_s` (null = not seen), the
last one being now. `targets`: whom to predict: `agent` is an index, `heading` a unit vector, [0, 0]
= not known; `centerlines` are the lanes that it may follow, the likeliest first, with points at
equal distances (null = beyond the map's end); `future` is where it was at the next ticks.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eqrt.core.scene import Scene, concatenate
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.demo.command import PARTS
from eqrt.runtime.demo.score import Scoreboard, Scored
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Prediction, Predictor
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay

AT_S = 58.3  # s after the drive's start: a junction, some cars turn
MOVING_M = 5.0  # a target drives at least so far in its future
DT_S = 0.1
HISTORY_STEPS, FUTURE_STEPS = 22, 30  # this part of the drive began 2.3 s before
AGENTS, LINES = 48, 8
POINTS = 41  # over 100 m of a line
ABOUT = "a junction of Lankershim Boulevard, Los Angeles (NGSIM), as eqrt's service sees it"
CREDITS = (
    "Scenario: Copyright 2021 Technical University of Munich (CommonRoad), BSD 3-Clause License",
    "Vehicle trajectories: U.S. Department of Transportation, Federal Highway Administration, "
    "Next Generation Simulation (NGSIM) program, Creative Commons Attribution-ShareAlike",
    "Lane map: (c) OpenStreetMap contributors, Open Data Commons Open Database License (ODbL)",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Write the scene."""
    parser = argparse.ArgumentParser(prog="python -m eqrt.export.example_scene")
    parser.add_argument("out", type=Path, help="a JSON file")
    parser.parse_args(argv).out.write_text(to_json(*moment()), encoding="utf-8")
    return 0


class Watcher(Predictor):
    """Keeps the scenes of a cycle; everybody stays where they are: no prediction is looked at."""

    scenes: list[Scene]

    def predict(self, scene: Scene) -> Prediction:
        """Keep it, one per batch."""
        self.scenes.append(scene)
        batch, steps = len(scene.history), self.contract.horizon_steps
        here = scene.history[:, :1, -1:] + scene.origin  # (B, 1, 1, 2)
        return Prediction(np.repeat(here, steps, axis=2), np.ones((batch, 1), np.float32))


def moment() -> tuple[Scene, dict[int, Scored]]:
    """The scene at AT_S, and what became of those of its targets (by row) that drove on."""
    watcher = Watcher.load(DEFAULT_ARTIFACT)
    watcher.scenes = []
    watcher.contract = replace(
        watcher.contract,
        num_agents=AGENTS,
        history_steps=HISTORY_STEPS,
        num_centerlines=LINES,
        centerline_points=POINTS,
        horizon_steps=FUTURE_STEPS,
        num_modes=1,
        dt_s=DT_S,
    )
    board = Scoreboard()
    then: tuple[ForecastSet, Scene] | None = None
    for at_s, forecast in drive(watcher):
        if then is None and at_s > AT_S - DT_S / 2:
            then = forecast, concatenate(watcher.scenes)
        watcher.scenes.clear()
        scored = [s for s in board.add(forecast) if then and s.anchor_s in then[0].anchor_s]
        if then and scored:
            return then[1], _movers(then[0], scored)
    raise RuntimeError(f"the drive ends before {AT_S} s and their future")


def drive(predictor: Predictor) -> Iterator[tuple[float, ForecastSet]]:
    """The recorded drive through the whole service: seconds since its start, predictions."""
    part = PARTS[0]
    assert part.tile is not None
    pipeline = Pipeline(load_profile("generic"), predictor, load_tile(part.tile))
    start_s = None
    for forecast in replay(pipeline, read_log(part.log)):
        start_s = forecast.timestamp_s if start_s is None else start_s
        yield forecast.timestamp_s - start_s, forecast


def to_json(scene: Scene, movers: dict[int, Scored]) -> str:
    """The file's text."""
    histories, seen = _agents(scene)
    targets = []
    for row, scored in movers.items():
        (agent,) = np.flatnonzero((histories == scene.history[row, 0]).all(axis=(1, 2)))
        lines = zip(scene.centerlines[row], scene.centerlines_valid[row], strict=True)
        targets.append(
            {
                "agent": int(agent),
                "heading": _rounded(scene.heading[row]),
                "centerlines": [_places(line, valid) for line, valid in lines if valid.any()],
                "future": _rounded(scored.truth - scene.origin),
            }
        )
    agents = [_places(places, valid) for places, valid in zip(histories, seen, strict=True)]
    content = {
        "about": ABOUT,
        "credits": CREDITS,
        "units": "m, s; x east, y north",
        "dt_s": DT_S,
        "agents": agents,
        "targets": targets,
    }
    return (
        "{\n" + ",\n".join(f'"{key}": {_text(value)}' for key, value in content.items()) + "\n}\n"
    )


def _movers(then: ForecastSet, scored: list[Scored]) -> dict[int, Scored]:
    rows = {track_id: row for row, track_id in enumerate(then.track_id.tolist())}
    return {
        rows[s.track_id]: s for s in scored if np.linalg.norm(s.truth[-1] - s.truth[0]) >= MOVING_M
    }


def _agents(scene: Scene) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(A, T, 2) and (A, T): everybody who is seen now, in the order of the first row."""
    now = scene.history_valid[0, :, -1]
    return scene.history[0, now], scene.history_valid[0, now]


def _places(points: NDArray[np.float32], valid: NDArray[np.bool_]) -> list[Any]:
    return [_rounded(point) if there else None for point, there in zip(points, valid, strict=True)]


def _text(value: Any) -> str:
    """JSON, an item of a list on each line."""
    if not isinstance(value, list | tuple):
        return json.dumps(value)
    return "[\n" + ",\n".join(json.dumps(item, separators=(",", ":")) for item in value) + "\n]"


def _rounded(values: NDArray[Any]) -> Any:
    """To the millimetre."""
    return np.round(values.astype(np.float64), 3).tolist()


if __name__ == "__main__":
    sys.exit(main())
