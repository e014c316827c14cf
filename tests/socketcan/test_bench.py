"""`eqrt bench --service` on a real SocketCAN bus."""

from __future__ import annotations

import sys
from pathlib import Path

from eqrt.runtime.bench.json_form import read_json
from eqrt.runtime.bench.report import SCHEMA, Report
from socketcan.conftest import RunOnVcan


def test_the_service_is_measured_on_vcan(run_on_vcan: RunOnVcan, tmp_path: Path) -> None:
    """Every stage of every cycle takes some time, and none goes back in time."""
    command = [sys.executable, "-m", "eqrt", "bench", "--service", "--can", "vcan0"]
    options = ["--objects", "2", "--rate", "5", "--seconds", "4", "--json", "report.json"]
    done = run_on_vcan([*command, *options], 240.0)
    assert done.status == 0, done.stderr
    report = read_json(Report, tmp_path / "report.json", SCHEMA)
    assert str(report.settings.bus).startswith("vcan0 through socketcan")
    service = report.cases[0].judged
    assert 10 <= service.samples <= 21
    assert all(stage.min_ns >= 0 for stage in service.stages.values())
    assert service.stages["wake-up"].max_ns < 4e9
