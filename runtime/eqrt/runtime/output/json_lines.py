"""Forecasts as text, one JSON object per line and prediction, the same bytes for the same input."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.output.forecasts import ForecastSet, Mode

_MILLI, _SQUARE_CENTI, _MICRO = 1e3, 1e4, 1e6
_ENCODER = msgspec.json.Encoder()

Covariances = list[list[tuple[float, float, float]]] | None
"""(K, H, 3) xx, xy and yy in square metres, map axes; null = the trajectory is not the model's."""


class Line(msgspec.Struct):
    """The keys of a line, in their order. Metres and m/s in the map frame, seconds."""

    cycle: int
    time_s: float  # of the newest measurement of the cycle
    cycle_mode: str
    model_id: str
    tile_id: str  # "" = no map
    track_id: int
    object_id: int
    mode: str  # of this target
    anchor_s: float  # when the target was last measured: steps count from there
    age_s: float  # from then to the finished prediction
    dt_s: float
    position: list[float]  # at anchor_s
    velocity: list[float | None]  # null = not known
    probabilities: list[float]  # (K,) most probable mode first
    trajectories: list[list[list[float]]]  # (K, H, 2) at anchor_s + dt_s, + 2 dt_s ...
    covariances: Covariances | msgspec.UnsetType = msgspec.UNSET  # not of a model without


def json_lines(forecasts: ForecastSet) -> bytes:
    """A line per target, rounded to 1 mm, 1 mm/s, 1 us and a millionth; empty without targets.

    Covariances are rounded to 1 square centimetre.
    """
    cycle = (
        forecasts.cycle,
        round(forecasts.timestamp_s, 6),
        forecasts.mode.name,
        forecasts.model_id,
        forecasts.tile_id,
    )
    columns = zip(
        forecasts.track_id.tolist(),
        forecasts.object_id.tolist(),
        [Mode(mode).name for mode in forecasts.agent_mode.tolist()],
        _rounded(forecasts.anchor_s, _MICRO),
        _rounded(forecasts.age_s, _MICRO),
        [forecasts.dt_s] * forecasts.num_targets,
        _rounded(forecasts.position, _MILLI),
        _rounded(forecasts.velocity, _MILLI),
        _rounded(forecasts.probabilities, _MICRO),
        _rounded(forecasts.trajectories, _MILLI),
        _covariances(forecasts),
        strict=True,
    )
    return b"".join(_ENCODER.encode(Line(*cycle, *values)) + b"\n" for values in columns)


def _covariances(forecasts: ForecastSet) -> list[Any]:
    if forecasts.covariances is None:
        return [msgspec.UNSET] * forecasts.num_targets
    finite = np.isfinite(forecasts.covariances)
    known: list[bool] = np.all(finite, axis=(1, 2, 3, 4)).tolist()
    told = _rounded(forecasts.covariances[..., [0, 0, 1], [0, 1, 1]], _SQUARE_CENTI)
    return [values if is_known else None for values, is_known in zip(told, known, strict=True)]


def _rounded(values: NDArray[np.float64], steps_per_unit: float) -> list[Any]:
    """The nearest decimals, which print as such; minus zero becomes zero."""
    rounded: list[Any] = (np.rint(values * steps_per_unit) / steps_per_unit + 0.0).tolist()
    return rounded
