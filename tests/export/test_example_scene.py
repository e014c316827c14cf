"""The scene that the examples for other stacks show is what the service saw."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from eqrt.core.scene import Scene
from eqrt.export.example_scene import AT_S, DT_S, drive, main
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Prediction, Predictor
from python_example import pack, read_contract
from source_tree import ROOT

SCENE = ROOT / "deploy/examples/scene.json"


class Keeper(Predictor):
    """Predicts, and keeps what it was asked last."""

    scene: Scene

    def predict(self, scene: Scene) -> Prediction:
        self.scene = scene
        return super().predict(scene)


def test_the_examples_show_what_its_recipe_makes(tmp_path: Path) -> None:
    assert main([str(tmp_path / "scene.json")]) == 0
    assert (tmp_path / "scene.json").read_text() == SCENE.read_text()


def test_an_example_gives_the_model_what_the_service_gives_it() -> None:
    """The same neighbours and lines in order, to the millimetre that the file is rounded to.

    Lines to a decimetre: a model with other points than the file has gets places between them.
    """
    service = Keeper.load(DEFAULT_ARTIFACT)
    next(at_s for at_s, _ in drive(service) if at_s > AT_S - DT_S / 2)
    inputs = pack(json.loads(SCENE.read_text()), read_contract(DEFAULT_ARTIFACT))
    expected = service.scene.inputs()
    rows = [_row(expected["history"], target) for target in inputs["history"]]
    for name, values in inputs.items():
        atol = 0.1 if name == "centerlines" else 1e-3
        np.testing.assert_allclose(values, expected[name][rows], atol=atol, err_msg=name)


def _row(histories: np.ndarray, target: np.ndarray) -> int:
    return int(np.abs(histories[:, 0] - target[0]).max(axis=(1, 2)).argmin())
