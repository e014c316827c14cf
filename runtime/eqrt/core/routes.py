"""Candidate centerlines: the ways that a vehicle may go, as polylines for the model.

For each target, the routes through the lanes that it may be on: those within `ON_LANE_M` that run
its way, else the best one that runs its way within reach. One route per such lane in turn, then
their branches; then room left is filled with the other lanes around (neighbours, crossing and
oncoming ones), the nearest first. A lane that a chosen route already uses is not taken again.
Order depends on distances only, and on the lane's index when they tie.

Axes: A targets, Q centerlines, L points. Metres, map frame.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from itertools import chain, zip_longest
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eqrt.core.lane_graph import AHEAD_M, BEHIND_M, LaneGraph, Route
from eqrt.core.lane_grid import LaneGrid, NearLanes, least_of_each
from eqrt.core.lane_lines import Complex, Index, LaneLines, from_complex, to_complex
from eqrt.core.lanes import LaneMap

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

ON_LANE_M = 4.0  # m, a lane's width: the next lane counts while its line is being crossed
_SAME_WAY = 0.5  # cosine; a measured direction may be up to 60 degrees off
_TURN_COST_M = 10.0  # m of distance that a lane across the target's direction counts as


_Place = tuple[int, float]
"""A place on a lane: lane index, metres from the lane's first point."""


class _Choice(NamedTuple):
    """A route, and where along it the target is."""

    route: Route
    along_m: float


class _Around(NamedTuple):
    """Places on the lanes around one target, in order."""

    may_be_on: list[_Place]
    others: list[_Place]


class RouteFinder:
    """Finds candidate centerlines on one lane map."""

    def __init__(self, lane_map: LaneMap) -> None:
        self.lane_map = lane_map
        self._lines = LaneLines(lane_map)
        self._grid = LaneGrid(self._lines, np.diff(lane_map.successor_start) > 0)
        self._graph = LaneGraph(lane_map, self._lines)

    def centerlines(
        self,
        position: Float64,
        direction: Float64 | None,
        num_centerlines: int,
        centerline_points: int,
    ) -> tuple[Float64, Bool]:
        """Points (Q, L, 2) and valid (Q, L) for one target at `position` (2,).

        `direction` (2,) is where it heads, of any length; None or zeros = not known.
        """
        toward = np.zeros(2) if direction is None else direction
        points, valid = self.centerlines_batch(
            position[None], toward[None], num_centerlines, centerline_points
        )
        return points[0], valid[0]

    def centerlines_batch(
        self,
        positions: Float64,
        directions: Float64,
        num_centerlines: int,
        centerline_points: int,
    ) -> tuple[Float64, Bool]:
        """Points (A, Q, L, 2) and valid (A, Q, L) for targets at `positions` (A, 2).

        `directions` (A, 2) are where they head, of any length; zeros = not known. The points lie
        evenly over [-BEHIND_M, AHEAD_M] along the route, 0 being nearest to the target. Points
        beyond the map's ends are not valid, and neither is any for a position off the map.
        """
        chosen: list[_Choice] = []
        row: list[int] = []
        near = self._grid.near(to_complex(positions))
        targets = _in_order(near, to_complex(directions), len(positions))
        for target, around in enumerate(targets):
            choices = self._choose(around, num_centerlines)
            chosen += choices
            row += range(target * num_centerlines, target * num_centerlines + len(choices))
        count = len(positions) * num_centerlines
        points = np.zeros((count, centerline_points), np.complex128)
        valid = np.zeros((count, centerline_points), np.bool_)
        if chosen:
            points[row], valid[row] = self._sample(chosen, centerline_points)
        shape = (len(positions), num_centerlines, centerline_points)
        return from_complex(points.reshape(shape)), valid.reshape(shape)

    def _choose(self, around: _Around, num_centerlines: int) -> list[_Choice]:
        """At most Q routes for one target."""
        used: set[int] = set()  # lanes that the routes run on, within reach
        queues: list[list[_Choice]] = []
        for lane, along_m in around.may_be_on:
            if lane not in used:
                queues.append(self._ways(lane, along_m))
                used.update(*map(_lanes_within_reach, queues[-1]))
        choices = _in_turn(queues)
        for lane, along_m in around.others:
            if len(choices) >= num_centerlines:
                break
            if lane not in used:
                choices.append(_Choice(self._graph.routes(lane)[0], along_m))
                used.update(_lanes_within_reach(choices[-1]))
        return choices[:num_centerlines]

    def _ways(self, lane: int, along_m: float) -> list[_Choice]:
        """Routes through a place on a lane that differ within reach."""
        return [
            _Choice(route, along_m)
            for route in self._graph.routes(lane)
            if route.branch_m < along_m + AHEAD_M
        ]

    def _sample(self, chosen: list[_Choice], centerline_points: int) -> tuple[Complex, Bool]:
        """Points (R, L) and valid (R, L) of R chosen routes."""
        routes = [route for route, _ in chosen]
        here = np.array([along_m for _, along_m in chosen])
        even = np.linspace(-BEHIND_M, AHEAD_M, centerline_points)
        along = here[:, None] + even  # (R, L)
        lane, start = _legs_of_samples(routes, here, even)
        points = self._lines.at(lane, along - start)
        begin = np.array([route.starts_m[0] for route in routes])[:, None]
        end = np.array([route.end_m for route in routes])[:, None]
        return points, (along >= begin) & (along <= end)


def _legs_of_samples(routes: list[Route], here: Float64, even: Float64) -> tuple[Index, Float64]:
    """Lane of every sample (R, L), and where that leg starts along its route (R, L).

    Each leg begins at some sample; counting the beginnings up to a sample gives its leg.
    """
    count = np.array([len(route.lanes) for route in routes])
    lane = np.fromiter(chain.from_iterable(route.lanes for route in routes), np.int64)
    start = np.fromiter(chain.from_iterable(route.starts_m for route in routes), np.float64)
    row = np.repeat(np.arange(len(routes)), count)
    begins = np.searchsorted(even, start - here[row])
    begins[np.cumsum(count) - count] = 0  # before a route's beginning nothing is valid
    within = begins < len(even)
    begun = np.bincount((row * len(even) + begins)[within], minlength=len(routes) * len(even))
    leg = (np.cumsum(begun) - 1).reshape(len(routes), len(even))
    return lane[within][leg], start[within][leg]


def _in_order(near: NearLanes, directions: Complex, num_targets: int) -> Iterator[_Around]:
    """The lanes around each target, the likeliest and the nearest first."""
    cost, same_way = _cost(near, directions[near.place])
    may_be_on = same_way & (near.distance_m <= ON_LANE_M)
    lost = np.bincount(near.place[may_be_on], minlength=num_targets) == 0
    way_back = np.flatnonzero(lost[near.place] & same_way)
    may_be_on[way_back[least_of_each(near.place[way_back], cost[way_back])]] = True
    rank_m = np.where(may_be_on, cost, 100.0 + near.distance_m)
    key = near.place * 1000.0 + np.round(rank_m, 2)  # equal but for rounding counts as equal
    order = np.argsort(key, kind="stable")  # ties stay in the order of the lanes
    places = list(zip(near.lane[order].tolist(), near.along_m[order].tolist(), strict=True))
    lanes = np.bincount(near.place, minlength=num_targets).tolist()
    first_ones = np.bincount(near.place[may_be_on], minlength=num_targets).tolist()
    end = 0
    for first, all_ in zip(first_ones, lanes, strict=True):
        begin, end = end, end + all_
        yield _Around(places[begin : begin + first], places[begin + first : end])


def _cost(near: NearLanes, toward: Complex) -> tuple[Float64, Bool]:
    """How far off each lane is, its turn counted in, and whether it runs the target's way."""
    speed = np.abs(toward)
    known = speed > 0.0  # False for NaN
    cosine = (near.direction * toward.conj()).real / np.where(known, speed, 1.0)
    cosine[~known] = 1.0  # every lane is as good
    return near.distance_m + _TURN_COST_M * (1.0 - cosine), cosine >= _SAME_WAY


def _lanes_within_reach(choice: _Choice) -> tuple[int, ...]:
    route, along_m = choice
    return route.lanes[: bisect_left(route.starts_m, along_m + AHEAD_M)]


def _in_turn(queues: list[list[_Choice]]) -> list[_Choice]:
    """The first of every queue, then the second of every queue, and so on."""
    return [choice for turn in zip_longest(*queues) for choice in turn if choice is not None]
