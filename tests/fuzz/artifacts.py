"""Fuzzed: the files of a model's folder, except what onnxruntime alone reads."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

from eqrt.core.contract import ModelContract
from eqrt.core.errors import ContractError
from eqrt.runtime.prediction.model_file import read_model_file
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.prediction.protobuf import nested, number, text
from eqrt.runtime.prediction.stored_vectors import read_vector
from eqrt.runtime.prediction.tensor_proto import read_tensor
from eqrt.runtime.verify.files import check_files
from fuzz.target import Target, assert_one_line, scratch, written


def _one_line_at_most(run: Callable[..., object], *arguments: object) -> None:
    try:
        run(*arguments)
    except ContractError as error:
        assert_one_line(error)


def read_model(data: bytes) -> None:
    """The reader of our own."""
    _one_line_at_most(read_model_file, written("model.onnx", data))


def read_pb(data: bytes) -> None:
    """A tensor by itself, and as every file of a test vector."""
    _one_line_at_most(read_tensor, written("input_0.pb", data))
    folder = scratch() / "test_data_set_0"
    folder.mkdir(exist_ok=True)
    for name in [*(f"input_{i}.pb" for i in range(5)), "output_0.pb", "output_1.pb", "name.txt"]:
        (folder / name).write_bytes(data)
    _one_line_at_most(read_vector, folder, _contract())


def read_contract(data: bytes) -> None:
    """A contract that is read can be written, and is the same when read again."""
    try:
        contract = ModelContract.from_json(data.decode("utf-8", "replace"), "contract.json")
    except ContractError as error:
        assert_one_line(error)
        return
    assert ModelContract.from_json(contract.to_json(), "again") == contract


def read_sums(data: bytes) -> None:
    """By `eqrt verify`, and when the model is loaded: bytes that no sum is right for."""
    folder = scratch() / "artifact"
    folder.mkdir(exist_ok=True)
    (folder / "SHA256SUMS").write_bytes(data)
    (folder / "model.onnx").write_bytes(b"no model")
    check_files(folder)
    _one_line_at_most(Predictor.load, folder)


def _contract() -> ModelContract:
    return ModelContract(
        name="tiny",
        version="1.0.0",
        num_agents=1,
        history_steps=1,
        num_centerlines=1,
        centerline_points=1,
        horizon_steps=1,
        num_modes=1,
        dt_s=0.1,
    )


def _models() -> Iterator[bytes]:
    dimension = nested(1, number(1, 3)) + nested(1, text(2, "B"))
    tensor_type = nested(1, number(1, 1) + nested(2, dimension))
    tensor = number(1, 2) + number(1, 3) + number(2, 1) + text(8, "weight") + nested(9, bytes(24))
    external = text(8, "far") + number(14, 1) + nested(13, text(1, "location") + text(2, "x.bin"))
    inner = nested(1, nested(5, nested(5, external)))
    graph = (
        nested(1, text(4, "Add") + nested(5, nested(6, inner)))
        + nested(5, tensor)
        + nested(11, text(1, "history") + nested(2, tensor_type))
        + nested(12, text(1, "trajectories") + nested(2, tensor_type))
        + nested(15, nested(1, tensor) + nested(2, external))
    )
    yield (
        number(1, 8)
        + text(2, "eqrt")
        + nested(7, graph)
        + nested(8, text(1, "ai.onnx") + number(2, 17))
        + nested(14, text(1, "eqrt_contract") + text(2, "{}"))
        + nested(25, nested(7, nested(5, nested(5, external))))
    )
    yield (DEFAULT_ARTIFACT / "model.onnx").read_bytes()[:2000]


def _tensors() -> Iterator[bytes]:
    yield (
        number(1, 1)
        + number(1, 1)
        + number(1, 1)
        + number(1, 2)
        + number(2, 1)
        + nested(9, bytes(8))
    )
    yield nested(1, bytes([1, 1, 1])) + number(2, 9) + nested(9, b"\1")
    for name in ("input_1.pb", "input_2.pb", "output_1.pb"):
        yield (DEFAULT_ARTIFACT / "test_data_set_0" / name).read_bytes()


def _contracts() -> Iterator[bytes]:
    yield (DEFAULT_ARTIFACT / "contract.json").read_bytes()
    yield _contract().to_json().encode()


def _sums() -> Iterator[bytes]:
    yield b"".join(_lines(DEFAULT_ARTIFACT / "SHA256SUMS")[:6])
    good = hashlib.sha256(b"no model").hexdigest()
    yield f"{good}  model.onnx\n{good} *../model.onnx\n".encode()


def _lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


TARGETS = [
    Target(name="model-file", run=read_model, seeds=_models),
    Target(name="test-vector", run=read_pb, seeds=_tensors),
    Target(
        name="contract",
        run=read_contract,
        seeds=_contracts,
        words=('"dt_s": ', '"covariances": true', "NaN", "1e999", '"schema": 1'),
    ),
    Target(name="sha256sums", run=read_sums, seeds=_sums, words=("  model.onnx\n", "../", "/")),
]
