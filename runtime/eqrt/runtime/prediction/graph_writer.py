"""Writes small ONNX graphs byte by byte, without the onnx package.

Of the messages in the ONNX specification (onnx/onnx.proto) as much as a benchmark's own graphs and
handmade models need.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from eqrt.runtime.prediction.protobuf import nested, number, text

_KINDS = {"float32": 1, "int64": 7, "bool": 9}  # TensorProto.DataType

Node = tuple[str, Sequence[str], str, Mapping[str, int]]
"""Operator, inputs, output, whole-number attributes."""
Specs = Mapping[str, tuple[str, Sequence[int | str]]]
"""Tensor -> element type and shape; a size that is not fixed is its name."""


def write_model(
    nodes: Iterable[Node],
    constants: Mapping[str, NDArray[Any]],
    inputs: Specs,
    outputs: Specs,
    *,
    opset: int = 18,
    ir_version: int = 8,
) -> bytes:
    """A ModelProto of one graph."""
    graph = b"".join(nested(1, _node(*node)) for node in nodes) + text(2, "graph")
    graph += b"".join(nested(5, tensor(name, values)) for name, values in constants.items())
    for field, specs in ((11, inputs), (12, outputs)):
        for name, (kind, shape) in specs.items():
            graph += nested(field, _value_info(name, kind, shape))
    return number(1, ir_version) + nested(7, graph) + nested(8, number(2, opset))


def tensor(name: str, values: NDArray[Any]) -> bytes:
    """A TensorProto."""
    dims = b"".join(number(1, size) for size in values.shape)
    kind = number(2, _KINDS[values.dtype.name])
    return dims + kind + text(8, name) + nested(9, values.tobytes())


def _node(
    operator: str, inputs: Sequence[str], output: str, attributes: Mapping[str, int]
) -> bytes:
    parts = [text(1, name) for name in inputs] + [text(2, output), text(4, operator)]
    for name, value in attributes.items():
        parts.append(nested(5, text(1, name) + number(3, value) + number(20, 2)))
    return b"".join(parts)


def _value_info(name: str, kind: str, shape: Sequence[int | str]) -> bytes:
    dims = b"".join(
        nested(1, number(1, size) if isinstance(size, int) else text(2, size)) for size in shape
    )
    of_type = nested(1, number(1, _KINDS[kind]) + nested(2, dims))
    return text(1, name) + nested(2, of_type)
