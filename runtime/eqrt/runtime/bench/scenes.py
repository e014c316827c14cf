"""What the model is asked in a benchmark: recorded scenes, drawn differently for every run.

The targets are those of the recorded drive that comes with `eqrt demo`. In a batch every target is
a scene of its own, so targets of different moments can share a run. The order is shuffled once,
always the same way; run after run takes the next targets, and no two runs in sequence see the same.
"""

from __future__ import annotations

import io
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eqrt.core.errors import EqrtError
from eqrt.core.scene import Scene


@dataclass(frozen=True, slots=True)
class ScenePool:
    """P targets to draw batches from."""

    all: Scene
    """B = P; its origin stands for those of all targets."""

    def __len__(self) -> int:
        return len(self.all.history)

    def draw(self, number: int, targets: int) -> Scene:
        """The scene of run `number`: copies, (targets, ...)."""
        rows = np.arange(number * targets, (number + 1) * targets) % len(self)
        return Scene(
            history=self.all.history[rows],
            history_valid=self.all.history_valid[rows],
            heading=self.all.heading[rows],
            centerlines=self.all.centerlines[rows],
            centerlines_valid=self.all.centerlines_valid[rows],
            origin=self.all.origin,
        )


def record_scenes(artifact: Path) -> ScenePool:
    """Replay the recorded drive in another process, for an artifact that has been checked.

    Raises EqrtError if that fails, with what it said last.
    """
    done = subprocess.run(
        [sys.executable, "-m", "eqrt.runtime.bench.recorded_scenes", str(artifact)],
        capture_output=True,
        check=False,
    )
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise EqrtError(f"the recorded scenes could not be made: {said[-1] if said else 'no word'}")
    return shuffled(dict(np.load(io.BytesIO(done.stdout))))


def shuffled(arrays: dict[str, np.typing.NDArray[np.generic]]) -> ScenePool:
    """A pool of the model's inputs for P targets, by the contract's names, and `origin`."""
    order = np.random.default_rng(1).permutation(len(arrays["history"]))
    fields = {name: rows if name == "origin" else rows[order] for name, rows in arrays.items()}
    return ScenePool(Scene(**fields))  # type: ignore[arg-type] # types are the recorder's
