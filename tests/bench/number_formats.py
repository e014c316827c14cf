"""Would smaller numbers make a model faster, and what would they cost?

    python tests/bench/number_formats.py [ARTIFACT]

The artifact's own test vectors, with learned weights as float32, as float16 and bfloat16 (stored,
computed in float32: onnxruntime has no such products on CPUs) and as int8: "dynamic" scales to what
each run's tensors hold, "static" to what all test vectors showed. Positions, masks and frames stay
float32. Needs the workstation's environment, and wants a quiet machine.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnxruntime.quantization import (
    CalibrationDataReader,
    QuantFormat,
    QuantType,
    quantize_dynamic,
    quantize_static,
)

from eqrt.core.contract import ModelContract
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene, concatenate
from eqrt.export.vectors import TURNED, TWINS
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.prediction.stored_vectors import read_vector, vector_folders

BATCHES = (1, 32)
TURNS, RUNS = 7, 60
"""Formats take turns, each turn a median of so many runs: what disturbs one disturbs all."""
_FORMS = ("", "_MatMul")
"""What onnxruntime calls a Gemm that it has taken apart before quantizing."""
LARGE = 1_000
"""Smaller constants are masks and time steps; their size does not matter, their values do."""


def main(arguments: Sequence[str]) -> int:
    """Print the table."""
    folder = Path(arguments[0]) if arguments else DEFAULT_ARTIFACT
    scenes = named_vectors(folder)
    with tempfile.TemporaryDirectory() as scratch:
        files = {name: make(folder, Path(scratch)) for name, make in FORMATS.items()}
        sizes = {name: file.stat().st_size for name, file in files.items()}
        sessions = {name: session(file) for name, file in files.items()}
    together = concatenate(list(scenes.values()))
    times = {name: latency_us(sessions, together, batch) for name, batch in _cases()}
    exact = trajectories(sessions["float32"], together)
    print(f"{folder.name}: {len(scenes)} test vectors, 1 thread, onnxruntime", end=" ")
    print(f"{onnxruntime.__version__}\n")
    heads = ["us, " + name for name, _ in _cases()]
    print(_row("weights", "MB", *heads, "moved, m", "turned, m", "in a batch, m"))
    for name, each in sessions.items():
        found = trajectories(each, together)
        alone = np.concatenate([trajectories(each, scene) for scene in scenes.values()])
        print(
            _row(
                name,
                f"{sizes[name] / 1e6:.2f}",
                *(f"{times[case][name]:.0f}" for case, _ in _cases()),
                f"{np.abs(found - exact).max():.4f}",
                f"{turned_apart_m(each, scenes):.4f}",
                f"{np.abs(found - alone).max():.4f}",
            )
        )
    return 0


def named_vectors(folder: Path) -> Mapping[str, Scene]:
    """The artifact's test vectors without NaN, by name."""
    contract = ModelContract.from_json((folder / "contract.json").read_text("utf-8"), str(folder))
    return {
        (vector / "name.txt").read_text("utf-8").strip(): read_vector(vector, contract).scene
        for vector in vector_folders(folder)
    }


def as_it_is(folder: Path, scratch: Path) -> Path:
    """The artifact's own file, copied."""
    file = scratch / "float32.onnx"
    file.write_bytes((folder / "model.onnx").read_bytes())
    return file


def half_weights(folder: Path, scratch: Path, kind: int) -> Path:
    """Large weights stored as `kind`, cast when the session starts."""
    model = onnx.load(folder / "model.onnx")
    graph = model.graph
    for tensor in [tensor for tensor in graph.initializer if np.prod(tensor.dims) > LARGE]:
        values = onnx.numpy_helper.to_array(tensor)
        half = values.astype(onnx.helper.tensor_dtype_to_np_dtype(kind))
        graph.initializer.remove(tensor)
        stored = f"{tensor.name}_half"
        graph.initializer.append(onnx.numpy_helper.from_array(half, stored))
        cast = onnx.helper.make_node("Cast", [stored], [tensor.name], to=onnx.TensorProto.FLOAT)
        graph.node.insert(0, cast)
    file = scratch / f"{kind}.onnx"
    onnx.save(model, file)
    return file


def learned_products(folder: Path) -> list[str]:
    """The nodes that multiply with large weights: what may be quantized."""
    graph = onnx.load(folder / "model.onnx").graph
    large = {tensor.name for tensor in graph.initializer if np.prod(tensor.dims) > LARGE}
    return [
        node.name
        for node in graph.node
        if node.op_type in ("MatMul", "Gemm") and large & set(node.input)
    ]


def dynamic_int8(folder: Path, scratch: Path) -> Path:
    """Products of int8, scaled to what each run's tensors hold."""
    file = scratch / "dynamic.onnx"
    quantize_dynamic(
        folder / "model.onnx",
        file,
        weight_type=QuantType.QInt8,
        nodes_to_quantize=[f"{name}{form}" for name in learned_products(folder) for form in _FORMS],
    )
    return file


class Vectors(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime has no types
    """The artifact's test vectors, one after the other."""

    def __init__(self, folder: Path) -> None:
        self._left = [scene.inputs() for scene in named_vectors(folder).values()]

    def get_next(self) -> Mapping[str, np.ndarray] | None:
        """None after the last."""
        return self._left.pop() if self._left else None


def static_int8(folder: Path, scratch: Path) -> Path:
    """Products of int8, scaled to what the test vectors showed."""
    file = scratch / "static.onnx"
    quantize_static(
        folder / "model.onnx",
        file,
        Vectors(folder),
        quant_format=QuantFormat.QDQ,
        per_channel=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        nodes_to_quantize=learned_products(folder),
    )
    return file


FORMATS: Mapping[str, Callable[[Path, Path], Path]] = {
    "float32": as_it_is,
    "float16": partial(half_weights, kind=onnx.TensorProto.FLOAT16),
    "bfloat16": partial(half_weights, kind=onnx.TensorProto.BFLOAT16),
    "dynamic int8": dynamic_int8,
    "static int8": static_int8,
}


def session(file: Path) -> Any:
    """As the service's, but for the artifact's checks."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(
        file, options, ["CPUExecutionProvider"], disabled_optimizers=["SkipLayerNormFusion"]
    )


def trajectories(session: Any, scene: Scene) -> np.ndarray:
    """(B, K, H, 2) metres, tile frame."""
    return np.asarray(session.run(["trajectories"], scene.inputs())[0])


def turned_apart_m(session: Any, scenes: Mapping[str, Scene]) -> float:
    """How far the predictions for turned scenes lie from the turned predictions."""
    pose: Pose2 = TURNED
    return max(
        float(
            np.abs(
                pose.apply(trajectories(session, scenes[scene]).astype(np.float64))
                - trajectories(session, scenes[twin])
            ).max()
        )
        for twin, scene in TWINS.items()
    )


def latency_us(sessions: Mapping[str, Any], scene: Scene, batch: int) -> Mapping[str, float]:
    """Median of the turns' medians, of a batch of the scene's rows."""
    rows = np.arange(batch) % len(scene.history)
    feed = {name: value[rows] for name, value in scene.inputs().items()}
    medians: dict[str, list[float]] = {name: [] for name in sessions}
    for _ in range(TURNS):
        for name, each in sessions.items():
            each.run(None, feed)
            taken = []
            for _ in range(RUNS):
                began = time.perf_counter_ns()
                each.run(None, feed)
                taken.append(time.perf_counter_ns() - began)
            medians[name].append(float(np.median(taken)) / 1e3)
    return {name: float(np.median(values)) for name, values in medians.items()}


def _cases() -> list[tuple[str, int]]:
    return [(f"{batch} target{'s' if batch > 1 else ''}", batch) for batch in BATCHES]


def _row(*cells: str) -> str:
    first, *others = cells
    return first.ljust(14) + "".join(cell.rjust(16) for cell in others)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
