"""The artifacts that runtimes are tried on: those that ship, and two made for the purpose."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.prediction.graph_writer import tensor
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from handmade_model import CONTRACT, sign, write_handmade
from python_example import read_tensor
from source_tree import ROOT

MOVED_M = 0.005
DAMAGES = {
    "position": (0, MOVED_M),
    "not-a-number": (0, np.nan),
    "probability": (1, 0.001),
    "covariance": (2, 0.1),
}
"""What is wrong with an artifact: the output that is changed, and by how much."""


def shipped() -> list[Path]:
    """The model that comes with eqrt, and the research models."""
    models = sorted(path.parent for path in (ROOT / "deploy/models").glob("*/contract.json"))
    return [DEFAULT_ARTIFACT, *models]


def other_sizes(into: Path) -> Path:
    """Another N, T, Q, L, H and K, and a third output: nothing may be made for one model."""
    contract = replace(CONTRACT, name="other-sizes", num_modes=2, covariances=True)
    return write_handmade(_fresh(into / "other-sizes"), contract=contract, sure=0.5)


def damaged(artifact: Path, damage: str, into: Path) -> Path:
    """A copy in which one value of one test vector is wrong: every check must find it."""
    output, change = DAMAGES[damage]
    folder = _fresh(into / f"damaged-{damage}")
    shutil.copytree(artifact, folder)
    vector = _last_vector(folder)
    values = read_tensor(vector, "output", output).copy()
    values.reshape(-1)[-1] += np.float32(change)
    _write(vector, output, values)
    return folder


def swapped(artifact: Path, into: Path) -> Path:
    """A copy in which the modes of one test vector stand in another order: as good."""
    folder = _fresh(into / "swapped")
    shutil.copytree(artifact, folder)
    vector = _last_vector(folder)
    for output in range(3):
        _write(vector, output, read_tensor(vector, "output", output)[:, ::-1])
    return folder


def _last_vector(folder: Path) -> Path:
    return sorted(folder.glob("test_data_set_*"))[-1]


def _write(vector: Path, output: int, values: NDArray[Any]) -> None:
    path = vector / f"output_{output}.pb"
    path.write_bytes(tensor("changed", np.ascontiguousarray(values)))
    sign(vector.parent)


def _fresh(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder
