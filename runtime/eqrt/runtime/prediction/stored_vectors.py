"""The test vectors of an artifact: inputs and the outputs they must give.

`test_data_set_*/input_*.pb` and `output_*.pb`, serialised TensorProtos in the contract's order, as
ONNX's own backend tests keep them; `name.txt`, if there, says what the scene is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.errors import ContractError
from eqrt.core.files import read_at_most
from eqrt.core.scene import Scene
from eqrt.runtime.prediction.artifact_limits import MAX_TEXT_BYTES
from eqrt.runtime.prediction.tensor_proto import read_tensor

TensorSpecs = Mapping[str, tuple[str, tuple[int | str, ...]]]
"""Tensor name -> (element type, shape), as `ModelContract` gives them."""


@dataclass(frozen=True, slots=True)
class StoredVector:
    """One `test_data_set_*`."""

    name: str
    """What the scene is, else the folder's name."""
    folder: Path
    scene: Scene
    """B targets; its origin is 0."""
    outputs: Mapping[str, NDArray[Any]]
    """By the contract's names, tile frame."""


def vector_folders(artifact: Path) -> list[Path]:
    """The folders `test_data_set_*`, in the order of their numbers."""
    folders = [path for path in artifact.glob("test_data_set_*") if path.is_dir()]
    return sorted(folders, key=lambda path: (len(path.name), path.name))


def read_vector(folder: Path, contract: ModelContract) -> StoredVector:
    """Read one test vector.

    Raises ContractError if a file is missing, or its tensor is not as the contract says.
    """
    inputs = _tensors(folder, "input", contract.inputs)
    outputs = _tensors(folder, "output", contract.outputs)
    batches = {len(tensor) for tensor in (*inputs.values(), *outputs.values())}
    if len(batches) != 1 or 0 in batches:
        raise ContractError(
            f"{folder}: tensors of {sorted(batches)} targets, expected the same number, 1 or more"
        )
    return StoredVector(_name(folder), folder, Scene(**inputs, origin=np.zeros(2)), outputs)


def _tensors(folder: Path, side: str, specs: TensorSpecs) -> dict[str, NDArray[Any]]:
    tensors = {}
    for index, (name, (kind, shape)) in enumerate(specs.items()):
        path = folder / f"{side}_{index}.pb"
        tensors[name] = tensor = read_tensor(path)
        if tensor.dtype != kind or tensor.ndim == 0 or tensor.shape[1:] != shape[1:]:
            raise ContractError(
                f"{path}: {name} is {tensor.dtype} {list(tensor.shape)}, the contract says {kind} "
                f"{list(shape)}; export the model again"
            )
    return tensors


def _name(folder: Path) -> str:
    try:
        content = read_at_most(MAX_TEXT_BYTES, folder / "name.txt")
    except OSError:
        return folder.name
    text = content.decode("utf-8", "replace").strip()
    return text.splitlines()[0] if text else folder.name
