"""What an ONNX file says of itself, read without the onnx package and without running it.

Of the messages in the ONNX specification (onnx/onnx.proto) only what an artifact is judged by:
versions, metadata, the tensors that go in and out, and whether weights lie in other files.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import prod
from pathlib import Path

from eqrt.core.errors import ContractError
from eqrt.core.files import read_at_most
from eqrt.runtime.prediction.artifact_limits import MAX_MODEL_BYTES, MAX_TENSOR_AXES
from eqrt.runtime.prediction.protobuf import fields, varints

KINDS = {1: "float32", 2: "uint8", 3: "int8", 6: "int32", 7: "int64", 9: "bool", 10: "float16"}
"""TensorProto.DataType -> element type; others are written as their number."""
_FLOATS = {1, 10, 11, 16}  # float32, float16, float64, bfloat16
_EXTERNAL = 1  # TensorProto.DataLocation

Value = int | memoryview


@dataclass(slots=True)
class ModelFile:
    """A ModelProto, as far as we read it."""

    ir_version: int = 0
    """0 where the file does not say."""
    producer: str = ""
    opsets: dict[str, int] = field(default_factory=dict)
    """Operator domain -> version; the standard operators' domain is ''."""
    metadata: dict[str, str] = field(default_factory=dict)
    inputs: dict[str, tuple[str, tuple[int | str, ...]]] = field(default_factory=dict)
    """Name -> (element type, shape), in order; a size that is not fixed is its name, or '?'."""
    outputs: dict[str, tuple[str, tuple[int | str, ...]]] = field(default_factory=dict)
    nodes: int = 0
    """Of the main graph."""
    parameters: int = 0
    """Floating-point numbers in the main graph's initializers."""
    external: list[str] = field(default_factory=list)
    """Names of tensors whose values lie in another file."""


def read_model_file(path: Path) -> ModelFile:
    """Read `model.onnx`. Raises ContractError if it cannot be read or is not an ONNX file."""
    try:
        return parse_model_file(read_at_most(MAX_MODEL_BYTES, path))
    except OSError as error:
        raise ContractError(f"{path}: {error.strerror}; a model is a folder with it") from error
    except (ValueError, IndexError, RecursionError) as error:
        raise ContractError(
            f"{path}: not an ONNX file, or a damaged one ({error}); copy it again"
        ) from error


def parse_model_file(content: bytes) -> ModelFile:
    """The summary of a serialised ModelProto; ValueError or IndexError if it is none."""
    model = ModelFile()
    initializers: set[str] = set()
    for number, value in fields(content):
        match number, value:
            case 1, int():
                model.ir_version = value
            case 2, memoryview():
                model.producer = _text(value)
            case 7, memoryview():
                initializers |= _graph(value, model)
            case 8, memoryview():
                domain, version = _opset(value)
                model.opsets[domain] = version
            case 14, memoryview():
                key, text = _entry(value)
                model.metadata[key] = text
            case 25, memoryview():  # a function: its nodes are field 7
                for node in _messages(value, 7):
                    model.external += _external_of_node(node)
    for name in initializers & set(model.inputs):  # a weight that a caller could replace
        del model.inputs[name]
    return model


def _graph(graph: memoryview, model: ModelFile) -> set[str]:
    """Add a GraphProto to `model`; the names of its initializers."""
    names = set()
    for number, value in fields(graph):
        match number, value:
            case 1, memoryview():
                model.nodes += 1
                model.external += _external_of_node(value)
            case 5, memoryview():
                name, size, external = _tensor(value)
                names.add(name)
                model.parameters += size
                model.external += [name] if external else []
            case 11, memoryview():
                model.inputs |= _tensor_type(value)
            case 12, memoryview():
                model.outputs |= _tensor_type(value)
            case 15, memoryview():
                model.external += _external_of_sparse(value)
    return names


def _external_of_node(node: memoryview) -> list[str]:
    """Names of external tensors in a NodeProto's attributes, at any depth."""
    found = []
    for attribute in _messages(node, 5):
        for number, value in fields(attribute):
            if number in (5, 10) and isinstance(value, memoryview):  # tensors
                name, _, external = _tensor(value)
                found += [name or "of a Constant"] if external else []
            elif number in (6, 11) and isinstance(value, memoryview):  # graphs
                inner = ModelFile()
                _graph(value, inner)
                found += inner.external
            elif number in (22, 23) and isinstance(value, memoryview):
                found += _external_of_sparse(value)
    return found


def _external_of_sparse(sparse: memoryview) -> list[str]:
    parts = [_tensor(value) for number in (1, 2) for value in _messages(sparse, number)]
    return [name or "of a sparse tensor" for name, _, external in parts if external]


def _tensor(tensor: memoryview) -> tuple[str, int, bool]:
    """Name, count of floating-point values, and whether they are external, of a TensorProto."""
    name, kind, external = "", 0, False
    dims: list[int] = []
    for number, value in fields(tensor):
        match number, value:
            case 1, int():
                dims.append(value)
            case 1, memoryview():
                dims += varints(value)
            case 2, int():
                kind = value
            case 8, memoryview():
                name = _text(value)
            case (13, _):
                external = True
            case 14, int():
                external = external or value == _EXTERNAL
    if len(dims) > MAX_TENSOR_AXES:
        raise ValueError(f"a tensor of {len(dims)} axes")
    return name, prod(dims) if kind in _FLOATS else 0, external


def _tensor_type(info: memoryview) -> dict[str, tuple[str, tuple[int | str, ...]]]:
    """A ValueInfoProto as {name: (element type, shape)}."""
    name, kind = "", "?"
    shape: list[int | str] = []
    for number, value in fields(info):
        if number == 1 and isinstance(value, memoryview):
            name = _text(value)
    for of_type in _messages(info, 2):
        for tensor in _messages(of_type, 1):
            for number, value in fields(tensor):
                if number == 1 and isinstance(value, int):
                    kind = KINDS.get(value, f"type {value}")
                elif number == 2 and isinstance(value, memoryview):
                    shape += map(_dimension, _messages(value, 1))
    return {name: (kind, tuple(shape))}


def _dimension(dimension: memoryview) -> int | str:
    for number, value in fields(dimension):
        if number == 1 and isinstance(value, int):
            return value
        if number == 2 and isinstance(value, memoryview):
            return _text(value) or "?"
    return "?"


def _opset(opset: memoryview) -> tuple[str, int]:
    domain, version = "", 0
    for number, value in fields(opset):
        if number == 1 and isinstance(value, memoryview):
            domain = _text(value)
        elif number == 2 and isinstance(value, int):
            version = value
    return "" if domain == "ai.onnx" else domain, version


def _entry(entry: memoryview) -> tuple[str, str]:
    """Key and value of a StringStringEntryProto."""
    texts = {n: _text(value) for n, value in fields(entry) if isinstance(value, memoryview)}
    return texts.get(1, ""), texts.get(2, "")


def _messages(message: memoryview, wanted: int) -> Iterator[memoryview]:
    for number, value in fields(message):
        if number == wanted and isinstance(value, memoryview):
            yield value


def _text(value: memoryview) -> str:
    return bytes(value).decode("utf-8", errors="replace")
