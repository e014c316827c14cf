"""The routes that a vehicle on a lane can take.

A route is a chain of lanes: `BEHIND_M` back from the lane's first point, then on until `AHEAD_M`
past its last point, so that it serves a vehicle anywhere on the lane. Where lanes branch, the
straightest way comes first and the others after it, the earliest branch first: however few routes
are wanted, they differ where it matters soonest. Routes are found when first asked for.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

from eqrt.core.lane_lines import Complex, LaneLines
from eqrt.core.lanes import LaneMap

BEHIND_M = 10.0
AHEAD_M = 90.0
MAX_ROUTES = 16  # per lane; more than a model has room for
_MAX_LEGS = 128  # per route; ends the search in maps of endless tiny loops
_MAX_CACHED = 1024  # lanes, about 10 kB each
_LOOK_M = 30.0  # how far into a lane its turn is judged


@dataclass(frozen=True, slots=True)
class Route:
    """A chain of lanes. Distances run along it, 0 at the first point of the lane asked for."""

    lanes: tuple[int, ...]
    """Lane index of each leg."""
    starts_m: tuple[float, ...]
    """Where each leg begins; negative behind."""
    end_m: float
    """Where the last leg ends."""
    branch_m: float
    """Where it leaves the routes before it in the list; minus infinity for the first."""


class LaneGraph:
    """Lane lengths, turns and connections, and the routes through them."""

    def __init__(self, lane_map: LaneMap, lines: LaneLines) -> None:
        self.successors = [lane_map.successors_of(i).tolist() for i in range(lane_map.num_lanes)]
        self.predecessors: list[list[int]] = [[] for _ in self.successors]
        for before, successors in enumerate(self.successors):
            for successor in successors:
                self.predecessors[successor].append(before)
        self.length_m: list[float] = lines.length_m.tolist()
        lane = np.arange(lane_map.num_lanes)
        first, last = lines.start[:-1], lines.start[1:] - 1
        look_m = np.minimum(_LOOK_M, lines.length_m)
        begin, end = lines.points[first], lines.points[last]
        self._start_rad = _angle(lines.direction[first])
        self._end_rad = _angle(lines.direction[last - 1])
        self._into_rad = _angle(lines.at(lane, look_m) - begin)
        self._out_rad = _angle(end - lines.at(lane, lines.length_m - look_m))
        self._routes: dict[int, list[Route]] = {}

    def routes(self, lane: int) -> list[Route]:
        """Routes through `lane`, at least one and at most `MAX_ROUTES`."""
        found = self._routes.get(lane)
        if found is None:
            if len(self._routes) >= _MAX_CACHED:
                del self._routes[next(iter(self._routes))]  # the oldest
            found = self._routes[lane] = self._find(lane)
        return found

    def _find(self, lane: int) -> list[Route]:
        behind_lanes, behind_starts = self._behind(lane)
        enough_m = self.length_m[lane] + AHEAD_M
        routes: list[Route] = []
        # Branches not yet followed: where, how sharp, then the lane (ties); the way up to there.
        branches = [(-math.inf, 0.0, lane, behind_lanes, behind_starts, 0.0)]
        while branches and len(routes) < MAX_ROUTES:
            branch_m, _, leg, lanes, starts, end_m = heapq.heappop(branches)
            lanes, starts = [*lanes, leg], [*starts, end_m]
            end_m += self.length_m[leg]
            while end_m < enough_m and len(lanes) < _MAX_LEGS and self.successors[leg]:
                (_, straight), *others = self._by_turn(leg)
                for turn, other in others:
                    branch = (round(end_m, 2), turn, other, lanes.copy(), starts.copy(), end_m)
                    heapq.heappush(branches, branch)
                leg = straight
                lanes.append(leg)
                starts.append(end_m)
                end_m += self.length_m[leg]
            routes.append(Route(tuple(lanes), tuple(starts), end_m, branch_m))
        return routes

    def _behind(self, lane: int) -> tuple[list[int], list[float]]:
        """Legs before `lane`, the straightest way back, and where they start."""
        lanes: list[int] = []
        starts: list[float] = []
        start_m, leg = 0.0, lane
        while start_m > -BEHIND_M and len(lanes) < _MAX_LEGS and self.predecessors[leg]:
            ahead_rad = self._start_rad[leg]
            leg = min(
                self.predecessors[leg],
                key=lambda before: (_turn(self._out_rad[before], ahead_rad), before),
            )
            start_m -= self.length_m[leg]
            lanes.insert(0, leg)
            starts.insert(0, start_m)
        return lanes, starts

    def _by_turn(self, lane: int) -> list[tuple[float, int]]:
        """(turn, successor) pairs, the straightest first."""
        end_rad = self._end_rad[lane]
        return sorted((_turn(end_rad, self._into_rad[i]), i) for i in self.successors[lane])


def _turn(from_rad: float, to_rad: float) -> float:
    """Size of the turn, rounded so that equal turns to both sides tie in any turned map."""
    return round(abs(math.remainder(to_rad - from_rad, math.tau)), 2)


def _angle(vectors: Complex) -> list[float]:
    angles: list[float] = np.angle(vectors).tolist()
    return angles
