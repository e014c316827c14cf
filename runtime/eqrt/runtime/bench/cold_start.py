"""Cold start: how long a fresh process takes to its first prediction, and how big it is then.

Measured by starting some. Files are in the page cache after the first; what a disk adds is not in.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.schedule import CLOCK

STARTS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class ColdStart:
    """Medians over `starts` processes; seconds and MiB."""

    starts: int
    total_s: float
    """From creating the process to its answer having arrived."""
    slowest_s: float
    """The slowest of the totals."""
    import_s: float
    """Of numpy, onnxruntime and the predictor."""
    load_s: float
    """Checksum, session, and the predictor's own test vector."""
    first_s: float
    """The first prediction after that."""
    rss_bare_mib: float
    """With numpy and onnxruntime imported and nothing loaded."""
    rss_mib: float
    """After the first prediction."""


def measure_cold_start(artifact: Path, threads: int) -> ColdStart:
    """Start STARTS processes, one after the other. Raises EqrtError if one fails."""
    return medians([_start(artifact, threads) for _ in range(STARTS)])


def medians(answers: Sequence[Mapping[str, float]]) -> ColdStart:
    """Of what several starts said: total_ns, import_ns, load_ns, first_ns, bare_mib, rss_mib."""
    middle = {key: float(np.median([answer[key] for answer in answers])) for key in answers[0]}
    return ColdStart(
        starts=len(answers),
        total_s=round(middle["total_ns"] / 1e9, 4),
        slowest_s=round(max(answer["total_ns"] for answer in answers) / 1e9, 4),
        import_s=round(middle["import_ns"] / 1e9, 4),
        load_s=round(middle["load_ns"] / 1e9, 4),
        first_s=round(middle["first_ns"] / 1e9, 6),
        rss_bare_mib=round(middle["bare_mib"], 3),
        rss_mib=round(middle["rss_mib"], 3),
    )


def _start(artifact: Path, threads: int) -> dict[str, Any]:
    command = [sys.executable, "-m", "eqrt.runtime.bench.first_answer", str(artifact), str(threads)]
    quiet = os.environ | {"ORT_DISABLE_TELEMETRY": "1"}  # as the predictor sets it before importing
    started_ns = CLOCK()
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=quiet
    ) as process:
        assert process.stdout is not None
        answer = process.stdout.readline()
        total_ns = CLOCK() - started_ns  # how long it takes to end does not matter
        errors = process.communicate()[1]
    if not answer:
        said = errors.strip().splitlines()
        raise EqrtError(f"a fresh process gave no answer: {said[-1] if said else 'no word'}")
    return {"total_ns": total_ns, **json.loads(answer)}
