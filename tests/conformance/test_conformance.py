"""The parts of `make conformance` that need no other runtime."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from conformance import table
from conformance.artifacts import MOVED_M, damaged, shipped
from conformance.environments import MissingError, find_python, oldest_dependencies
from conformance.readme import README, blocks
from conformance.runtimes import EXAMPLES, outcome_of
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from python_example import read_tensor

ROWS = [
    table.Row("onnxruntime", "1.2.3", "Python", [0.061, 0.5], good=True),
    table.Row("other", "4.5", "C++", [0.061, float("inf")], good=False),
]
TABLE = """\
| runtime | version | how | a 1.0.0, mm | b 2.0.0, mm | verdict |
| --- | --- | --- | --- | --- | --- |
| onnxruntime | 1.2.3 | Python | 0.061 | 0.500 | ok |
| other | 4.5 | C++ | 0.061 | inf | **does not agree** |
"""


def test_what_an_example_prints_is_understood() -> None:
    outcome = outcome_of("eqrt-free: 23 vectors, worst 0.0610 mm, ok\n")
    assert (outcome.good, outcome.worst_mm) == (True, 0.061)
    assert outcome_of("m: 2 vectors, worst Infinity mm, FAILED").worst_mm == np.inf


@pytest.mark.parametrize("line", ["", "ok", "eqrt-free: 0 vectors, worst 0.0000 mm, ok"])
def test_a_check_of_nothing_is_none(line: str) -> None:
    with pytest.raises(RuntimeError, match="not what an example prints"):
        outcome_of(line)


def test_the_table_says_what_was_found_and_is_put_into_its_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{table.BEGIN}old\n{table.END}after\n")
    found = table.render(["a 1.0.0", "b 2.0.0"], ROWS)
    table.store(found, page)
    assert found == table.stored(page) == TABLE
    assert page.read_text() == f"before\n{table.BEGIN}{TABLE}{table.END}after\n"


def test_only_figures_may_differ_from_machine_to_machine() -> None:
    same = table.without_figures(TABLE.replace("0.061", "0.062"))
    assert same == table.without_figures(TABLE)
    assert table.without_figures(TABLE.replace("1.2.3", "1.2.4")) != same
    assert table.without_figures(TABLE.replace("0.500", "inf")) != same


def test_a_page_without_a_place_for_the_table_is_refused(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("nothing\n")
    with pytest.raises(ValueError, match=r"page\.md: no <!-- made by"):
        table.store(TABLE, page)


def test_every_example_is_in_the_readme_that_is_run() -> None:
    commands = "".join(blocks(README.read_text()))
    for program in ("python/predict.py", "javascript/predict.mjs", "build/cpp/predict"):
        assert f"{program} $MODEL scene.json" in commands
        assert f"{program} --check $MODEL" in commands
    assert commands.count("http.server") == 1


def test_every_version_is_pinned() -> None:
    pins = (EXAMPLES / "constraints.txt").read_text().splitlines()
    assert all(re.fullmatch(r"#.*|[\w-]+==[\d.]+", line) for line in pins)
    package = json.loads((EXAMPLES / "javascript/package.json").read_text())
    assert all(re.fullmatch(r"[\d.]+", version) for version in package["dependencies"].values())


def test_the_oldest_versions_are_those_of_the_project() -> None:
    names = {requirement.partition("==")[0] for requirement in oldest_dependencies()}
    assert {"numpy", "onnxruntime"} <= names


def test_the_damaged_copy_is_off_in_one_place(tmp_path: Path) -> None:
    copy = damaged(DEFAULT_ARTIFACT, "position", tmp_path)
    moved = []
    for vector in sorted(DEFAULT_ARTIFACT.glob("test_data_set_*")):
        found = read_tensor(copy / vector.name, "output", 0)
        moved += np.abs(found - read_tensor(vector, "output", 0)).ravel().tolist()
    assert np.count_nonzero(moved) == 1
    assert max(moved) == pytest.approx(MOVED_M, rel=0.05)


def test_all_that_ships_is_tried() -> None:
    assert DEFAULT_ARTIFACT in shipped()
    assert len(shipped()) > 1


def test_what_this_machine_lacks_is_named() -> None:
    with pytest.raises(MissingError, match=r"no Python 2\.0 on this machine"):
        find_python("2.0")
