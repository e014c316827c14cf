"""Artifacts: the folder that ships. Written whole or not at all, and read back before it counts."""

from __future__ import annotations

import hashlib
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx.numpy_helper
import torch
from numpy.typing import NDArray
from torch import nn

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.core.scene import Scene
from eqrt.export.to_onnx import to_onnx
from eqrt.export.vectors import named_scenes
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.training.checkpoint import Card

AGREEMENT_M = 1e-3
"""PyTorch and the file must agree within a millimetre."""


def write_artifact(model: nn.Module, contract: ModelContract, card: Card, folder: Path) -> float:
    """Export `model`, verify it, and put it at `folder` (replacing an artifact there).

    Returns the largest disagreement between PyTorch and the file in metres. Raises EqrtError if
    that is above AGREEMENT_M or the runtime's own Predictor refuses the result.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as temporary:
        draft = Path(temporary) / folder.name
        draft.mkdir()
        metadata = {
            "data": card.data,
            "license": card.license,
            "non_commercial": str(card.non_commercial).lower(),
        }
        (draft / "model.onnx").write_bytes(to_onnx(model, contract, metadata))
        (draft / "contract.json").write_text(contract.to_json() + "\n", encoding="utf-8")
        (draft / "README.md").write_text(_model_card(contract, card), encoding="utf-8")
        scenes = named_scenes(contract)
        for index, (name, scene) in enumerate(scenes.items()):
            _write_vector(model, scene, draft / f"test_data_set_{index}", name)
        _write_checksums(draft)
        error = _read_back(model, scenes, draft)
        if folder.exists():
            shutil.rmtree(folder)
        draft.rename(folder)
    return error


def reference(model: nn.Module, scene: Scene) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The torch network's own answer for a scene: (B, K, H, 2) tile frame, (B, K)."""
    with torch.no_grad():
        trajectories, probabilities = model(*map(torch.from_numpy, scene.inputs().values()))
    return trajectories.numpy(), probabilities.numpy()


def _read_back(model: nn.Module, scenes: dict[str, Scene], folder: Path) -> float:
    predictor = Predictor.load(folder)
    worst = 0.0
    for name, scene in scenes.items():
        found = predictor.predict(scene)
        trajectories, probabilities = reference(model, scene)
        error = float(np.abs(found.trajectories - scene.origin - trajectories).max())
        error = max(error, float(np.abs(found.probabilities - probabilities).max()))
        if not error <= AGREEMENT_M:
            raise EqrtError(
                f"{folder.name}: on the scene {name!r} the file and PyTorch differ by {error:.4g} m"
                f" (allowed {AGREEMENT_M}); the exporter translated something wrongly"
            )
        worst = max(worst, error)
    return worst


def _write_vector(model: nn.Module, scene: Scene, folder: Path, name: str) -> None:
    """One test vector in the ONNX convention: input_*.pb, output_*.pb."""
    folder.mkdir()
    outputs = dict(zip(("trajectories", "probabilities"), reference(model, scene), strict=True))
    for side, tensors in (("input", scene.inputs()), ("output", outputs)):
        for index, (tensor_name, value) in enumerate(tensors.items()):
            _write_tensor(folder / f"{side}_{index}.pb", tensor_name, value)
    (folder / "name.txt").write_text(name + "\n", encoding="utf-8")


def _anywhere(command: str) -> str:
    """A command line without the folders of the machine that it ran on."""
    return re.sub(r"(?<=\s)\S*/(?=\S)", "", command)


def _metric(name: str) -> str:
    """How a table calls a metric: `ade_3s` is ADE 3 s."""
    if of_mean := re.fullmatch(r"(ade|fde)_(\d+)s", name):
        return f"{of_mean[1].upper()} {of_mean[2]} s"
    return {"min_ade": "minADE", "min_fde": "minFDE", "miss_rate": "miss rate, share"}[name]


def _what_counts(contract: ModelContract) -> str:
    if contract.num_modes == 1:
        return "mean and final displacement of the trajectory"
    return (
        "ADE and FDE of the most probable trajectory; minADE, minFDE and miss rate of the best of "
        f"{contract.num_modes}"
    )


def _write_tensor(path: Path, name: str, value: NDArray[Any]) -> None:
    proto = onnx.numpy_helper.from_array(np.ascontiguousarray(value), name)
    path.write_bytes(proto.SerializeToString(deterministic=True))


def _write_checksums(folder: Path) -> None:
    """SHA256SUMS in the format of `sha256sum`, so that `sha256sum -c` checks it too."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(folder).as_posix()}\n"
        for path in files
    ]
    (folder / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


def _model_card(contract: ModelContract, card: Card) -> str:
    rows = "".join(
        f"| {_metric(name)} | {value:.3f} | {card.baseline[name]:.3f} |\n"
        for name, value in card.metrics.items()
    )
    tensors = "".join(
        f"| `{name}` | {kind} | ({', '.join(map(str, shape))}) |\n"
        for name, (kind, shape) in (contract.inputs | contract.outputs).items()
    )
    modes = f"{contract.num_modes} trajectories" if contract.num_modes > 1 else "one trajectory"
    return f"""# {contract.name} {contract.version}

Predicts where traffic goes: for each target, its history and its neighbours' and the lane
centerlines around it become {modes} of {contract.horizon_steps * contract.dt_s:g} s.

| | |
| --- | --- |
| data | {card.data} |
| licence of the weights | {card.license}{", non-commercial" if card.non_commercial else ""} |
| parameters | {card.parameters} |
| trained by | `{_anywhere(card.command)}`, {card.steps} steps, seed {card.seed} |
| its configuration | SHA-256 {card.config_sha256[:16]} |
| contract | version 1, `contract.json` |
| check | `sha256sum -c SHA256SUMS`; `test_data_set_*` hold inputs and expected outputs |

Errors on held-out recordings, metres ({_what_counts(contract)}):

| metric | this model | constant velocity |
| --- | --- | --- |
{rows}
| tensor | type | shape |
| --- | --- | --- |
{tensors}
All positions are metres in one local frame (x east, y north) whose origin lies within 1 km of the
car; turning or shifting that frame turns or shifts the prediction and nothing else.

Limits: it knows vehicles on roads like those in its data; not pedestrians or cyclists, nor other
countries' roads. It predicts what usually happens; it is no guarantee of what will.
"""
