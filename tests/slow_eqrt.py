"""`eqrt` on a machine on which every third run of the model takes 0.3 s and, while it serves, every
seventh finds no memory: `python slow_eqrt.py ...`.

The model is the real one; that it takes its time is what happens to it on a starved processor.
"""

from __future__ import annotations

import itertools
import sys
import time

from eqrt.cli import main
from eqrt.core.scene import Scene
from eqrt.runtime.prediction.predictor import Prediction, Predictor

_RUNS = itertools.count()
_predict = Predictor.predict


def _predict_slowly(self: Predictor, scene: Scene) -> Prediction:
    run = next(_RUNS)
    if run % 7 == 6 and "serve" in sys.argv:
        raise MemoryError
    if run % 3 == 2:
        time.sleep(0.3)
    return _predict(self, scene)


if __name__ == "__main__":
    Predictor.predict = _predict_slowly  # type: ignore[method-assign]  # the fault
    sys.exit(main())
