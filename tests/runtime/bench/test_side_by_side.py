"""`eqrt bench --compare`: several models in one run, as a table and as a plot."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from bench_reports import (
    ENVIRONMENT,
    MS,
    Constant,
    bench,
    case,
    documented_keys,
    report,
    result,
)
from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bench.json_form import read_json, to_json
from eqrt.runtime.bench.measure import measure
from eqrt.runtime.bench.schedule import Turn
from eqrt.runtime.bench.side_by_side.accuracy import Accuracy, from_card, match, read_eval
from eqrt.runtime.bench.side_by_side.pareto import Point, draw, front
from eqrt.runtime.bench.side_by_side.report import SCHEMA, ComparedModel, SideBySide, markdown
from eqrt.runtime.drawing.names import Box, place_names
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from handmade_model import write_handmade
from source_tree import ROOT

CARD = [
    ["metric", "this model", "constant velocity"],
    ["ADE 1 s", "0.231", "0.259"],
    ["ADE 3 s", "0.861", "1.167"],
    ["FDE 3 s", "1.926", "2.795"],
    ["minADE", "0.8", "1.167"],
    ["minFDE", "1.3", "2.795"],
]


def evaluation(model_id: str, **errors: float) -> dict[str, Any]:
    """As `eqrt eval --json` writes it, as far as it is read."""
    own = {"ade_1s": 0.2, "fde_1s": 0.4, "ade_3s": 0.75, "fde_3s": 1.5} | errors
    physics = {"ade_1s": 0.3, "fde_1s": 0.6, "ade_3s": 1.25, "fde_3s": 2.5}
    return {
        "schema": 1,
        "model": {"model_id": model_id, "horizon_steps": 30, "dt_s": 0.1},
        "targets": 1234,
        "data": [{"path": "some/val"}],
        "groups": [
            {"errors": {"model": own, "Kalman filter": physics, "constant velocity": physics}}
        ],
    }


def test_two_models_for_real(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = write_handmade(tmp_path / "handmade")
    evals = []
    for folder in (DEFAULT_ARTIFACT, other):
        evals.append(tmp_path / f"{folder.name}.json")
        evals[-1].write_text(json.dumps(evaluation(Predictor.load(folder).model_id)))
    written = [tmp_path / name for name in ("both.json", "table.md", "plot.svg")]
    options = ["--targets", "1,20", "--seconds", "1", "--accuracy", *map(str, evals)]
    files = zip(("--json", "--markdown", "--plot"), map(str, written), strict=True)
    told = [word for pair in files for word in pair]
    assert bench("--compare", str(DEFAULT_ARTIFACT), str(other), *options, *told) == 0
    found = read_json(SideBySide, written[0], SCHEMA)
    assert [model.name for model in found.models] == ["eqrt-free", "handmade"]
    assert found.models[0].parameters > found.models[1].parameters
    assert found.models[0].cold_start.rss_mib > found.models[0].cold_start.rss_bare_mib
    names = [workload.name for workload in found.cases[1].workloads]
    assert names == [
        "eqrt-free",
        "handmade",
        "constant velocity",
        "constant turn rate",
        "Kalman filter",
    ]
    assert len({workload.samples for workload in found.cases[0].workloads}) == 1
    text = written[1].read_text()
    assert text == markdown(found)
    assert "| eqrt-free |" in text
    assert "1,234 targets of val" in text
    assert text.splitlines()[0] in capsys.readouterr().out
    assert ElementTree.parse(written[2]).getroot().tag.endswith("svg")


def test_who_begins_changes_from_turn_to_turn() -> None:
    begun: list[str] = []

    class Noting(Constant):
        def run(self, number: int) -> Sequence[int]:
            begun.append(self.name)
            return super().run(number)

    loads = [Noting("a", 4), Noting("b", 8), Noting("c", 12)]
    turns = [Turn(n, 0, 0, waited=False) for n in range(3)]
    measured = measure(
        loads, turns, 3, between=lambda: None, should_stop=lambda: False, rotating=True
    )
    assert "".join(begun) == "abcbcacab"
    assert [stages.sum(axis=1).tolist() for stages in measured.stages_ns] == [
        [4, 4, 4],
        [8, 8, 8],
        [12, 12, 12],
    ]


# --- errors


def test_a_card_tells_the_errors_at_its_longest_horizon() -> None:
    assert from_card(CARD, "x") == Accuracy(
        source="the model card of x",
        horizon_s=3.0,
        ade_m=0.861,
        fde_m=1.926,
        min_ade_m=0.8,
        min_fde_m=1.3,
    )
    course = from_card(CARD, "x", column=2)
    assert course is not None
    assert (course.ade_m, course.min_ade_m) == (1.167, None)
    assert from_card([], "x") is None
    assert from_card([CARD[0], ["ADE 3 s", "unknown"]], "x") is None


def test_an_evaluation_tells_those_of_the_model_and_of_physics(tmp_path: Path) -> None:
    path = tmp_path / "eval.json"
    modes = {"min_ade_6": 0.5, "min_fde_6": 0.9, "min_ade_20": 0.4, "min_fde_20": 0.7}
    path.write_text(json.dumps(evaluation("12345678", **modes)))
    found = read_eval(path)
    assert found.model_id == "12345678"
    assert (found.model.ade_m, found.model.min_ade_m, found.model.min_fde_m) == (0.75, 0.5, 0.9)
    assert {name: one.fde_m for name, one in found.physics.items()} == {
        "Kalman filter": 2.5,
        "constant velocity": 2.5,
    }
    assert match([found], {"a": "ffffffff", "b": "12345678"}) == {"b": found}
    with pytest.raises(EqrtError, match=r"evaluates the model 12345678, which is not compared"):
        match([found], {"a": "ffffffff"})
    with pytest.raises(EqrtError, match="both evaluate b; give one"):
        match([found, found], {"b": "12345678"})


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "not a report of an evaluation"),
        ("[]", "not a report of an evaluation"),
        ('{"schema": 1}', r"not a report of an evaluation \(KeyError: 'model'\)"),
        ('{"schema": 9}', "schema 9 of eqrt eval is not supported"),
    ],
)
def test_a_file_that_is_no_evaluation_is_refused_in_one_line(
    tmp_path: Path, content: str, said: str
) -> None:
    path = tmp_path / "eval.json"
    path.write_text(content)
    with pytest.raises(EqrtError, match=said) as error:
        read_eval(path)
    assert "\n" not in str(error.value)
    with pytest.raises(EqrtError, match="cannot be read"):
        read_eval(tmp_path / "nowhere.json")


def test_the_same_model_twice_and_other_options_are_refused() -> None:
    model = str(DEFAULT_ARTIFACT)
    with pytest.raises(UsageError, match="is given twice; compare different models"):
        bench("--compare", model, model)
    with pytest.raises(UsageError, match="not for --compare"):
        bench("--compare", model, "--model", model)
    with pytest.raises(UsageError, match="--markdown is for --compare, not for the model alone"):
        bench("--markdown", "x.md")


# --- the table and the plot


def accuracy(ade_m: float, best_m: float | None = None, source: str = "eval.json") -> Accuracy:
    return Accuracy(
        source=source,
        horizon_s=3.0,
        ade_m=ade_m,
        fde_m=2 * ade_m,
        min_ade_m=best_m,
        min_fde_m=best_m,
    )


def side_by_side(*accuracies: Accuracy | None) -> SideBySide:
    """Models of 2, 4, 6, ... ms."""
    whole = report(case())
    names = [f"model {chr(97 + place)}" for place in range(len(accuracies))]
    loads = [result([2 * (place + 1) * MS] * 700, name) for place, name in enumerate(names)]
    models = [
        ComparedModel(
            name=name,
            folder=name,
            identity=whole.model,
            file_bytes=1_500_000,
            parameters=33_448,
            nodes=300,
            cold_start=whole.cold_start,
            accuracy=known,
        )
        for name, known in zip(names, accuracies, strict=True)
    ]
    physics = result([MS // 10] * 700, "constant velocity")
    return SideBySide(
        schema=SCHEMA,
        measured_at=whole.measured_at,
        settings=whole.settings,
        environment=ENVIRONMENT,
        models=tuple(models),
        physics={"constant velocity": accuracy(1.5)},
        cases=(replace(case(), workloads=(*loads, physics)),),
    )


def test_the_table_has_a_row_for_each_with_ratios_to_the_first() -> None:
    lines = markdown(side_by_side(accuracy(0.9, 0.5), accuracy(0.8), None)).splitlines()
    assert lines[0] == (
        "|  | 1 target, p50 ms | p99 ms | x first | file MB | parameters | memory MiB "
        "| ADE 3 s, m | FDE 3 s, m | minADE, m | minFDE, m |"
    )
    assert lines[2:6] == [
        "| model a | 2.000 | 2.000 | 1.00 | 1.50 | 33,448 | 15.0 | 0.900 | 1.800 | 0.500 | 0.500 |",
        "| model b | 4.000 | 4.000 | 2.00 | 1.50 | 33,448 | 15.0 | 0.800 | 1.600 |  |  |",
        "| model c | 6.000 | 6.000 | 3.00 | 1.50 | 33,448 | 15.0 |  |  |  |  |",
        "| constant velocity | 0.100 | 0.100 | 0.05 |  |  |  | 1.500 | 3.000 |  |  |",
    ]
    assert {line.count("|") for line in lines[:6]} == {12}
    assert "VALID." in lines
    assert "Errors on different data cannot be compared." not in lines
    mixed = markdown(side_by_side(accuracy(0.9), accuracy(0.8, source="its card")))
    assert "Errors on different data cannot be compared." in mixed


def test_a_comparison_comes_back_from_json_as_it_went(tmp_path: Path) -> None:
    path = tmp_path / "compare.json"
    found = side_by_side(accuracy(0.9), None)
    path.write_text(to_json(found))
    assert read_json(SideBySide, path, SCHEMA) == found


def test_every_key_is_documented() -> None:
    keys = documented_keys(json.loads(to_json(side_by_side(accuracy(0.9)))))
    text = (ROOT / "docs/benchmarks.md").read_text(encoding="utf-8")
    made_up = {"constant velocity", "first", "second"}
    assert [key for key in keys - made_up if key not in text] == []


def test_the_front_is_what_nobody_beats_in_both() -> None:
    fast, good, beaten = (Point("f", 1, 3, True), Point("g", 5, 1, True), Point("b", 6, 2, True))
    middle, slower = Point("m", 2, 2, True), Point("s", 2, 2.5, True)
    assert front([beaten, good, slower, middle, fast]) == [fast, middle, good]


def test_the_plot_names_everybody_and_needs_nothing_else() -> None:
    text = draw(side_by_side(accuracy(0.9), accuracy(0.9), accuracy(0.91), None))
    root = ElementTree.fromstring(text)
    texts = [part.text for part in root if part.tag.endswith("text")]
    for name in ("model a", "model b", "model c", "constant velocity"):
        assert name in texts
    assert "model d" not in texts
    assert sum(part.tag.endswith("circle") for part in root) == 4
    assert "prefers-color-scheme: dark" in text
    assert "href" not in text
    with pytest.raises(EqrtError, match="no model's errors are known"):
        draw(side_by_side(None, None))


def test_names_in_a_crowd_cover_neither_each_other_nor_dots_nor_lines() -> None:
    inside = Box(0, 0, 600, 400)
    crowd = [(300.0 + 6 * i, 200.0 + 2 * (i % 3)) for i in range(9)]
    dots = [*crowd, (20.0, 20.0), (590.0, 390.0)]
    line = Box(0, 199, 600, 201)
    places = place_names(dots, [f"model {i}" for i in range(len(dots))], inside, [line])
    boxes = [place.box for place in places]
    assert all(inside.holds(box) and not box.meets(line) for box in boxes)
    assert not any(one.meets(other) for one, other in combinations(boxes, 2))
    assert not any(box.meets(Box(x, y, x, y)) for box in boxes for x, y in dots)
    assert all(place.leader is None for place in places[-2:])
    assert any(place.leader is not None for place in places)


def test_a_name_without_any_room_stands_beside_its_dot() -> None:
    (place,) = place_names([(10.0, 10.0)], ["a long name"], Box(0, 0, 20, 20))
    assert place.leader is None
    assert place.box.nearest(10.0, 10.0) == (19.0, 10.0)
