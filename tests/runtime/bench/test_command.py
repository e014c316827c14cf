"""`eqrt bench` for real, for a moment: nothing here depends on how fast anything is."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from bench_reports import bench, bench_for_real, case, report
from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bench import options
from eqrt.runtime.bench.environment import (
    allow_cores,
    allowed_cores,
    parse_cores,
    parse_cpuinfo,
)
from eqrt.runtime.bench.json_form import to_json
from eqrt.runtime.bench.predictors import ModelWorkload, load_timed
from eqrt.runtime.bench.scenes import shuffled
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from processes import files_of_at_most

ARM = "processor : 0\nModel : Board 5\nFeatures : fp asimd asimddp crc32\n"
INTEL = "model name : Xeon\nflags : fpu sse2 avx2 fma avx512f avx512_vnni amx_int8 hypervisor\n"


def test_back_to_back_with_a_budget_and_a_baseline_that_nothing_can_keep(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    baseline, budget = tmp_path / "old.json", tmp_path / "budget.toml"
    baseline.write_text(to_json(report(case(1, [1] * 700))))
    budget.write_text('schedule = "back-to-back"\n[targets.1]\np50_ms = 0\n')
    options = ["--baseline", str(baseline), "--budget", str(budget)]
    run = bench_for_real(tmp_path, capsys, "--targets", "1", "--seconds", "3", *options)
    assert run.status == 3
    assert "OVER BUDGET 1 target: p50 is " in run.said
    assert "REGRESSION 1 target: p50 is " in run.said
    assert "ANOTHER MODEL: handmade" in run.said
    assert "REGRESSION" in run.page
    measured = run.report.cases[0]
    model, velocity, turn, filtered = measured.workloads
    assert [load.name for load in measured.workloads] == [
        "model",
        "constant velocity",
        "constant turn rate",
        "Kalman filter",
    ]
    assert list(model.stages) == ["gather", "infer", "map frame"]
    assert model.samples == velocity.samples == turn.samples == filtered.samples
    assert sum(model.histogram.counts) == model.samples
    means = [stage.mean_ns for stage in model.stages.values()]
    assert model.total.mean_ns == pytest.approx(sum(means), abs=2)
    assert all(stage.min_ns > 0 for stage in model.stages.values())
    assert model.cpu_mean_ns > 0
    assert measured.punctuality is None
    assert measured.resources.rss_peak_mib >= measured.resources.rss_end_mib - 1.0
    start = run.report.cold_start
    assert start.import_s + start.load_s + start.first_s < start.total_s <= start.slowest_s
    assert 0.0 < start.rss_bare_mib < start.rss_mib


def test_periodic_within_a_wide_budget(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    budget = tmp_path / "budget.toml"
    wide = "[start]\ncold_start_s = 1e9\n[targets.2]\np50_ms = 1e9\ndeadline_misses = 100\n"
    budget.write_text(f'schedule = "periodic"\nrate_hz = 20\n{wide}')
    duty = ["--schedule", "periodic", "--rate", "20", "--seconds", "3"]
    run = bench_for_real(tmp_path, capsys, *duty, "--targets", "2", "--budget", str(budget))
    assert run.status == 0
    assert "within the budget" in run.said
    assert "INVALID" in run.said  # 60 samples are too few for a p99
    assert not run.report.valid
    measured = run.report.cases[0]
    kept = measured.punctuality
    assert kept is not None
    assert kept.ticks <= 60
    assert kept.ticks == measured.judged.samples + kept.skipped
    assert kept.skipped <= kept.misses <= kept.ticks


# --- its parts


def test_every_run_sees_other_targets_and_the_same_number_the_same() -> None:
    pool = shuffled(arrays_of(101))
    first, again, second = pool.draw(0, 8), pool.draw(0, 8), pool.draw(1, 8)
    np.testing.assert_array_equal(first.history, again.history)
    seen = [set(scene.heading[:, 0].tolist()) for scene in (first, second)]
    assert len(seen[0]) == 8
    assert not seen[0] & seen[1]
    assert len(pool.draw(3, 150).history) == 150
    everything = pool.draw(7, 101)
    assert sorted(everything.heading[:, 0]) == list(range(101))


def arrays_of(count: int) -> dict[str, np.typing.NDArray[np.generic]]:
    """Inputs of the shipped model; the heading tells the targets apart."""
    contract = load_timed(DEFAULT_ARTIFACT, 1).contract
    arrays: dict[str, np.typing.NDArray[np.generic]] = {
        name: np.zeros((count, *(int(size) for size in shape[1:])), kind)
        for name, (kind, shape) in contract.inputs.items()
    }
    arrays["heading"][:, 0] = np.arange(count)
    return arrays | {"origin": np.zeros(2)}


def test_stages_add_up_also_when_a_prediction_needs_several_runs_of_the_graph() -> None:
    predictor = load_timed(DEFAULT_ARTIFACT, 1)
    model = ModelWorkload(predictor, shuffled(arrays_of(40)), 40)
    durations: Sequence[int] = model.run(0)
    assert len(durations) == len(model.stages)
    assert all(duration > 0 for duration in durations)
    assert durations[1] == predictor.session.spent_ns


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--targets", "0"], "--targets '0': give different numbers from 1 to 1024"),
        (["--targets", "1,1"], "--targets '1,1': give different numbers"),
        (["--targets", "one"], "--targets 'one': give different numbers"),
        (["--threads", "0"], "--threads is 0; give 1 to 256"),
        (["--seconds", "nan"], "--seconds is nan; give 0.1 to 86400"),
        (["--rate", "10"], "--rate 10 needs --schedule periodic"),
        (["--schedule", "periodic", "--rate", "0"], "--rate is 0; give 0.1 to 10000"),
        (["--schedule", "hourly"], "invalid choice: 'hourly'"),
        (["--cpus", "x"], "--cpus 'x': give cores as in 0 or 0,2-3"),
        (["--cpus", "3-1"], "--cpus '3-1': give cores as in 0 or 0,2-3"),
        (["--cpus", "4000"], "--cpus 4000: not cores of this machine"),
    ],
)
def test_wrong_usage_is_refused_in_one_line_before_anything_is_measured(
    arguments: list[str], said: str
) -> None:
    with pytest.raises(UsageError, match=said) as error:
        bench(*arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--json", "nowhere/report.json"], "nowhere/report.json: cannot be written"),
        (["--html", "."], r"\.: cannot be written"),
        (["--html", "/proc/report.html"], r"/proc/report.html: cannot be written \(No such file"),
    ],
)
def test_a_report_that_cannot_be_written_is_known_before_anything_is_measured(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command line is right; the folder is not, and that can be mended: status 1."""
    with pytest.raises(EqrtError, match=said) as error:
        bench(*arguments)
    assert error.value.exit_code == 1
    assert capsys.readouterr().out == ""


def test_two_reports_do_not_go_into_one_file(tmp_path: Path) -> None:
    """Except into none at all."""
    (tmp_path / "b").mkdir()
    with pytest.raises(UsageError, match="is to be two reports at once"):
        bench("--json", str(tmp_path / "a"), "--html", str(tmp_path / "b/../a"))
    options.check_writable(Path("/dev/null"), Path("/dev/null"))


def test_a_report_that_does_not_fit_on_the_disk_leaves_the_old_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written = tmp_path / "report.json"
    written.write_text("yesterday's")
    with files_of_at_most(1 << 10), pytest.raises(EqrtError, match="File too large"):
        bench("--targets", "1", "--seconds", "0.1", "--json", str(written))
    assert "1 target, ms" in capsys.readouterr().out
    assert written.read_text() == "yesterday's"


def test_a_folder_that_is_no_artifact_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EqrtError, match=r"model.onnx: No such file"):
        bench("--model", str(tmp_path))


def test_cores_are_read_as_they_are_written() -> None:
    assert parse_cores("0,2-4, 3") == (0, 2, 3, 4)
    before = allowed_cores()
    allow_cores(before)
    assert allowed_cores() == before == tuple(sorted(os.sched_getaffinity(0)))


def test_the_processor_is_told_on_intel_and_on_arm() -> None:
    assert parse_cpuinfo(ARM) == ("Board 5", ("asimd", "asimddp"), False)
    flags = ("avx2", "fma", "avx512f", "avx512_vnni", "amx_int8")
    assert parse_cpuinfo(INTEL) == ("Xeon", flags, True)
    assert parse_cpuinfo("") == ("", (), False)


def test_the_report_of_a_run_is_plain_json(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text(to_json(report(case())))
    assert json.loads(path.read_text())["settings"]["benchmark"] == "model"
