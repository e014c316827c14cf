"""Forecasts as bytes and back, without losing a bit.

One msgpack map with the fields of `ForecastSet`; an array is [type, shape, bytes], its type as
numpy writes it (`<f8`), row by row. Datagrams carry float32, which is enough to look at; a
recording must tell whether a replay came out the same.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import msgspec
import numpy as np

from eqrt.core.errors import in_one_line
from eqrt.core.frames import Pose2
from eqrt.runtime.output.forecasts import ForecastSet, Mode

_NAMES = tuple(field.name for field in fields(ForecastSet))
_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(dict[str, Any])
_TYPES = frozenset({"<f8", "<f4", "<i8", "|u1", "|b1"})
_MAX_DIMENSIONS = 5


def encode_forecasts(forecasts: ForecastSet) -> bytes:
    """The bytes of one cycle."""
    return _ENCODER.encode({name: _plain(getattr(forecasts, name)) for name in _NAMES})


def decode_forecasts(payload: bytes) -> ForecastSet:
    """The cycle in the bytes; ValueError if they are not what `encode_forecasts` writes."""
    try:
        plain = _DECODER.decode(payload)
        values: dict[str, Any] = {
            name: _array(*v) if _is_array(v) else v for name, v in plain.items()
        }
        values["mode"] = Mode(values["mode"])
        values["map_from_ego"] = Pose2(*plain["map_from_ego"])
        return ForecastSet(**values)
    except (msgspec.MsgspecError, KeyError, TypeError) as error:
        raise ValueError(
            f"not the forecasts of this version of eqrt ({in_one_line(error)})"
        ) from error


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if isinstance(value, Pose2):
        return (value.x_m, value.y_m, value.yaw_rad)
    return int(value) if isinstance(value, Mode) else value


def _is_array(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and isinstance(value[0], str)


def _array(kind: str, shape: list[int], content: bytes) -> np.ndarray[Any, Any]:
    if kind not in _TYPES or len(shape) > _MAX_DIMENSIONS:
        raise ValueError(f"not the forecasts of this version of eqrt (array {kind!r}, {shape})")
    return np.frombuffer(content, kind).reshape(shape)
