"""Centerlines as lines: arclength along every lane, and points in between.

Points are complex numbers x + iy, so that one product turns them and one difference moves them.
All lanes lie on one long axis, one metre apart, so that one sorted search answers for many lanes at
once. Float64, map frame, metres. Axes: P points of all lanes, M lanes.

A segment without length would lie at no distance from anything. So a point that comes twice in a
row is taken once; what is left of a lane that is but one point leads east.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eqrt.core.lanes import LaneMap

Float64 = NDArray[np.float64]
Complex = NDArray[np.complex128]
Index = NDArray[np.int64]

_SAME_M = 1e-6
"""Two points of a lane that are nearer to each other are one."""


class LaneLines:
    """The centerlines of a lane map, ready to be measured along."""

    def __init__(self, lane_map: LaneMap) -> None:
        points = to_complex(lane_map.points.astype(np.float64))
        kept = _distinct(points, lane_map.lane_start)
        self.points = points[kept]  # (P,)
        self.start = np.append(0, np.cumsum(kept))[lane_map.lane_start]
        """(M + 1,) lane m owns points start[m]:start[m + 1]."""
        count = np.diff(self.start)
        self.lane = np.repeat(np.arange(len(count)), count)
        """(P,) the lane of each point."""
        step = np.diff(self.points, append=0.0)
        self.segment_m = np.abs(step)
        """(P,) length of the segment that begins at each point; meaningless at a lane's last."""
        self.direction = step / np.maximum(self.segment_m, 1e-9)
        """(P,) unit vector of that segment."""
        no_length = self.segment_m < _SAME_M
        no_length[self.start[1:] - 1] = False
        self.direction[no_length] = 1.0
        on_axis = self.segment_m.copy()
        on_axis[self.start[1:] - 1] = 1.0  # m, between two lanes
        self._axis = np.cumsum(on_axis) - on_axis
        self._origin = self._axis[self.start[:-1]]
        self.along_m = self._axis - self._origin[self.lane]
        """(P,) arclength from the lane's first point."""
        self.length_m = self.along_m[self.start[1:] - 1]
        """(M,)"""

    def at(self, lane: Index, along_m: Float64) -> Complex:
        """Points (...) at arclengths (...) of lanes (...); beyond an end, that end."""
        axis = self._origin[lane] + np.clip(along_m, 0.0, self.length_m[lane])
        point = np.searchsorted(self._axis, axis, side="right") - 1
        points: Complex = self.points[point] + (axis - self._axis[point]) * self.direction[point]
        return points


def _distinct(points: Complex, start: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(P,) whether a point is another than the one before it; two of each lane always are."""
    distinct = np.abs(np.diff(points, prepend=points[:1])) >= _SAME_M
    distinct[start[:-1]] = True
    distinct[start[1:] - 1] |= np.add.reduceat(distinct, start[:-1], dtype=np.int64) < 2
    return distinct


def to_complex(points: Float64) -> Complex:
    """(...) x + iy from (..., 2)."""
    return np.ascontiguousarray(points, np.float64).view(np.complex128)[..., 0]


def from_complex(points: Complex) -> Float64:
    """(..., 2) from (...)."""
    return np.ascontiguousarray(points)[..., None].view(np.float64)
