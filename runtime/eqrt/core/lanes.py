"""The lane map: centerlines, how they connect, and a grid to find them by place.

Everything is flat arrays, so that a tile file is this structure written out. Map frame, metres.
Axes: P points of all lanes, M lanes, S successor links, G grid cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

NO_LANE = -1
"""`left` or `right` where there is no neighbour."""


class LaneType(IntEnum):
    """What a lane is for."""

    UNKNOWN = 0
    URBAN = 1
    HIGHWAY = 2
    RAMP = 3
    BICYCLE = 4
    PEDESTRIAN = 5
    BUS = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneMap:
    """Lane centerlines in driving direction, about 2 m between points."""

    points: NDArray[np.float32]
    """(P, 2) metres, map frame, lane after lane in driving direction."""
    lane_start: NDArray[np.int32]
    """(M + 1,) lane m owns points lane_start[m]:lane_start[m + 1], at least 2."""
    lane_id: NDArray[np.int64]
    """(M,) the id in the source map, unique."""
    successor_start: NDArray[np.int32]
    """(M + 1,) lane m's successors are successor[successor_start[m]:successor_start[m + 1]]."""
    successor: NDArray[np.int32]
    """(S,) lane indices."""
    left: NDArray[np.int32]
    """(M,) lane index of the neighbour on the left with the same direction, or NO_LANE."""
    right: NDArray[np.int32]
    """(M,) likewise on the right."""
    lane_type: NDArray[np.uint8]
    """(M,) `LaneType`."""
    speed_limit_mps: NDArray[np.float32]
    """(M,) NaN = not known."""

    @property
    def num_lanes(self) -> int:
        """M."""
        return len(self.lane_id)

    def lane_points(self, lane: int) -> NDArray[np.float32]:
        """(n, 2) centerline of one lane, map frame."""
        return self.points[self.lane_start[lane] : self.lane_start[lane + 1]]

    def successors_of(self, lane: int) -> NDArray[np.int32]:
        """Lane indices that follow `lane`."""
        return self.successor[self.successor_start[lane] : self.successor_start[lane + 1]]
