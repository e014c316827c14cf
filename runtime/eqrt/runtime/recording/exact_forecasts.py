"""Forecasts as bytes and back, without losing a bit.

One msgpack map with the fields of `ForecastSet`; an array is [type, shape, bytes], its type as
numpy writes it (`<f8`), row by row. Datagrams carry float32, which is enough to look at; a
recording must tell whether a replay came out the same.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from eqrt.core.errors import in_one_line
from eqrt.runtime.output.forecasts import ForecastSet, Mode, pose_numbers, pose_of

_NAMES = tuple(field.name for field in fields(ForecastSet))
_TYPES = frozenset({"<f8", "<f4", "<i8", "|u1", "|b1"})
_Size = Annotated[int, Meta(ge=0, le=1 << 24)]
_Array = tuple[str, tuple[_Size, ...], bytes]


class _Wire(msgspec.Struct):
    """The map: keys as in ForecastSet."""

    cycle: int
    timestamp_s: float
    made_s: float
    compute_s: float
    mode: int
    model_id: str
    tile_id: str
    map_from_ego: tuple[float, float, float]
    """x m, y m, yaw rad; NaN = not known"""
    ego_speed_mps: float
    dt_s: float
    track_id: _Array
    object_id: _Array
    anchor_s: _Array
    agent_mode: _Array
    position: _Array
    velocity: _Array
    heading_rad: _Array
    object_class: _Array
    length_m: _Array
    width_m: _Array
    history: _Array
    history_valid: _Array
    trajectories: _Array
    probabilities: _Array
    covariances: _Array | None = None
    received_s: float = math.nan
    """Older recordings do not tell."""


MAX_VALUE = 1e12
"""No id, no metre and no second is further away; NaN = not known."""
_AXES: dict[str, tuple[str | int, ...]] = {
    **dict.fromkeys(("track_id", "object_id", "anchor_s", "agent_mode", "heading_rad"), ("A",)),
    **dict.fromkeys(("object_class", "length_m", "width_m"), ("A",)),
    **dict.fromkeys(("position", "velocity"), ("A", 2)),
    "history": ("A", "T", 2),
    "history_valid": ("A", "T"),
    "trajectories": ("A", "K", "H", 2),
    "probabilities": ("A", "K"),
    "covariances": ("A", "K", "H", 2, 2),
}
"""A letter is the same size everywhere."""
_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(_Wire)


def encode_forecasts(forecasts: ForecastSet) -> bytes:
    """The bytes of one cycle."""
    plain = {name: _plain(getattr(forecasts, name)) for name in _NAMES}
    return _ENCODER.encode(plain | {"map_from_ego": pose_numbers(forecasts.map_from_ego)})


def decode_forecasts(payload: bytes) -> ForecastSet:
    """The cycle in the bytes; ValueError if they are not what `encode_forecasts` writes."""
    try:
        wire = _DECODER.decode(payload)
        values: dict[str, Any] = {name: getattr(wire, name) for name in _NAMES}
        values |= {name: _array(*values[name]) for name in _AXES if values[name] is not None}
        values["mode"] = Mode(wire.mode)
        values["map_from_ego"] = pose_of(wire.map_from_ego)
        _check(values)
        return ForecastSet(**values)
    except (msgspec.MsgspecError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(
            f"not the forecasts of this version of eqrt ({in_one_line(error)})"
        ) from error


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    return int(value) if isinstance(value, Mode) else value


def _array(kind: str, shape: tuple[int, ...], content: bytes) -> np.ndarray[Any, Any]:
    if kind not in _TYPES:
        raise ValueError(f"array of {kind!r}")
    return np.frombuffer(content, kind).reshape(shape)


def _check(values: dict[str, Any]) -> None:
    """Raises ValueError if the arrays do not belong together, or a target's mode is unknown."""
    sizes: dict[str, int] = {}
    for name in _AXES:
        if values[name] is not None and (np.abs(values[name]) > MAX_VALUE).any():
            raise ValueError(f"{name} of more than {MAX_VALUE:g}")
    for name, axes in _AXES.items():
        if values[name] is None:
            continue
        shape = values[name].shape
        expected = tuple(
            a if isinstance(a, int) else sizes.setdefault(a, n)
            for a, n in zip(axes, shape, strict=True)
        )
        if shape != expected:
            raise ValueError(f"{name} of shape {shape}")
    if not np.isin(values["agent_mode"], list(Mode)).all():
        raise ValueError("a mode of a target")
