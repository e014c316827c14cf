"""Artifacts: the folder that ships. Written whole or not at all, and read back before it counts."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
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
from eqrt.export.changelog import changelog
from eqrt.export.model_card import TRAINED_ON, model_card
from eqrt.export.place import SUMS, claim, put
from eqrt.export.to_onnx import to_onnx
from eqrt.export.vectors import TURNED, TWINS, named_scenes
from eqrt.runtime.prediction.predictor import Predictor, disagreement
from eqrt.training.checkpoint import Card
from eqrt.training.files import writing

AGREEMENT_M = 1e-3
"""PyTorch and the file must agree within a millimetre (`disagreement`)."""

Tensors = Mapping[str, NDArray[np.float32]]
"""A network's outputs by the contract's names."""
Translate = Callable[[nn.Module, ModelContract, dict[str, str]], bytes]
"""A network, its contract and metadata -> the bytes of a model file: `to_onnx`, and what it is
compared with."""


def write_artifact(
    model: nn.Module,
    contract: ModelContract,
    card: Card,
    folder: Path,
    changes: str | None = None,
    *,
    translate: Translate = to_onnx,
) -> float:
    """Export `model`, verify it, and put it at `folder`, replacing an artifact there.

    `changes` says what is new in this version (`eqrt.export.changelog`). Returns the largest
    disagreement between PyTorch and the file in metres. Raises EqrtError if that is above
    AGREEMENT_M, the runtime's own Predictor refuses the result, something else than an artifact is
    at `folder`, or it cannot be written; ValueError if the model's outputs are not the contract's.
    """
    folder = folder.resolve()
    claim(folder)
    log = changelog(folder, contract.version, changes)
    with writing(folder), _draft_of(folder) as draft:
        metadata = {
            "data": card.data,
            "license": card.license,
            "non_commercial": str(card.non_commercial).lower(),
        }
        scenes = named_scenes(contract)
        expected = {name: _expected(model, contract, scene) for name, scene in scenes.items()}
        (draft / "model.onnx").write_bytes(translate(model, contract, metadata))
        (draft / "contract.json").write_text(contract.to_json() + "\n", encoding="utf-8")
        text = model_card(contract, card, _turned_apart_m(expected))
        (draft / "README.md").write_text(text, encoding="utf-8")
        (draft / "CHANGELOG.md").write_text(log, encoding="utf-8")
        if card.trained_on:
            groups = "".join(f"{group}\n" for group in card.trained_on)
            (draft / TRAINED_ON).write_text(groups, encoding="utf-8")
        for index, (name, scene) in enumerate(scenes.items()):
            _write_vector(scene, expected[name], draft / f"test_data_set_{index}", name)
        _write_checksums(draft)
        error = _read_back(draft, scenes, expected)
        put(draft, folder)
    return error


@contextlib.contextmanager
def _draft_of(folder: Path) -> Iterator[Path]:
    """An empty folder on the disk of `folder`; gone at the end, unless it was moved."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as temporary:
        draft = Path(temporary) / folder.name
        draft.mkdir()
        yield draft


def reference(model: nn.Module, scene: Scene) -> tuple[NDArray[np.float32], ...]:
    """The torch network's own answer for a scene: the contract's outputs, in order."""
    with torch.no_grad():
        outputs = model(*map(torch.from_numpy, scene.inputs().values()))
    return tuple(output.numpy() for output in outputs)


def _expected(model: nn.Module, contract: ModelContract, scene: Scene) -> Tensors:
    outputs = reference(model, scene)
    if len(outputs) != len(contract.outputs):
        names = ", ".join(contract.outputs)
        raise ValueError(f"the network has {len(outputs)} outputs, the contract has {names}")
    return dict(zip(contract.outputs, outputs, strict=True))


def _read_back(folder: Path, scenes: Mapping[str, Scene], expected: Mapping[str, Tensors]) -> float:
    predictor = Predictor.load(folder)
    worst = 0.0
    for name, scene in scenes.items():
        prediction = predictor.predict(replace(scene, origin=np.zeros(2)))
        for output, value in expected[name].items():
            error = disagreement(output, getattr(prediction, output), value)
            if not error <= AGREEMENT_M:
                raise EqrtError(
                    f"{folder.name}: on the scene {name!r} the {output} of the file and of PyTorch "
                    f"differ by {error:.4g} (allowed {AGREEMENT_M}); the exporter translated "
                    "something wrongly"
                )
            worst = max(worst, error)
    return worst


def _write_vector(scene: Scene, outputs: Tensors, folder: Path, name: str) -> None:
    """One test vector in the ONNX convention: input_*.pb, output_*.pb."""
    folder.mkdir()
    for side, tensors in (("input", scene.inputs()), ("output", outputs)):
        for index, (tensor_name, value) in enumerate(tensors.items()):
            _write_tensor(folder / f"{side}_{index}.pb", tensor_name, value)
    (folder / "name.txt").write_text(name + "\n", encoding="utf-8")


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
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")


def _turned_apart_m(expected: Mapping[str, Tensors]) -> float:
    """How far the predictions for turned scenes lie from the turned predictions, metres."""
    return max(
        float(np.abs(TURNED.apply(before.astype(np.float64)) - after).max())
        for before, after in (
            (expected[scene]["trajectories"], expected[twin]["trajectories"])
            for twin, scene in TWINS.items()
        )
    )
