"""The lane map: centerlines and how they connect.

Everything is flat arrays, so that a tile file is this structure written out. Map frame, metres.
Axes: P points of all lanes, M lanes, S successor links.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import TileError

Float64 = NDArray[np.float64]

SPACING_M = 2.0
"""Distance between the points of a centerline, about."""
MAX_COORDINATE_M = 131_072.0
"""float32 resolves 8 mm out to here; a map farther from its origin is refused."""
MAX_SPEED_LIMIT_MPS = 1e3
SHORTEST_M = 0.01
"""A lane shorter than this leads nowhere."""
NO_LANE = -1
"""`left` or `right` where there is no neighbour."""

_LONGEST_M = 4.0 * MAX_COORDINATE_M
"""A line longer than this leads out of any map, and is not worth a point every `SPACING_M`."""
_LARGEST_ID = 2**63 - 1


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Lane:
    """One lane on its way into a `LaneMap`: references are source ids, known or not."""

    lane_id: int
    centerline: Float64
    """(n, 2) metres, map frame, in driving direction."""
    successors: Sequence[int] = ()
    left: int | None = None
    """Neighbour with the same direction."""
    right: int | None = None
    lane_type: LaneType = LaneType.UNKNOWN
    speed_limit_mps: float = math.nan


def build_lane_map(lanes: Iterable[Lane], where: str) -> LaneMap:
    """Flatten `lanes`, in their order; `where` names the source in errors.

    A lane id that comes again is dropped, and so are references to lanes that are not there.
    Raises TileError if no lane is left, or one has no length, lies too far from the origin, or has
    an id or a speed limit that none can have.
    """
    unique: dict[int, Lane] = {}
    for lane in lanes:
        _check(lane, where)
        unique.setdefault(lane.lane_id, lane)
    if not unique:
        raise TileError(f"{where}: no lanes for vehicles; choose a map with drivable lanes")
    index = {lane_id: i for i, lane_id in enumerate(unique)}
    kept = list(unique.values())
    successors = [[index[i] for i in dict.fromkeys(lane.successors) if i in index] for lane in kept]
    return LaneMap(
        points=np.concatenate([lane.centerline for lane in kept]).astype(np.float32),
        lane_start=_starts([len(lane.centerline) for lane in kept]),
        lane_id=np.array(list(unique), np.int64),
        successor_start=_starts([len(row) for row in successors]),
        successor=np.array([i for row in successors for i in row], np.int32),
        left=_neighbours([lane.left for lane in kept], index),
        right=_neighbours([lane.right for lane in kept], index),
        lane_type=np.array([lane.lane_type for lane in kept], np.uint8),
        speed_limit_mps=np.array([lane.speed_limit_mps for lane in kept], np.float32),
    )


def middle_line(left: Float64, right: Float64) -> Float64:
    """(n, 2) line halfway between two bounds (l, 2), (r, 2) that run the same way.

    Both bounds are walked at equal fractions of their length, about `SPACING_M` at a time.
    """
    length_m = (arclength(left)[-1] + arclength(right)[-1]) / 2.0
    fraction = _even_fractions(length_m)
    return (_at_fraction(left, fraction) + _at_fraction(right, fraction)) / 2.0


def evenly_spaced(line: Float64) -> Float64:
    """(n, 2) the polyline (m, 2) with a point about every `SPACING_M`, its ends kept."""
    return _at_fraction(line, _even_fractions(arclength(line)[-1]))


def arclength(line: Float64) -> Float64:
    """(n,) metres along a polyline (n, 2) from its first point."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])


def _even_fractions(length_m: float) -> Float64:
    """(n,) 0 to 1, about every `SPACING_M` of a length."""
    return np.linspace(0.0, 1.0, max(2, round(min(length_m, _LONGEST_M) / SPACING_M) + 1))


def _at_fraction(line: Float64, fraction: Float64) -> Float64:
    along = arclength(line)
    return np.stack([np.interp(fraction * along[-1], along, axis) for axis in line.T], axis=-1)


def _check(lane: Lane, where: str) -> None:
    if abs(lane.lane_id) > _LARGEST_ID:
        raise TileError(f"{where}: lane id {lane.lane_id} has more than 64 bits; renumber the map")
    if not np.abs(lane.centerline).max(initial=0.0) <= MAX_COORDINATE_M:
        raise TileError(
            f"{where}: lane {lane.lane_id} lies more than {MAX_COORDINATE_M / 1e3:.0f} km from "
            "the map's origin (or is not finite); choose an origin within the map, or shift x and "
            "y where the map itself states them"
        )
    if len(lane.centerline) < 2 or arclength(lane.centerline)[-1] < SHORTEST_M:
        raise TileError(f"{where}: lane {lane.lane_id} is shorter than 1 cm; repair the map")
    if lane.speed_limit_mps < 0.0 or lane.speed_limit_mps > MAX_SPEED_LIMIT_MPS:  # False for NaN
        raise TileError(
            f"{where}: lane {lane.lane_id} has a speed limit of {lane.speed_limit_mps:g} m/s, "
            f"expected 0 to {MAX_SPEED_LIMIT_MPS:g}; repair the map"
        )


def _starts(counts: Sequence[int]) -> NDArray[np.int32]:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def _neighbours(ids: Iterable[int | None], index: dict[int, int]) -> NDArray[np.int32]:
    return np.array([NO_LANE if i is None else index.get(i, NO_LANE) for i in ids], np.int32)
