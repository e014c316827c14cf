"""The scene that the examples for other stacks show is what the service saw."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from eqrt.core.scene import Scene, concatenate
from eqrt.export.example_scene import AT_S, DT_S, drive, main
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Prediction, Predictor
from python_example import pack, read_contract
from source_tree import ROOT

SCENE = ROOT / "deploy/examples/scene.json"


class Keeper(Predictor):
    """Predicts, and keeps what it was asked in a cycle."""

    scenes: list[Scene]

    def predict(self, scene: Scene) -> Prediction:
        self.scenes.append(scene)
        return super().predict(scene)


def test_the_examples_show_what_its_recipe_makes(tmp_path: Path) -> None:
    assert main([str(tmp_path / "scene.json")]) == 0
    assert (tmp_path / "scene.json").read_text() == SCENE.read_text()


def test_an_example_gives_the_model_what_the_service_gives_it() -> None:
    """The same neighbours and lines, to the millimetre that the file is rounded to.

    Two neighbours that are equally far, but for that rounding, may change places; lines to a
    decimetre: a model with other points than the file has gets places between them.
    """
    service = Keeper.load(DEFAULT_ARTIFACT)
    service.scenes = []
    for at_s, _ in drive(service):
        if at_s > AT_S - DT_S / 2:
            break
        service.scenes.clear()
    inputs = pack(json.loads(SCENE.read_text()), read_contract(DEFAULT_ARTIFACT))
    expected = concatenate(service.scenes).inputs()
    rows = [_row(expected["history"], target) for target in inputs["history"]]
    places = [
        _places(found, expected["history"][row])
        for row, found in zip(rows, inputs["history"], strict=True)
    ]
    for name, values in inputs.items():
        atol = 0.1 if name == "centerlines" else 1e-3
        wanted = expected[name][rows]
        if name.startswith("history"):
            wanted = np.stack([agents[at] for agents, at in zip(wanted, places, strict=True)])
        np.testing.assert_allclose(values, wanted, atol=atol, err_msg=name)


def _row(histories: np.ndarray, target: np.ndarray) -> int:
    return int(np.abs(histories[:, 0] - target[0]).max(axis=(1, 2)).argmin())


def _places(found: np.ndarray, wanted: np.ndarray) -> list[int]:
    """Where in `wanted` (N, T, 2) each agent of `found` is: in order, but for equal distances."""
    now = found[:, None, -1] - wanted[None, :, -1]
    at = np.hypot(now[..., 0], now[..., 1]).argmin(axis=1).tolist()
    assert sorted(at) == list(range(len(wanted)))
    distance = np.hypot(*(wanted[at, -1] - wanted[0, -1]).T)
    assert (np.diff(distance) > -2e-3).all()
    return list(map(int, at))
