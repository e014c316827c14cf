"""Single lanes as centerlines, the nearest first: the choice that the papers describe.

Each of the Q nearest lanes (within 30 m) is one line: its whole length, or REACH_M to either side
of the target where it is longer, as L evenly spaced points. Nothing is followed into the next lane;
`eqrt.core.routes` does that.

Axes: A targets, Q centerlines, L points. Metres, map frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eqrt.core.lane_grid import LaneGrid
from eqrt.core.lane_lines import LaneLines, from_complex, to_complex
from eqrt.core.lanes import LaneMap

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

REACH_M = 50.0


class NearestLanes:
    """Finds the nearest lanes on one lane map."""

    def __init__(self, lane_map: LaneMap) -> None:
        self._lines = LaneLines(lane_map)
        self._grid = LaneGrid(self._lines, np.diff(lane_map.successor_start) > 0)

    def centerlines_batch(
        self,
        positions: Float64,
        directions: Float64,  # noqa: ARG002 (the protocol's: the nearest lane may run any way)
        num_centerlines: int,
        centerline_points: int,
    ) -> tuple[Float64, Bool]:
        """Positions (A, 2) -> points (A, Q, L, 2), and valid (A, Q, L): whole lines or none.

        Of lanes equally near (to a centimetre) the one first in the map comes first.
        """
        near = self._grid.near(to_complex(positions))
        order = np.lexsort((near.lane, np.round(near.distance_m, 2), near.place))
        place = near.place[order]
        rank = np.arange(len(order)) - np.searchsorted(place, place)  # within its target
        order, place, rank = (a[rank < num_centerlines] for a in (order, place, rank))
        lane, here = near.lane[order], near.along_m[order]
        first = np.maximum(here - REACH_M, 0.0)
        last = np.minimum(here + REACH_M, self._lines.length_m[lane])
        share = np.linspace(0.0, 1.0, centerline_points)
        along = first[:, None] + share * (last - first)[:, None]  # (C, L)
        points = np.zeros((len(positions), num_centerlines, centerline_points), np.complex128)
        valid = np.zeros(points.shape, np.bool_)
        points[place, rank] = self._lines.at(np.broadcast_to(lane[:, None], along.shape), along)
        valid[place, rank] = True
        return from_complex(points), valid
