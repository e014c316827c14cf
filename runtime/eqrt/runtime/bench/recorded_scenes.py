"""The scenes of the demo's recorded drive, as the model of an artifact wants them.

A program of its own, so that the process that is measured never loads what makes scenes (CAN,
tracking, maps), and its memory is the model's: `python -m eqrt.runtime.bench.recorded_scenes DIR`
writes the scenes to standard output as numpy's npz.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import numpy as np

from eqrt.core.scene import Scene
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.demo.command import PARTS
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import Prediction, Predictor
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay

EVERY = 13
"""One target in so many is kept: about a thousand, spread over the whole drive."""


def main() -> int:
    """Write the targets of the drive, all as one scene."""
    drive = PARTS[0]
    assert drive.tile is not None
    collector = SceneCollector.load(Path(sys.argv[1]))
    pipeline = Pipeline(load_profile("generic"), collector, load_tile(drive.tile))
    for _ in replay(pipeline, read_log(drive.log)):
        pass
    content = io.BytesIO()
    np.savez(content, **collector.arrays())
    sys.stdout.buffer.write(content.getvalue())
    return 0


class SceneCollector(Predictor):
    """Keeps the scenes it is asked about; answers without running the model, as nobody listens."""

    def __init__(self, *loaded: Any) -> None:
        super().__init__(*loaded)
        self._scenes: list[dict[str, Any]] = []
        self._asked = 0

    def predict(self, scene: Scene) -> Prediction:
        """Everybody stays where they are."""
        batch = len(scene.history)
        rows = np.flatnonzero((self._asked + np.arange(batch)) % EVERY == 0)
        self._asked += batch
        if len(rows):
            self._scenes.append({name: rows_of[rows] for name, rows_of in scene.inputs().items()})
        modes, steps = self.contract.num_modes, self.contract.horizon_steps
        now = scene.history[:, :1, -1:] + scene.origin  # (B, 1, 1, 2) map frame
        return Prediction(
            np.tile(now, (1, modes, steps, 1)), np.full((batch, modes), 1 / modes, np.float32)
        )

    def arrays(self) -> dict[str, Any]:
        """The model's inputs for all targets kept, by the contract's names, and an origin."""
        names = list(self.contract.inputs)
        inputs = {name: np.concatenate([kept[name] for kept in self._scenes]) for name in names}
        return inputs | {"origin": np.zeros(2)}


if __name__ == "__main__":
    sys.exit(main())
