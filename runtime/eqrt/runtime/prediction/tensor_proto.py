"""Reads ONNX `TensorProto` files (test vectors) without the onnx package.

Only what test vectors use: dims (field 1), data_type (2) and raw_data (9) of the protocol buffer
message in the ONNX specification (onnx/onnx.proto), float32 and bool.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import ContractError
from eqrt.core.files import read_at_most
from eqrt.runtime.prediction.artifact_limits import MAX_TENSOR_AXES, MAX_TENSOR_BYTES
from eqrt.runtime.prediction.protobuf import fields, varints

_DIMS, _DATA_TYPE, _RAW_DATA = 1, 2, 9
_DTYPES = {1: np.dtype("<f4"), 9: np.dtype(np.bool_)}  # TensorProto.DataType FLOAT and BOOL


def read_tensor(path: Path) -> NDArray[Any]:
    """The array in a `.pb` file. Raises ContractError if it is missing or not such a tensor."""
    try:
        return parse_tensor(read_at_most(MAX_TENSOR_BYTES, path))
    except OSError as error:
        raise ContractError(f"{path}: {error.strerror}; export the model again") from error
    except (ValueError, KeyError, IndexError) as error:
        raise ContractError(f"{path}: not a float32 or bool tensor ({error})") from error


def parse_tensor(content: bytes) -> NDArray[Any]:
    """The array in a serialised TensorProto; ValueError, KeyError or IndexError if it is none."""
    dims: list[int] = []
    data_type, raw = 0, memoryview(b"")
    for field, value in fields(content):
        if field == _DIMS:
            dims += [value] if isinstance(value, int) else list(varints(value))
        elif field == _DATA_TYPE and isinstance(value, int):
            data_type = value
        elif field == _RAW_DATA and isinstance(value, memoryview):
            raw = value
    if len(dims) > MAX_TENSOR_AXES:
        raise ValueError(f"a tensor of {len(dims)} axes")
    if any(size > len(raw) for size in dims):
        raise ValueError(f"{len(raw)} bytes for the shape {dims}")
    return np.frombuffer(raw, _DTYPES[data_type]).reshape(dims)
