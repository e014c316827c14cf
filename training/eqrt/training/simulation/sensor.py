"""What a car with sensors all round sees of the traffic about it.

A vehicle is seen when it is in range and not hidden behind nearer ones: the horizon is cut into
narrow rays, and vehicles take theirs from the nearest outwards. Places are off by a white and a
slowly drifting part, as those of a tracker are, and now and then a step is missed.

Axes: A vehicles, S steps. Points are complex numbers x + iy, metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.training.simulation.drivers import STEP_S
from eqrt.training.simulation.traffic import Traffic

Complex = NDArray[np.complex128]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

_RAYS = 1440  # a quarter of a degree each; a car at 80 m covers about five
_GLIMPSE_STEPS = 5  # a tracker needs that many to believe in a vehicle


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """How well vehicles are seen. Standard deviations unless said otherwise."""

    radius_m: float = 100.0
    """How far it sees."""
    least_visible: float
    """Share of a vehicle's outline that must be in view; 0 = it is seen through others."""
    missed: float
    """Share of steps at which a vehicle in view is not reported."""
    jitter_m: float
    """Anew at every step."""
    drift_m: float
    """Slowly, over `_DRIFT_S`: which part of the vehicle is taken for its middle."""
    heading_rad: float


_DRIFT_S = 1.5

SENSORS = {
    "perfect": Sensor(least_visible=0.0, missed=0.0, jitter_m=0.0, drift_m=0.0, heading_rad=0.0),
    "good": Sensor(
        least_visible=0.25, missed=0.005, jitter_m=0.03, drift_m=0.08, heading_rad=0.015
    ),
    "poor": Sensor(least_visible=0.4, missed=0.03, jitter_m=0.12, drift_m=0.25, heading_rad=0.06),
}


@dataclass(frozen=True, slots=True)
class Sightings:
    """Everything seen from one vehicle over some steps."""

    rows: NDArray[np.intp]
    """(A,) rows of the `Traffic`, the observer's first."""
    centers: Complex
    """(A, S) as measured."""
    heading_rad: Float64
    """(A, S) as measured."""
    seen: Bool
    """(A, S)"""


def observe(
    traffic: Traffic,
    observer: int,
    steps: slice,
    sensor: Sensor,
    rng: np.random.Generator,
) -> Sightings:
    """What is seen from the vehicle `observer`, which knows its own place exactly.

    The observer must be present at all of the steps.
    """
    here = traffic.centers[observer, steps]
    near = traffic.present[:, steps] & (np.abs(traffic.centers[:, steps] - here) <= sensor.radius_m)
    others = np.flatnonzero(near.any(axis=1))
    rows = np.concatenate([[observer], others[others != observer]])
    centers, heading = traffic.centers[rows, steps], traffic.heading_rad[rows, steps]
    seen = near[rows]
    if sensor.least_visible > 0.0:
        boxes = _corners(centers, heading, traffic.length_m[rows], traffic.width_m[rows])
        for step in range(seen.shape[1]):
            share = _visible_share(boxes[:, step] - here[step], seen[:, step])
            seen[:, step] &= share >= sensor.least_visible
        seen = _without_glimpses(seen)
    seen &= rng.random(seen.shape) >= sensor.missed
    seen[0] = True
    error = sensor.jitter_m * _white(rng, seen.shape) + sensor.drift_m * _drift(rng, seen.shape)
    turned = sensor.heading_rad * rng.standard_normal(seen.shape)
    error[0], turned[0] = 0.0, 0.0
    return Sightings(rows, centers + error, heading + turned, seen)


def _corners(centers: Complex, heading: Float64, length_m: Float64, width_m: Float64) -> Complex:
    """(A, S, 4)"""
    ahead = np.exp(1j * heading)[..., None]
    along = np.array([1, 1, -1, -1]) * (length_m / 2.0)[:, None, None]
    across = np.array([1, -1, -1, 1]) * (width_m / 2.0)[:, None, None]
    corners: Complex = centers[..., None] + ahead * (along + 1j * across)
    return corners


def _visible_share(corners: Complex, candidates: Bool) -> Float64:
    """(A,) share of each outline (A, 4) about the observer, the first, that no nearer one hides."""
    share = np.ones(len(corners))
    middle = corners.mean(axis=1)
    bearing = np.angle(middle)
    spread = np.angle(corners * np.exp(-1j * bearing)[:, None])  # of the corners about the middle
    per_ray = math.tau / _RAYS
    first = np.floor((bearing + spread.min(axis=1)) / per_ray).astype(np.intp)
    last = np.ceil((bearing + spread.max(axis=1)) / per_ray).astype(np.intp)
    taken = np.zeros(_RAYS, np.bool_)
    for row in np.argsort(np.abs(middle), kind="stable"):
        if row != 0 and candidates[row]:  # one does not hide behind oneself
            rays = np.arange(first[row], last[row]) % _RAYS
            share[row] = 1.0 - taken[rays].mean()
            taken[rays] = True
    return share


def _without_glimpses(seen: Bool) -> Bool:
    """(A, S) less what is seen for fewer than `_GLIMPSE_STEPS` on end."""
    steps = min(_GLIMPSE_STEPS, seen.shape[1])
    begins = np.lib.stride_tricks.sliding_window_view(seen, steps, axis=1).all(axis=-1)
    steady = np.zeros_like(seen)
    for step in range(steps):
        steady[:, step : step + begins.shape[1]] |= begins
    return steady


def _white(rng: np.random.Generator, shape: tuple[int, ...]) -> Complex:
    """Independent, deviation 1 along each axis."""
    noise: Complex = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    return noise


def _drift(rng: np.random.Generator, shape: tuple[int, ...]) -> Complex:
    """Deviation 1 along each axis at every step, forgotten over `_DRIFT_S`."""
    keep = math.exp(-STEP_S / _DRIFT_S)
    drift = _white(rng, shape)
    for step in range(1, shape[1]):
        drift[:, step] = keep * drift[:, step - 1] + math.sqrt(1 - keep**2) * drift[:, step]
    return drift
