"""The program that is measured: `python -m eqrt.runtime.bench.service.serving ORDER`.

It imports what the service needs, one after the other, and notes how long that took.
"""

from __future__ import annotations

import importlib
import sys
import time


def main() -> int:
    """Import, then serve until measured or told to stop."""
    started_ns = time.perf_counter_ns()
    importlib.import_module("numpy")
    importlib.import_module("onnxruntime")
    bare_mib = _resident_mib()
    from eqrt.runtime.bench.service.measured import serve  # noqa: PLC0415 (is timed)

    serve(import_ns=time.perf_counter_ns() - started_ns, bare_mib=bare_mib)
    return 0


def _resident_mib() -> float:
    with open("/proc/self/status", encoding="utf-8") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmRSS:"))


if __name__ == "__main__":
    sys.exit(main())
