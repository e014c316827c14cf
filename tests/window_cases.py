"""Windows made by hand: one target on a straight or bent way, lanes beside it, nobody else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eqrt.training.dataset.windows import Windows

Float64 = NDArray[np.float64]

T, H, DT_S = 20, 30, 0.1
TIME_S = DT_S * (np.arange(T + H) - T + 1)
"""(T + H,) of every step; 0 is now."""


def window(
    path: Float64,
    lines: list[Float64] | None = None,
    heading: tuple[float, float] = (0.0, 0.0),
    num_agents: int = 2,
) -> Windows:
    """One window of a target on `path` (T + H, 2), with `lines` of (L, 2) each around it."""
    history = np.zeros((1, num_agents, T, 2), np.float32)
    history[0, 0] = path[:T]
    history_valid = np.zeros((1, num_agents, T), np.bool_)
    history_valid[0, 0] = True
    points = np.array(lines if lines else np.zeros((1, 2, 2)), np.float32)[None]
    return Windows(
        history=history,
        history_valid=history_valid,
        heading=np.array([heading], np.float32),
        centerlines=points,
        centerlines_valid=np.full(points.shape[:3], bool(lines)),
        future=np.asarray(path[T:], np.float32)[None],
        future_valid=np.ones((1, H), np.bool_),
        focal=np.array([True]),
        origin=np.zeros((1, 2)),
        recording=np.zeros(1, np.int32),
        agent=np.zeros(1, np.int32),
        step=np.full(1, T - 1, np.int32),
    )


def straight(speed_mps: float, y_m: float = 0.0) -> Float64:
    """(T + H, 2) along +x, at 0 now."""
    return np.stack([speed_mps * TIME_S, np.full(T + H, y_m)], axis=-1)


def bend(speed_mps: float, radius_m: float) -> Float64:
    """(T + H, 2) along +x until now, then on a circle: to the left for a positive radius."""
    angle = speed_mps * np.maximum(TIME_S, 0.0) / radius_m
    before = np.minimum(speed_mps * TIME_S, 0.0)
    return np.stack([before + radius_m * np.sin(angle), radius_m * (1.0 - np.cos(angle))], axis=-1)


def lane_change(speed_mps: float, shift_m: float, duration_s: float = 4.0) -> Float64:
    """(T + H, 2) along +x, sideways by `shift_m` (left) along a cosine that begins 0.5 s ago."""
    share = np.clip((TIME_S + 0.5) / duration_s, 0.0, 1.0)
    return np.stack([speed_mps * TIME_S, 0.5 * shift_m * (1.0 - np.cos(np.pi * share))], axis=-1)


def lane(y_m: float, backwards: bool = False) -> Float64:
    """(L, 2) a straight line along +x, from 20 m behind to 100 m ahead."""
    x = np.linspace(-20.0, 100.0, 25)
    return np.stack([x[::-1] if backwards else x, np.full(25, y_m)], axis=-1)
