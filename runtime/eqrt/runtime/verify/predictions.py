"""Predictions as values: run, turned, put together and taken apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import ContractError
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.runtime.prediction.predictor import Prediction, Predictor


def predict(predictor: Predictor, scene: Scene) -> Prediction:
    """Predict all targets of a scene.

    Raises ContractError if onnxruntime cannot run it, or what comes out has another shape.
    """
    batch, contract = len(scene.history), predictor.contract
    try:
        prediction = predictor.predict(scene)
    except Exception as error:  # onnxruntime raises its own classes, with no common base
        raise ContractError(
            f"onnxruntime failed on {batch} targets: {str(error).splitlines()[0]}"
        ) from error
    for name, (_, (_, *shape)) in contract.outputs.items():
        found = getattr(prediction, name).shape
        if found != (batch, *shape):
            raise ContractError(
                f"{batch} targets: {name} have the shape {found}, the contract says "
                f"{(batch, *shape)}"
            )
    return prediction


def targets_of(prediction: Prediction, rows: Sequence[int] | NDArray[np.intp]) -> Prediction:
    """Some targets, in this order."""
    covariances = prediction.covariances
    return Prediction(
        prediction.trajectories[rows],
        prediction.probabilities[rows],
        None if covariances is None else covariances[rows],
    )


def joined(parts: Sequence[Prediction]) -> Prediction:
    """All targets as one prediction."""
    covariances = [part.covariances for part in parts if part.covariances is not None]
    return Prediction(
        np.concatenate([part.trajectories for part in parts]),
        np.concatenate([part.probabilities for part in parts]),
        np.concatenate(covariances) if covariances else None,
    )


def turned(prediction: Prediction, pose: Pose2) -> Prediction:
    """Turned and shifted with the world."""
    covariances = prediction.covariances
    if covariances is not None:
        turn = pose.rotate(np.eye(2)).T  # its columns are where x and y go
        covariances = turn @ covariances @ turn.T
    return Prediction(pose.apply(prediction.trajectories), prediction.probabilities, covariances)


def bits(prediction: Prediction, row: int) -> bytes:
    """All outputs of one target."""
    outputs = (prediction.trajectories, prediction.probabilities, prediction.covariances)
    return b"".join(values[row].tobytes() for values in outputs if values is not None)
