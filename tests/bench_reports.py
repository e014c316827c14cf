"""Reports of benchmarks that were never run, every sample the same unless said otherwise; and of
benchmarks run as a user runs them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eqrt import cli
from eqrt.runtime.bench import command
from eqrt.runtime.bench.cold_start import ColdStart
from eqrt.runtime.bench.environment import Environment, ModelIdentity
from eqrt.runtime.bench.json_form import read_json
from eqrt.runtime.bench.measure import Measurement, results
from eqrt.runtime.bench.report import SCHEMA, Case, Punctuality, Report, Settings, WorkloadResult
from eqrt.runtime.bench.resources import Resources

MS = 1_000_000

QUIET = Resources(
    rss_start_mib=60.0,
    rss_end_mib=60.0,
    rss_peak_mib=61.0,
    rss_slope_kib_per_s=0.0,
    voluntary_switches=0,
    involuntary_switches=3,
    minor_faults=0,
    major_faults=0,
    cpu_s=19.0,
    others_share=0.01,
    steal_share=0.0,
    frequency_low_mhz=None,
    frequency_high_mhz=None,
)
SETTINGS = Settings(
    benchmark="model",
    targets=(1,),
    seconds=20.0,
    schedule="back-to-back",
    rate_hz=None,
    threads=1,
)
ENVIRONMENT = Environment(
    cpu="A <fast> processor",
    flags=("avx2",),
    cores_present=2,
    cores_allowed=(0, 1),
    governor=None,
    hypervisor=False,
    kernel="6.1",
    python="3.11.7",
    numpy="2.0.0",
    onnxruntime="1.20.0",
    eqrt="0.1.0",
    cooling=1.5,
)


class Constant:
    """A workload of two stages that always says the same."""

    stages = ("first", "second")

    def __init__(self, name: str = "model", total_ns: int = 4 * MS) -> None:
        self.name = name
        self.asked: list[int] = []
        self._durations = (total_ns // 4, total_ns - total_ns // 4)

    def run(self, number: int) -> Sequence[int]:
        self.asked.append(number)
        return self._durations


def result(totals_ns: Sequence[int], name: str = "model") -> WorkloadResult:
    """A workload that took these times, a quarter of each in its first stage."""
    totals = np.array(totals_ns)
    turns = np.zeros((len(totals), 4), np.int64)
    turns[:, 2] = np.arange(len(totals)) * 10 * MS
    stages = np.stack([totals // 4, totals - totals // 4], axis=-1)
    return results([Constant(name)], Measurement(turns, (stages,), (totals,)))[0]


def case(
    targets: int = 1,
    totals_ns: Sequence[int] = (4 * MS,) * 700,
    physics_ns: Sequence[int] = (MS // 10,) * 700,
    punctuality: Punctuality | None = None,
) -> Case:
    """A case that nothing speaks against."""
    return Case(
        targets=targets,
        seconds=20.0,
        workloads=(result(totals_ns), result(physics_ns, "constant velocity")),
        punctuality=punctuality,
        resources=QUIET,
        reasons=(),
        advice=("p99.9 needs 6,636 samples, there are 700: --seconds 190",),
    )


def report(*cases: Case, **settings: object) -> Report:
    """A report of these cases."""
    return Report(
        schema=SCHEMA,
        measured_at="2026-01-02T03:04:05+00:00",
        settings=replace(
            SETTINGS,
            targets=tuple(one.targets for one in cases),
            **settings,  # type: ignore[arg-type] # any field
        ),
        environment=ENVIRONMENT,
        model=ModelIdentity(name="handmade", version="1.0.0", sha256="0123456789abcdef" * 4),
        cold_start=ColdStart(
            starts=5,
            total_s=0.5,
            slowest_s=0.6,
            import_s=0.3,
            load_s=0.1,
            first_s=0.001,
            rss_bare_mib=45.0,
            rss_mib=60.0,
        ),
        cases=cases,
    )


SERVICE_REPORT = report(
    replace(case(32), workloads=(result((4 * MS,) * 700, "service"),)),
    benchmark="service",
    schedule="periodic",
    rate_hz=10.0,
    bus="eqrt_local",
)


def bench(*arguments: str) -> int:
    parser = cli.Parser(prog="eqrt bench", allow_abbrev=False)
    command.add_arguments(parser)
    return command.run(parser.parse_args(arguments))


@dataclass(frozen=True)
class Run:
    """What one run left."""

    status: int
    said: str
    report: Report
    page: str


def bench_for_real(folder: Path, said: pytest.CaptureFixture[str], *options: str) -> Run:
    written = folder / "report.json", folder / "report.html"
    status = bench("--json", str(written[0]), "--html", str(written[1]), *options)
    return Run(
        status, said.readouterr().out, read_json(Report, written[0], SCHEMA), written[1].read_text()
    )


def documented_keys(values: Any) -> set[str]:
    """All keys in it, at any depth."""
    if isinstance(values, list):
        return set().union(*map(documented_keys, values))
    if isinstance(values, dict):
        return set(values).union(*map(documented_keys, values.values()))
    return set()
