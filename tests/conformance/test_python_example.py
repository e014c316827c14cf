"""The Python example: what it gives to a model, and what its check finds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eqrt.runtime.prediction.graph_writer import tensor
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.prediction.tensor_proto import read_tensor as eqrts_own
from handmade_model import CONTRACT, write_handmade
from python_example import compare, main, pack, read_tensor
from source_tree import ROOT

SCENE = ROOT / "deploy/examples/scene.json"


@pytest.fixture(scope="module")
def uncertain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artifact of other sizes than ours, with covariances."""
    contract = replace(CONTRACT, covariances=True)
    return write_handmade(tmp_path_factory.mktemp("artifact") / "uncertain", contract=contract)


# --- checking


def test_test_vectors_are_read_as_eqrt_reads_them() -> None:
    paths = sorted(DEFAULT_ARTIFACT.rglob("*.pb"))
    assert paths
    for path in paths:
        side, _, index = path.stem.partition("_")
        np.testing.assert_array_equal(read_tensor(path.parent, side, int(index)), eqrts_own(path))


def test_what_agrees_is_ok(uncertain: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--check", str(DEFAULT_ARTIFACT), str(uncertain)]) == 0
    ours, handmade = capsys.readouterr().out.splitlines()
    assert ours.startswith("eqrt-free: ")
    assert handmade == "handmade: 22 vectors, worst 0.0000 mm, ok"


@pytest.mark.parametrize(("output", "change"), [(0, 0.005), (0, np.nan), (1, 0.01), (2, 0.1)])
def test_one_value_that_differs_is_found(
    output: int, change: float, uncertain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A position, a probability, a covariance."""
    path = uncertain / f"test_data_set_7/output_{output}.pb"
    whole = path.read_bytes()
    values = read_tensor(path.parent, "output", output).copy()
    values.reshape(-1)[-1] += np.float32(change)
    path.write_bytes(tensor("changed", values))
    status = main(["--check", str(uncertain)])
    path.write_bytes(whole)
    assert status == 1
    assert capsys.readouterr().out.endswith(", FAILED\n")


def test_modes_of_equal_probability_may_change_places() -> None:
    left, right = np.zeros((1, 1, 5, 2), np.float32), np.ones((1, 1, 5, 2), np.float32)
    one, other = np.concatenate([left, right], 1), np.concatenate([right, left], 1)
    even, uneven = np.array([[0.5, 0.5]], np.float32), np.array([[0.6, 0.4]], np.float32)
    assert compare([one, even], [other, even]) == (0.0, True)
    assert compare([one, uneven], [other, uneven]) == (1.0, False)


def test_anything_else_is_told_how_it_is_used(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--chekc", str(DEFAULT_ARTIFACT)]) == 2
    assert "python predict.py ARTIFACT SCENE.json" in capsys.readouterr().err


# --- a scene


def contract(**sizes: int) -> Any:
    return json.loads(replace(CONTRACT, **sizes).to_json())  # type: ignore[arg-type]  # sizes only


def small_scene() -> Any:
    """Three cars behind one another, the last one the target; a lane of 100 m that ends at 90."""
    return {
        "dt_s": 0.1,
        "agents": [[[20.0, 0.0]], [[10.0, 0.0]], [None, [-1.0, 0.0], [0.0, 0.0]]],
        "targets": [
            {
                "agent": 2,
                "heading": [1.0, 0.0],
                "centerlines": [[[-10.0, 0.0], [15.0, 0.0], [40.0, 0.0], [65.0, 0.0], None]],
                "future": [[1.0, 0.0], [2.0, 0.0]],
            }
        ],
    }


def test_the_target_comes_first_and_then_the_nearest() -> None:
    inputs = pack(small_scene(), contract(num_agents=2))
    assert inputs["history"][0, :, -1].tolist() == [[0.0, 0.0], [10.0, 0.0]]


def test_the_last_steps_are_taken_and_unseen_ones_are_not_valid() -> None:
    valid = pack(small_scene(), contract(num_agents=4, history_steps=5))["history_valid"][0]
    assert valid.sum(axis=1).tolist() == [2, 1, 1, 0]
    assert valid[0].tolist() == [False, False, False, True, True]
    assert pack(small_scene(), contract(history_steps=1))["history_valid"][0, 0].tolist() == [True]


def test_lines_get_as_many_points_as_the_model_wants() -> None:
    few = pack(small_scene(), contract(centerline_points=3))
    assert few["centerlines"][0, 0, :, 0].tolist() == [-10.0, 40.0, 0.0]
    assert few["centerlines_valid"][0, 0].tolist() == [True, True, False]
    many = pack(small_scene(), contract(centerline_points=9))
    assert many["centerlines"][0, 0, :3, 0].tolist() == [-10.0, 2.5, 15.0]
    assert not many["centerlines_valid"][0, 1].any()


def test_a_scene_on_another_clock_is_refused() -> None:
    with pytest.raises(SystemExit, match=r"a step is 0\.1 s, the model wants 0\.2 s"):
        pack(small_scene(), contract() | {"dt_s": 0.2})


def test_the_recorded_scene_is_predicted(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(DEFAULT_ARTIFACT), str(SCENE)]) == 0
    targets = len(json.loads(SCENE.read_text())["targets"])
    assert capsys.readouterr().out.count(" m away\n") == targets
