"""The program that a cold start measures: from nothing to the first prediction.

`python -m eqrt.runtime.bench.first_answer DIR THREADS` imports, loads the artifact, predicts its
first test vector, and prints one line of JSON: nanoseconds per stage, and memory in MiB.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path


def main() -> int:
    """Answer once."""
    started_ns = time.perf_counter_ns()
    importlib.import_module("numpy")
    importlib.import_module("onnxruntime")
    bare_mib = _resident_mib()
    from eqrt.runtime.prediction.predictor import Predictor  # noqa: PLC0415 (is timed)

    imported_ns = time.perf_counter_ns()
    folder = Path(sys.argv[1])
    predictor = Predictor.load(folder, threads=int(sys.argv[2]))
    loaded_ns = time.perf_counter_ns()
    from eqrt.runtime.prediction.stored_vectors import read_vector, vector_folders  # noqa: PLC0415

    scene = read_vector(vector_folders(folder)[0], predictor.contract).scene
    asked_ns = time.perf_counter_ns()
    predictor.predict(scene)
    said = {
        "import_ns": imported_ns - started_ns,
        "load_ns": loaded_ns - imported_ns,
        "first_ns": time.perf_counter_ns() - asked_ns,
        "bare_mib": bare_mib,
        "rss_mib": _resident_mib(),
    }
    print(json.dumps(said), flush=True)
    return 0


def _resident_mib() -> float:
    with open("/proc/self/status", encoding="utf-8") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmRSS:"))


if __name__ == "__main__":
    sys.exit(main())
