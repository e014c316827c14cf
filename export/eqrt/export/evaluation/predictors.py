"""What is evaluated: an artifact as the car runs it, a checkpoint, and physics beside them.

Every one maps W windows to trajectories (W, K, H, 2) in the tile frame, metres, and probabilities
(W, K), the most probable mode first; a model may also say how far off these may be.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.core.kalman import kalman
from eqrt.core.kinematics import constant_turn, constant_velocity, fit_motion
from eqrt.core.scene import Scene
from eqrt.export.model_card import TRAINED_ON
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.training.checkpoint import Checkpoint, load_checkpoint
from eqrt.training.dataset.windows import Windows
from eqrt.training.evaluate import INPUTS, Predicted, predict
from eqrt.training.recordings.formats import forbids_commerce

Float64 = NDArray[np.float64]

CHECKPOINT_NAME = "model.safetensors"


class Forecast(Protocol):
    """Predicts windows."""

    def __call__(self, windows: Windows) -> Predicted:
        """Of windows, in their order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCard:
    """Which model it is, for the report. Plain data: it crosses processes."""

    path: str
    kind: str
    """`artifact` or `checkpoint`."""
    name: str
    version: str
    """Of the artifact; a checkpoint has none."""
    model_id: str
    """First digits of the file's SHA-256."""
    modes: int
    """K."""
    covariances: bool
    """Whether it says how far off it may be."""
    horizon_steps: int
    dt_s: float
    license: str
    """Of the weights; empty where nothing says it."""
    non_commercial: bool


@dataclass(frozen=True, slots=True)
class Model:
    """A model that can be evaluated."""

    card: ModelCard
    contract: ModelContract
    predict: Forecast
    trained_on: frozenset[str] = frozenset()
    """The groups that it was trained on (`group_digest`), as far as it tells."""


def load_model(path: Path, threads: int = 1) -> Model:
    """An artifact's folder, a checkpoint, or the folder of one.

    Raises EqrtError if there is neither, and what the loaders of the two raise.
    """
    if (path / "model.onnx").is_file():
        return _load_artifact(path, threads)
    checkpoint = path / CHECKPOINT_NAME if path.is_dir() else path
    if not checkpoint.is_file():
        raise EqrtError(
            f"{path}: no model here; give the folder of model.onnx (`eqrt export` writes it) or a "
            f"{CHECKPOINT_NAME} (`eqrt train` does)"
        )
    torch.set_num_threads(threads)
    return _from_checkpoint(checkpoint, load_checkpoint(checkpoint))


def _load_artifact(folder: Path, threads: int) -> Model:
    predictor = Predictor.load(folder, threads)
    contract = predictor.contract

    def run(windows: Windows) -> Predicted:
        inputs = {name: getattr(windows, name) for name in INPUTS}
        found = predictor.predict(Scene(**inputs, origin=np.zeros(2)))  # stays in the tile frame
        end = None if found.covariances is None else found.covariances[:, :, -1]
        return Predicted(found.trajectories, found.probabilities.astype(np.float64), end)

    card = _card(
        folder,
        contract,
        kind="artifact",
        model_id=predictor.model_id,
        license_=predictor.license,
        nc=predictor.non_commercial or forbids_commerce(predictor.license),
    )
    trained_on = folder / TRAINED_ON
    groups = trained_on.read_text(encoding="utf-8").split() if trained_on.is_file() else ()
    return Model(card, contract, run, frozenset(groups))


def _from_checkpoint(path: Path, checkpoint: Checkpoint) -> Model:
    card, network = checkpoint.card, checkpoint.network
    contract = checkpoint.config.contract(card.name, "0.0.0")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    told = _card(
        path,
        contract,
        kind="checkpoint",
        model_id=digest[:8],
        license_=card.license,
        nc=card.non_commercial or forbids_commerce(card.license),
    )
    return Model(told, contract, partial(predict, network), frozenset(card.trained_on))


def baselines(dt_s: float, horizon_steps: int) -> Mapping[str, Forecast]:
    """Physics, of the target's own history: constant velocity, constant turn, a Kalman filter."""

    def velocity(windows: Windows) -> Predicted:
        history, valid = windows.history[:, 0].astype(np.float64), windows.history_valid[:, 0]
        return _one_mode(constant_velocity(history, valid, horizon_steps))

    def turn(windows: Windows) -> Predicted:
        history, valid = windows.history[:, 0].astype(np.float64), windows.history_valid[:, 0]
        motion = fit_motion(history, valid, dt_s)
        return _one_mode(constant_turn(history[:, -1], *motion, horizon_steps, dt_s))

    def filtered(windows: Windows) -> Predicted:
        history, valid = windows.history[:, 0].astype(np.float64), windows.history_valid[:, 0]
        return _one_mode(kalman(history, valid, horizon_steps, dt_s))

    return {"constant velocity": velocity, "constant turn rate": turn, "Kalman filter": filtered}


def _one_mode(course: Float64) -> Predicted:
    return Predicted(course[:, None], np.ones((len(course), 1)))


def _card(
    path: Path, contract: ModelContract, *, kind: str, model_id: str, license_: str, nc: bool
) -> ModelCard:
    return ModelCard(
        path=str(path),
        kind=kind,
        name=contract.name,
        version=contract.version if kind == "artifact" else "",
        model_id=model_id,
        modes=contract.num_modes,
        covariances=contract.covariances,
        horizon_steps=contract.horizon_steps,
        dt_s=contract.dt_s,
        license=license_,
        non_commercial=nc,
    )
