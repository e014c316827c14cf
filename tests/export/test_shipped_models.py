"""What the models that ship promise beyond the contract, through the runtime's own Predictor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eqrt.core.contract import ModelContract
from eqrt.core.scene import Scene
from eqrt.export.vectors import road_scene
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from source_tree import ROOT

MODELS = [DEFAULT_ARTIFACT, *sorted((ROOT / "deploy" / "models").glob("*/"))]
SPEEDS_MPS = np.arange(0.0, 2.0, 0.01)
"""A centimetre per second apart."""


@pytest.mark.parametrize("otherwise", ["nothing", "heading", "heading against", "lanes against"])
@pytest.mark.parametrize("folder", MODELS, ids=lambda folder: folder.name)
def test_no_prediction_jumps_while_the_target_stops_or_reverses(
    folder: Path, otherwise: str
) -> None:
    """A centimetre per second more is 3 cm after 3 s, if the target goes on as it does."""
    predictor = Predictor.load(folder)
    found = predictor.predict(roads(predictor.contract, otherwise))
    ends = np.einsum("bk,bkd->bd", found.probabilities, found.trajectories[:, :, -1])
    moved = np.linalg.norm(np.diff(ends, axis=0), axis=-1)
    assert moved.max() < (0.2 if "against" in otherwise else 0.1)


def roads(contract: ModelContract, otherwise: str) -> Scene:
    """A target along +x at each of SPEEDS_MPS, and what says otherwise than its motion."""
    scenes = [road_scene(contract, float(speed)) for speed in SPEEDS_MPS]
    names = ("history", "history_valid", "heading", "centerlines", "centerlines_valid")
    arrays = {n: np.concatenate([getattr(scene, n) for scene in scenes]) for n in names}
    if otherwise == "lanes against":
        for name in ("centerlines", "centerlines_valid"):
            arrays[name] = np.ascontiguousarray(arrays[name][:, :, ::-1])
    elif otherwise != "nothing":
        arrays["heading"][:, 0] = -1.0 if otherwise == "heading against" else 1.0
    return replace(scenes[0], **arrays)
