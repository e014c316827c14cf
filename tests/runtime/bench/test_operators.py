"""Where the time goes: the profiler's events, the work in them, and the machine's limits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench_reports import bench, documented_keys
from eqrt.core.errors import UsageError
from eqrt.runtime.bench.json_form import read_json
from eqrt.runtime.bench.operators.bench import SCHEMA, OperatorReport
from eqrt.runtime.bench.operators.limits import measure_limits
from eqrt.runtime.bench.operators.profile import profiled, times_by_operator, work_of
from eqrt.runtime.bench.table import WIDTH
from eqrt.runtime.prediction.graph_writer import Node, write_model
from eqrt.runtime.prediction.predictor import open_session
from source_tree import ROOT


def test_the_shipped_model_for_real(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr("tempfile.tempdir", None)  # read the variable again
    written = tmp_path / "operators.json"
    assert (
        bench("--operators", "--targets", "1,20", "--seconds", "0.2", "--json", str(written)) == 0
    )
    assert list(temporary.iterdir()) == []
    said = capsys.readouterr().out.splitlines()
    assert max(map(len, said)) <= WIDTH
    assert "measured / (arithmetic + overhead)" in "\n".join(said)
    report = read_json(OperatorReport, written, SCHEMA)
    text = (ROOT / "docs/benchmarks.md").read_text(encoding="utf-8")
    keys = documented_keys(json.loads(written.read_text()))
    assert [key for key in keys if key not in text] == []
    one, twenty = report.cases
    assert 19.0 < twenty.flops / one.flops < 21.0
    assert twenty.nodes == 2 * one.nodes  # 16 targets at most in each run of the graph
    for case in report.cases:
        assert sum(operator.share for operator in case.operators) == pytest.approx(1.0, abs=1e-3)
        assert sum(operator.nodes for operator in case.operators) == pytest.approx(case.nodes)
        assert case.uncounted == ()
        assert case.runs >= 11
        limit_ns = case.arithmetic_ns + case.overhead_ns
        assert case.ratio == pytest.approx(case.measured_ns / limit_ns, abs=1e-2)


def test_limits_are_those_of_a_machine() -> None:
    limits = measure_limits(1)
    assert 1e8 < limits.flops_per_s < 1e14
    assert 0.0 < limits.node_ns < 1e6


def test_every_node_of_a_graph_is_told_by_its_kind() -> None:
    nodes: list[Node] = [
        ("MatMul", ["in", "w"], "product", {}),
        ("Relu", ["product"], "positive", {}),
        ("MatMul", ["positive", "w"], "out", {}),
    ]
    spec = ("float32", (7, 3, 3))
    content = write_model(nodes, {"w": np.ones((3, 3), np.float32)}, {"in": spec}, {"out": spec})
    fed = {"in": np.ones((7, 3, 3), np.float32)}

    def ask(session: Any) -> None:
        for _ in range(5):
            session.run(["out"], fed)

    events = profiled(content, 1, ask, prepack=False)
    calls = {one.operator: one.calls for one in times_by_operator(events)}
    assert calls == {"MatMul": 10, "Relu": 5}
    assert work_of(events).flops == 5 * 2 * 2 * 7 * 3 * 3 * 3
    plain = open_session(content, 1).run(["out"], fed)[0]
    np.testing.assert_array_equal(plain, np.full((7, 3, 3), 9.0))


def event(operator: str, inputs: list[list[int]], outputs: list[list[int]]) -> dict[str, Any]:
    return {
        "dur": 2,
        "args": {
            "op_name": operator,
            "input_type_shape": [{"float": shape} for shape in inputs],
            "output_type_shape": [{"float": shape} for shape in outputs],
        },
    }


@pytest.mark.parametrize(
    ("operator", "inputs", "outputs", "flops"),
    [
        ("MatMul", [[4, 5, 6], [6, 7]], [[4, 5, 7]], 2 * 4 * 5 * 6 * 7),
        ("MatMul", [[6], [6, 7]], [[7]], 2 * 6 * 7),
        ("Gemm", [[5, 6], [6, 7], [7]], [[5, 7]], 2 * 5 * 6 * 7),
        ("FusedGemm", [[6, 5], [6, 7]], [[5, 7]], 2 * 5 * 6 * 7),  # the first one transposed
        ("FusedMatMul", [[2, 5, 6], [2, 7, 6]], [[2, 5, 7]], 2 * 2 * 5 * 6 * 7),
        ("Conv", [[1, 8, 10, 10], [16, 8, 3, 3]], [[1, 16, 8, 8]], 2 * 16 * 8 * 8 * 8 * 9),
        ("LSTM", [[20, 4, 2], [1, 32, 2], [1, 32, 8]], [[20, 1, 4, 8]], 2 * 20 * 4 * 32 * 10),
        ("Add", [[5], [5]], [[5]], 0),
    ],
)
def test_work_is_counted_from_shapes(
    operator: str, inputs: list[list[int]], outputs: list[list[int]], flops: int
) -> None:
    work = work_of([event(operator, inputs, outputs)])
    assert (work.flops, work.uncounted) == (flops, ())


def test_what_cannot_be_counted_is_named() -> None:
    events = [
        event("MultiHeadAttention", [[1, 2, 3]], [[1, 2, 3]]),
        event("Conv", [[1, 8, 10, 10]], [[1, 16, 8, 8]]),
    ]
    assert work_of(events).uncounted == ("Conv", "MultiHeadAttention")


def test_times_that_are_cut_off_to_microseconds_get_half_of_one_back() -> None:
    found = times_by_operator([event("Add", [[1]], [[1]])] * 2 + [event("Mul", [[1]], [[1]])])
    assert [(one.operator, one.calls, one.time_us) for one in found] == [
        ("Add", 2, 5.0),
        ("Mul", 1, 2.5),
    ]


def test_options_for_something_else_are_refused() -> None:
    with pytest.raises(UsageError, match="--html is for the model alone, --service, not for --op"):
        bench("--operators", "--html", "page.html")


def test_the_json_says_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(json.dumps({"schema": SCHEMA}))
    with pytest.raises(Exception, match="measured_at is missing"):
        read_json(OperatorReport, path, SCHEMA)
