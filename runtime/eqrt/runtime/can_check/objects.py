"""All objects of one sensor in a log as arrays, in the order of its tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.can_check.plain import bounded
from eqrt.runtime.can_check.report import Values
from eqrt.runtime.decoding.detections import Detections, ObjectClass, VelocityKind

Float64 = NDArray[np.float64]

_GAP_S = 0.3  # s: the tracker, too, takes an id that was away for longer for another object
_CYCLES = 3.0  # of a slow sensor, so many missed cycles instead


@dataclass(frozen=True, slots=True, kw_only=True)
class Objects:
    """M measurements of objects, those of one track after the other. Sensor frame."""

    kind: VelocityKind
    cycle: NDArray[np.int64]
    """(M,) which of the sensor's cycles."""
    time_s: Float64
    """(M,)"""
    object_id: NDArray[np.int64]
    """(M,)"""
    track: NDArray[np.int64]
    """(M,) numbered from 0; an id that is new, or was away, begins another one."""
    position: Float64
    """(M, 2) metres."""
    velocity: Float64
    """(M, 2) m/s, as `kind` says."""
    heading_rad: Float64
    """(M,)"""
    length_m: Float64
    """(M,)"""
    width_m: Float64
    """(M,)"""
    existence: Float64
    """(M,)"""
    object_class: NDArray[np.uint8]
    """(M,)"""

    @property
    def range_m(self) -> Float64:
        """(M,) distance from the sensor."""
        return np.hypot(self.position[:, 0], self.position[:, 1])

    @property
    def line_of_sight(self) -> Float64:
        """(M, 2) unit vectors towards the objects."""
        return self.position / np.maximum(self.range_m, 1e-6)[:, None]

    @property
    def goes_on(self) -> NDArray[np.bool_]:
        """(M - 1,) whether measurement i + 1 is the next of the same track."""
        same: NDArray[np.bool_] = np.diff(self.track) == 0
        return same


def gather(cycles: Sequence[Detections], kind: VelocityKind) -> Objects:
    """The objects of one sensor's cycles."""
    counts = [len(one.object_id) for one in cycles]
    cycle = np.repeat(np.arange(len(cycles)), counts)
    cycle_s = np.array([one.timestamp_s for one in cycles])
    time_s = np.repeat(cycle_s, counts)
    object_id = _joined([one.object_id for one in cycles], np.int64)
    order = np.lexsort((time_s, object_id))
    cycle, time_s, object_id = cycle[order], time_s[order], object_id[order]
    is_new = _joined([one.is_new for one in cycles], np.bool_)[order]
    begins = np.diff(object_id) != 0
    begins |= is_new[1:] | (np.diff(time_s) > _longest_gap_s(cycle_s))
    return Objects(
        kind=kind,
        cycle=cycle,
        time_s=time_s,
        object_id=object_id,
        track=np.cumsum(np.concatenate([[False], begins]))[: len(order)],
        position=_measured([one.position for one in cycles], 2)[order],
        velocity=_measured([one.velocity for one in cycles], 2)[order],
        heading_rad=_measured([one.heading_rad for one in cycles])[order],
        length_m=_measured([one.length_m for one in cycles])[order],
        width_m=_measured([one.width_m for one in cycles])[order],
        existence=_measured([one.existence for one in cycles])[order],
        object_class=_joined([one.object_class for one in cycles], np.uint8)[order],
    )


def _measured(arrays: Sequence[Float64], width: int = 0) -> Float64:
    return bounded(_joined(arrays, np.float64, width))


def _joined(arrays: Sequence[NDArray[Any]], dtype: type, width: int = 0) -> NDArray[Any]:
    empty: NDArray[Any] = np.empty((0, width) if width else 0, dtype)
    return np.concatenate([empty, *arrays])


def _longest_gap_s(cycle_s: Float64) -> float:
    return max(_GAP_S, _CYCLES * float(np.median(np.diff(cycle_s)))) if len(cycle_s) > 1 else _GAP_S


def object_values(objects: Objects) -> tuple[Values, ...]:
    """How everything that the sensor says is distributed."""
    x, y = objects.position.T
    velocity_x, velocity_y = objects.velocity.T
    rows = [
        values("x", "m", x),
        values("y", "m", y),
        values("range", "m", objects.range_m),
        values("bearing", "deg", np.degrees(np.arctan2(y, x))),
    ]
    if objects.kind is VelocityKind.RADIAL:
        rows.append(values("range_rate", "m/s", along_sight(objects)))
    elif objects.kind is not VelocityKind.NONE:
        rows.append(values("velocity_x", "m/s", velocity_x))
        rows.append(values("velocity_y", "m/s", velocity_y))
    rows += [
        values("heading", "deg", np.degrees(objects.heading_rad)),
        values("length", "m", objects.length_m),
        values("width", "m", objects.width_m),
        values("existence", "", objects.existence),
    ]
    return tuple(rows)


def along_sight(objects: Objects) -> Float64:
    """(M,) the part of the velocity along the line of sight, m/s; away from the sensor positive."""
    rate: Float64 = (objects.velocity * objects.line_of_sight).sum(axis=1)
    return rate


def classes(objects: Objects) -> dict[str, int]:
    """How many measurements of each class there are."""
    numbers, counts = np.unique(objects.object_class, return_counts=True)
    return {
        ObjectClass(int(number)).name.lower(): int(count)
        for number, count in zip(numbers, counts, strict=True)
    }


def values(name: str, unit: str, numbers: Float64) -> Values:
    """How `numbers` (n,) are distributed; what is not finite is not known."""
    known = numbers[np.isfinite(numbers)]
    quantiles = [None] * 5
    if len(known):
        quantiles = np.quantile(known, (0.0, 0.05, 0.5, 0.95, 1.0)).tolist()
    low, p5, median, p95, high = quantiles
    return Values(
        name=name,
        unit=unit,
        count=len(numbers),
        missing=1.0 - len(known) / len(numbers) if len(numbers) else 1.0,
        low=low,
        p5=p5,
        median=median,
        p95=p95,
        high=high,
    )
