"""Which lanes are near a place, and where along them.

The points of every lane are cut into runs, the stretches that stay within one cell of a square
grid. Runs lie sorted by cell, row after row, so that the cells around a place are a few slices.
Built in one pass over the points; nothing of it is stored.

Places and points are complex numbers x + iy. Axes: A places, C (place, lane) pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.lane_lines import Complex, Float64, Index, LaneLines

CELL_M = 20.0
RADIUS_M = 30.0
"""How far a lane may be away."""
_ROWS = int(2 * RADIUS_M // CELL_M) + 1  # rows of cells that the circle can touch
_FAR_M = 1e9  # stands for places that are not finite: near nothing


@dataclass(frozen=True, slots=True)
class NearLanes:
    """Nearest points of the lanes within `RADIUS_M`, by place and then by lane.

    A lane that ended behind the place is left out if it goes on: its successors are as near.
    """

    place: Index
    """(C,) index of the place."""
    lane: Index
    """(C,) lane index."""
    distance_m: Float64
    """(C,)"""
    along_m: Float64
    """(C,) from the lane's first point to the nearest point."""
    direction: Complex
    """(C,) unit vector of the lane there."""


class LaneGrid:
    """Finds lanes by place."""

    def __init__(self, lines: LaneLines, goes_on: NDArray[np.bool_]) -> None:
        """`goes_on` (M,) says which lanes have successors."""
        self._lines = lines
        self._goes_on = goes_on
        self._corner = complex(lines.points.real.min(), lines.points.imag.min())
        column, row = _cells(lines.points - self._corner)
        self._columns = int(column.max()) + 1
        cell = (row * self._columns + column).astype(np.int64)
        first = np.flatnonzero(np.diff(cell, prepend=-1) | np.diff(lines.lane, prepend=-1))
        count = np.diff(first, append=len(cell))
        order = np.argsort(cell[first], kind="stable")
        self._cell = cell[first][order]
        self._lane = lines.lane[first][order]
        self._first = first[order]
        self._count = count[order]
        middle = (lines.points[first] + lines.points[first + count - 1]) / 2.0
        reach = np.maximum.reduceat(np.abs(lines.points - np.repeat(middle, count)), first)
        self._middle = middle[order]
        """Of the circle around each run."""
        self._reach = reach[order] + RADIUS_M

    def near(self, places: Complex) -> NearLanes:
        """Nearest points of the lanes around each of `places` (A,), map frame, metres."""
        places = np.where(np.abs(places) < _FAR_M, places, _FAR_M)  # also for NaN
        place, run = self._runs(places)
        seen_from = places[place]
        return self._project(place, seen_from, self._lane[run], self._nearest(seen_from, run))

    def _runs(self, places: Complex) -> tuple[Index, Index]:
        """The place and the run, for every run that may come within reach of a place."""
        left, low = _cells(places - self._corner - complex(RADIUS_M, RADIUS_M))
        right, _ = _cells(places - self._corner + RADIUS_M)
        row = (low[:, None] + np.arange(_ROWS)) * self._columns  # (A, rows)
        begin = np.searchsorted(self._cell, row + np.maximum(left, 0.0)[:, None])
        until = row + np.minimum(right, self._columns - 1.0)[:, None]
        count = np.searchsorted(self._cell, until, side="right") - begin
        count = np.maximum(count, 0)  # below zero beside the map
        run = ranges(begin.ravel(), count.ravel())
        place = np.repeat(np.arange(len(places)), count.sum(axis=1))
        kept = np.abs(places[place] - self._middle[run]) <= self._reach[run]
        return place[kept], run[kept]

    def _nearest(self, places: Complex, run: Index) -> Index:
        """(C,) index of each run's point nearest to its place (C,)."""
        count = self._count[run]
        point = ranges(self._first[run], count)
        away = self._lines.points[point] - np.repeat(places, count)
        return point[_least(away.real**2 + away.imag**2, np.cumsum(count) - count)]

    def _project(self, place: Index, places: Complex, lane: Index, point: Index) -> NearLanes:
        """Nearest place on the two segments at each of the points (C,)."""
        lines = self._lines
        first, last = lines.start[lane], lines.start[lane + 1] - 2
        segment = np.stack([np.maximum(point - 1, first), np.minimum(point, last)])  # (2, C)
        # Turned so that the segment lies along the real axis.
        foot = (places - lines.points[segment]) * lines.direction[segment].conj()
        length = lines.segment_m[segment]
        beyond = foot.real - np.clip(foot.real, 0.0, length)
        distance = np.hypot(beyond, foot.imag)
        side = (distance[1] < distance[0]).astype(np.int64)
        distance = np.minimum(distance[0], distance[1])
        near = np.flatnonzero(distance <= RADIUS_M)
        pair = place[near] * len(lines.length_m) + lane[near]
        near = near[least_of_each(pair, distance[near])]
        pick = (side[near], near)
        past_end = (beyond[pick] > 0.0) & (segment[pick] == last[near])
        near = near[~(past_end & self._goes_on[lane[near]])]
        pick = (side[near], near)
        return NearLanes(
            place=place[near],
            lane=lane[near],
            distance_m=distance[near],
            along_m=lines.along_m[segment[pick]] + foot.real[pick] - beyond[pick],
            direction=lines.direction[segment[pick]],
        )


def ranges(begin: Index, count: Index) -> Index:
    """Indices begin[i], begin[i] + 1, ... (count[i] of them), one range after the other."""
    end = np.cumsum(count)
    return np.arange(end[-1] if len(end) else 0) + np.repeat(begin - end + count, count)


def least_of_each(group: Index, metres: Float64) -> Index:
    """Index of the least of each group, by rising group; of equal ones, the first."""
    order = np.argsort(group, kind="stable")
    sorted_ = group[order]
    begins = np.ones(len(group), np.bool_)
    np.not_equal(sorted_[1:], sorted_[:-1], out=begins[1:])
    return order[_least(metres[order], np.flatnonzero(begins))]


def _least(values: Float64, start: Index) -> Index:
    """Index of the first least value of each stretch; stretches begin at `start`."""
    if not len(start):
        return start
    least = np.minimum.reduceat(values, start)
    count = np.empty_like(start)
    np.subtract(start[1:], start[:-1], out=count[:-1])
    count[-1] = len(values) - start[-1]
    hit = np.flatnonzero(values == np.repeat(least, count))
    return hit[np.searchsorted(hit, start)]


def _cells(places: Complex) -> tuple[Float64, Float64]:
    """Column and row of each place, relative to the grid's corner."""
    return np.floor(places.real / CELL_M), np.floor(places.imag / CELL_M)
