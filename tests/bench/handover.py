"""What it costs that the model runs in a thread: `python tests/bench/handover.py`.

The shipped model on one of its stored scenes, in turns as the service runs it and in the same
thread; medians, and the median of the differences of pairs.
"""

from __future__ import annotations

import time

import numpy as np

from eqrt.core.scene import Scene
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, MAX_BATCH, Predictor
from eqrt.runtime.prediction.stored_vectors import read_vector, vector_folders
from eqrt.runtime.prediction.watched import Direct, Watched

PAIRS = 3000


def main() -> None:
    """Print a line per batch size."""
    predictor = Predictor.load(DEFAULT_ARTIFACT)
    stored = read_vector(vector_folders(DEFAULT_ARTIFACT)[0], predictor.contract).scene
    for targets in (1, MAX_BATCH):
        rows = np.zeros(targets, np.intp)
        scene = Scene(
            **{n: values[rows] for n, values in stored.inputs().items()},  # type: ignore[arg-type]
            origin=stored.origin,
        )
        runners: list[Direct | Watched] = [Direct(predictor), Watched(predictor)]
        spent_us = np.array([[_spent_us(one, scene) for one in runners] for _ in range(PAIRS)])
        same, other = np.median(spent_us[PAIRS // 10 :], axis=0)
        cost = np.median(spent_us[PAIRS // 10 :, 1] - spent_us[PAIRS // 10 :, 0])
        print(f"{targets:2d} targets: {same:.0f} us in the same thread, {other:.0f} us in its own,")
        print(f"            {cost:.0f} us more")


def _spent_us(runner: Direct | Watched, scene: Scene) -> float:
    begun_s = time.perf_counter()
    runner.run(scene, 60.0)
    return 1e6 * (time.perf_counter() - begun_s)


if __name__ == "__main__":
    main()
