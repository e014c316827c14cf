"""An artifact that eqrt did not make: a graph of some nodes, written byte by byte.

Constant velocity from the target's last two steps. `flaws` are changes, each of which breaks a
promise of the contract.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from eqrt.core.contract import METADATA_KEY, ModelContract
from eqrt.runtime.prediction.graph_writer import Node, tensor, write_model
from eqrt.runtime.prediction.protobuf import nested, number, text
from eqrt.runtime.verify.scenes import hostile_scenes, moved, random_pose

CONTRACT = ModelContract(
    name="handmade",
    version="0.1.0",
    num_agents=3,
    history_steps=5,
    num_centerlines=2,
    centerline_points=4,
    horizon_steps=10,
    num_modes=1,
    dt_s=0.1,
)
MADE_VECTORS = 22
"""Test vectors of the artifact."""

FLAWS: dict[str, list[Node]] = {
    "wind": [("Add", ["steady", "ahead"], "flawed", {})],
    "batch": [
        ("ReduceMean", ["steady", "zero"], "mean", {"keepdims": 1}),
        ("Sub", ["steady", "mean"], "flawed", {}),
    ],
    "second agent": [
        ("Where", ["all_seen", "history", "nothing"], "all_masked", {}),
        ("Gather", ["all_masked", "one"], "others", {"axis": 1}),
        ("Gather", ["others", "last_step"], "other", {"axis": 1}),
        ("Sub", ["other", "now"], "between", {}),
        ("Add", ["steady", "between"], "flawed", {}),
    ],
    "first line": [
        ("Gather", ["centerlines", "none"], "line", {"axis": 1}),
        ("Gather", ["line", "none"], "point", {"axis": 1}),
        ("Sub", ["point", "now"], "to_line", {}),
        ("Add", ["steady", "to_line"], "flawed", {}),
    ],
    "measured": [("Add", ["steady", "heading"], "flawed", {})],
    "unmasked": [
        ("Gather", ["of_target", "step_before"], "raw_before", {"axis": 1}),
        ("Sub", ["now", "raw_before"], "flawed", {}),
    ],
    "not finite": [
        ("Mul", ["steady", "steady"], "square", {}),
        ("Div", ["square", "steady"], "flawed", {}),
    ],
    "random": [
        ("RandomUniformLike", ["steady"], "noise", {}),
        ("Mul", ["noise", "little"], "little_noise", {}),
        ("Add", ["steady", "little_noise"], "flawed", {}),
    ],
}
"""What is done to the displacement per step, `steady` (B, 2), on its way to `flawed`."""


_ENDS: dict[int, list[Node]] = {
    1: [
        ("Unsqueeze", ["path", "axis"], "trajectories", {}),
        ("Mul", ["certain", "sure"], "probabilities", {}),
    ],
    2: [
        ("Sub", ["start", "course"], "way_back", {}),
        ("Unsqueeze", ["path", "axis"], "on", {}),
        ("Unsqueeze", ["way_back", "axis"], "back", {}),
        ("Concat", ["on", "back"], "trajectories", {"axis": 1}),
        ("Mul", ["certain", "sure"], "half", {}),
        ("Concat", ["half", "half"], "probabilities", {"axis": 1}),
    ],
}
"""By the number of modes. Two are as probable as each other: on as before, and back."""


def write_handmade(
    folder: Path,
    *,
    flaw: str | None = None,
    contract: ModelContract = CONTRACT,
    sure: float = 1.0,
    batch: int | None = None,
    opset: int = 18,
    ir_version: int = 8,
) -> Path:
    """Write the artifact, complete with test vectors and checksums.

    sure: what every probability is. batch: the only number of targets, if not any.
    """
    folder.mkdir(parents=True)
    told = contract.to_json()
    model = _model(
        contract,
        flaw=FLAWS.get(flaw or "", []),
        sure=sure,
        batch=batch,
        opset=opset,
        ir_version=ir_version,
    )
    model += nested(14, text(1, METADATA_KEY) + text(2, told))
    (folder / "model.onnx").write_bytes(model)
    (folder / "contract.json").write_text(told, encoding="utf-8")
    _write_vectors(folder, contract, model)
    sign(folder)
    return folder


def sign(folder: Path) -> None:
    """Make SHA256SUMS fit whatever is there."""
    sums = folder / "SHA256SUMS"
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path != sums)
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(folder).as_posix()}\n"
        for path in paths
    ]
    sums.write_text("".join(lines), encoding="utf-8")


def external_tensor(name: str, location: str) -> bytes:
    """A TensorProto of one float32 that lies in another file."""
    entry = nested(13, text(1, "location") + text(2, location))
    return number(1, 1) + number(2, 1) + text(8, name) + entry + number(14, 1)


def with_initializer(model: bytes, initializer: bytes) -> bytes:
    """A ModelProto with one more tensor: repeated messages are joined by appending them."""
    return model + nested(7, nested(5, initializer))


def _write_vectors(folder: Path, contract: ModelContract, model: bytes) -> None:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # it tells of constants that only other flaws use
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    rng, plain = np.random.default_rng(3), hostile_scenes(contract)["plain"]
    for index in range(MADE_VECTORS):
        scene = moved(plain, random_pose(plain, rng))
        vector = folder / f"test_data_set_{index}"
        vector.mkdir()
        for place, (name, values) in enumerate(scene.inputs().items()):
            (vector / f"input_{place}.pb").write_bytes(tensor(name, values))
        outputs = session.run(list(contract.outputs), scene.inputs())
        for place, (name, values) in enumerate(zip(contract.outputs, outputs, strict=True)):
            (vector / f"output_{place}.pb").write_bytes(tensor(name, values))


def _model(
    contract: ModelContract,
    *,
    flaw: list[Node],
    sure: float,
    batch: int | None,
    opset: int,
    ir_version: int,
) -> bytes:
    last = contract.history_steps - 1
    steps = np.arange(1, contract.horizon_steps + 1, dtype=np.float32)[:, None]
    constants: dict[str, NDArray[Any]] = {
        "none": np.array(0, np.int64),
        "one": np.array(1, np.int64),
        "zero": np.array([0], np.int64),
        "axis": np.array([1], np.int64),
        "end": np.array([-1], np.int64),
        "last_step": np.array(last, np.int64),
        "step_before": np.array(last - 1, np.int64),
        "nothing": np.zeros(1, np.float32),
        "steps": steps,
        "sure": np.array([[sure]], np.float32),
        "ahead": np.array([[0.1, 0.0]], np.float32),
        "little": np.array([1e-5], np.float32),
    }
    nodes: list[Node] = [
        ("Gather", ["history", "none"], "of_target", {"axis": 1}),
        ("Gather", ["history_valid", "none"], "target_seen", {"axis": 1}),
        ("Unsqueeze", ["history_valid", "end"], "all_seen", {}),
        ("Unsqueeze", ["target_seen", "end"], "seen", {}),
        ("Where", ["seen", "of_target", "nothing"], "masked", {}),
        ("Gather", ["of_target", "last_step"], "now", {"axis": 1}),
        ("Gather", ["masked", "step_before"], "before", {"axis": 1}),
        ("Gather", ["seen", "step_before"], "twice", {"axis": 1}),
        ("Sub", ["now", "before"], "moved", {}),
        ("Where", ["twice", "moved", "nothing"], "steady", {}),
        *flaw,
        ("Unsqueeze", ["flawed" if flaw else "steady", "axis"], "step", {}),
        ("Mul", ["step", "steps"], "course", {}),
        ("Unsqueeze", ["now", "axis"], "start", {}),
        ("Add", ["start", "course"], "path", {}),
        ("Gather", ["seen", "last_step"], "exists", {"axis": 1}),
        ("Cast", ["exists"], "certain", {"to": 1}),
        *_ENDS[contract.num_modes],
    ]
    if contract.covariances:
        constants["circle"] = 4.0 * np.eye(2, dtype=np.float32)
        nodes += [
            ("Unsqueeze", ["trajectories", "end"], "places", {}),
            ("Mul", ["places", "nothing"], "nowhere", {}),
            ("Add", ["nowhere", "circle"], "covariances", {}),
        ]
    inputs, outputs = (
        {name: (kind, (batch or "B", *shape[1:])) for name, (kind, shape) in specs.items()}
        for specs in (contract.inputs, contract.outputs)
    )
    return write_model(nodes, constants, inputs, outputs, opset=opset, ir_version=ir_version)


def contract_with(contract: ModelContract, **changes: object) -> str:
    """`contract.json` with other values."""
    return json.dumps({**json.loads(contract.to_json()), **changes})
