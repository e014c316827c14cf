"""Candidate centerlines, on roads drawn by hand and on recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.core.lanes import Lane, LaneMap, build_lane_map, middle_line
from eqrt.core.routes import RouteFinder
from eqrt.training.recordings.commonroad import Scenario, lane_map, read_scenario

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

NGSIM = Path(__file__).parents[1] / "data/ngsim"
EAST, WEST, NORTH = np.array([1.0, 0.0]), np.array([-1.0, 0.0]), np.array([0.0, 1.0])
Q, L = 4, 11  # eleven points over 100 m: one every 10 m


def road(lane_id: int, points: Sequence[tuple[float, float]], *successors: int) -> Lane:
    line = np.array(points, np.float64)
    return Lane(lane_id=lane_id, centerline=middle_line(line, line), successors=successors)


def finder(*lanes: Lane) -> RouteFinder:
    return RouteFinder(build_lane_map(lanes, "test"))


def find(
    routes: RouteFinder, x: float, y: float, direction: Float64 | None, count: int = Q
) -> list[Float64]:
    """The valid part of every centerline that has one."""
    points, valid = routes.centerlines(np.array([x, y]), direction, count, L)
    return [line[seen] for line, seen in zip(points, valid, strict=True) if seen.any()]


@pytest.fixture(scope="module", params=["USA_US101-22_4", "USA_Lanker-2_23", "USA_Peach-4_8"])
def recording(request: pytest.FixtureRequest) -> Scenario:
    return read_scenario(NGSIM / f"{request.param}_T-1.xml.gz")


def states(scenario: Scenario, every: int = 10) -> tuple[Float64, Float64]:
    """Positions and headings (A, 2) of all tracks, now and then."""
    position = np.concatenate([track.position[::every] for track in scenario.tracks])
    heading = np.concatenate([track.heading_rad[::every] for track in scenario.tracks])
    return position, np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def test_points_lie_evenly_from_10_m_behind_to_90_m_ahead_across_lanes() -> None:
    routes = finder(road(1, [(0, 0), (50, 0)], 2), road(2, [(50, 0), (200, 0)]))
    points, valid = routes.centerlines(np.array([40.0, 1.5]), EAST, Q, L)
    np.testing.assert_array_equal(points[0, :, 0], np.arange(30.0, 131.0, 10.0))
    np.testing.assert_array_equal(points[0, :, 1], 0.0)
    assert valid[0].all()
    assert not valid[1:].any()  # one way to go, and it counts once


def test_points_beyond_the_end_of_the_map_are_not_valid() -> None:
    (line,) = find(finder(road(1, [(0, 0), (100, 0)])), 45.0, 0.0, EAST)
    np.testing.assert_array_equal(line[:, 0], np.arange(35.0, 100.0, 10.0))
    (line,) = find(finder(road(1, [(0, 0), (200, 0)])), 5.0, 0.0, EAST)
    np.testing.assert_array_equal(line[:, 0], np.arange(5.0, 100.0, 10.0))


def test_a_junction_gives_every_way_the_straightest_first() -> None:
    routes = finder(
        road(1, [(0, 0), (50, 0)], 2, 3, 4),
        road(2, [(50, 0), (60, 10), (60, 200)]),
        road(3, [(50, 0), (200, 0)]),
        road(4, [(50, 0), (55, -10), (55, -200)]),
    )
    ends = [line[-1].round().tolist() for line in find(routes, 40.0, 0.0, EAST)]
    assert ends[0] == [130.0, 0.0]
    assert [np.sign(y) for _, y in ends] == [0.0, 1.0, -1.0]


def test_a_branch_beyond_reach_does_not_double_the_route() -> None:
    routes = finder(
        road(1, [(0, 0), (200, 0)], 2, 3),
        road(2, [(200, 0), (300, 0)]),
        road(3, [(200, 0), (200, 100)]),
    )
    assert len(find(routes, 105.0, 0.0, EAST)) == 1
    assert len(find(routes, 115.0, 0.0, EAST)) == 2


def test_the_way_back_is_the_straightest() -> None:
    routes = finder(
        road(1, [(0, -50), (50, 0)], 3),
        road(2, [(0, 0), (50, 0)], 3),
        road(3, [(50, 0), (200, 0)]),
    )
    line = find(routes, 52.0, 0.0, EAST)[0]
    np.testing.assert_allclose(line[0], [42.0, 0.0])


def test_just_past_a_fork_the_lane_one_is_on_comes_first() -> None:
    routes = finder(
        road(1, [(0, 0), (50, 0)], 2, 3),
        road(2, [(50, 0), (150, 0)]),
        road(3, [(50, 0), (140, 40)]),
    )
    on_branch = find(routes, 59.0, 4.0, np.array([9.0, 4.0]))
    assert on_branch[0][-1, 1] > 30.0
    assert on_branch[1][-1, 1] == 0.0
    assert len(on_branch) == 2  # the lane behind the fork is part of both, not a third


def test_other_lanes_fill_up_by_distance() -> None:
    routes = finder(
        road(1, [(0, 20), (200, 20)]),
        road(2, [(200, 8), (0, 8)]),  # oncoming
        road(3, [(0, 3.5), (200, 3.5)]),  # the next lane, which it may also be on
        road(4, [(0, 0), (200, 0)]),
        road(5, [(110, -50), (110, 50)]),  # crossing, 10 m ahead
        road(6, [(0, 40), (200, 40)]),  # out of reach
    )
    lines = find(routes, 100.0, 0.5, EAST, count=8)
    assert [line[1].tolist() for line in lines] == [
        [100.0, 0.0],
        [100.0, 3.5],
        [100.0, 8.0],
        [110.0, 0.5],
        [100.0, 20.0],
    ]
    assert len(find(routes, 100.0, 0.5, EAST, count=2)) == 2


def test_oncoming_lanes_are_told_by_the_direction() -> None:
    routes = finder(road(1, [(0, 0), (200, 0)]), road(2, [(200, 3), (0, 3)]))
    assert find(routes, 100.0, 1.4, WEST)[0][0].tolist() == [110.0, 3.0]
    assert find(routes, 100.0, 1.6, EAST)[0][0].tolist() == [90.0, 0.0]
    assert find(routes, 100.0, 1.4, None)[0][0].tolist() == [90.0, 0.0]  # just the nearer one


@pytest.mark.parametrize("error_deg", [-50, -20, 20, 50])
def test_a_direction_that_is_off_changes_nothing_on_a_road(error_deg: float) -> None:
    routes = finder(*(road(i, [(0, 3.5 * i), (200, 3.5 * i)]) for i in range(4)))
    off = Pose2(yaw_rad=np.deg2rad(error_deg)).rotate(EAST)
    exact = routes.centerlines(np.array([100.0, 4.0]), EAST, Q, L)
    skewed = routes.centerlines(np.array([100.0, 4.0]), off, Q, L)
    np.testing.assert_array_equal(exact[0], skewed[0])


def test_off_the_lanes_the_best_one_within_30_m_counts() -> None:
    routes = finder(
        road(1, [(0, 0), (100, 0)], 2, 3),
        road(2, [(100, 0), (200, 0)]),
        road(3, [(100, 0), (100, -100)]),
        road(4, [(80, 100), (80, 12)]),
    )
    lines = find(routes, 80.0, 10.0, EAST)
    assert len(lines) == 3  # both ways of the road, and the lane across, though it is nearer
    assert lines[0][-1].tolist() == [170.0, 0.0]
    assert find(routes, 30.0, -31.0, EAST) == []


def test_a_ring_road_goes_round_and_the_search_ends() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    ring = [(10.0 * np.cos(a), 10.0 * np.sin(a)) for a in angle.tolist()]
    (line,) = find(finder(road(1, ring, 1)), 10.0, 0.0, NORTH)
    assert len(line) == L
    np.testing.assert_allclose(np.hypot(*line.T), 10.0, atol=0.1)


def test_a_position_that_is_no_number_finds_nothing() -> None:
    routes = finder(road(1, [(0, 0), (100, 0)]))
    places = np.array([[np.nan, 0.0], [np.inf, 0.0], [1e300, 1e300], [50.0, 0.0]])
    directions = np.array([EAST, EAST, EAST, [np.nan, np.nan]])
    _, valid = routes.centerlines_batch(places, directions, Q, L)
    assert valid.any(axis=(1, 2)).tolist() == [False, False, False, True]


def test_no_targets_are_no_centerlines() -> None:
    routes = finder(road(1, [(0, 0), (100, 0)]))
    points, valid = routes.centerlines_batch(np.zeros((0, 2)), np.zeros((0, 2)), Q, L)
    assert points.shape == (0, Q, L, 2)
    assert valid.shape == (0, Q, L)


def test_many_targets_at_once_are_the_same_as_one_by_one(recording: Scenario) -> None:
    routes = RouteFinder(lane_map(recording))
    positions, directions = states(recording, every=25)
    points, valid = routes.centerlines_batch(positions, directions, 8, 20)
    for i, (position, direction) in enumerate(zip(positions, directions, strict=True)):
        alone = routes.centerlines(position, direction, 8, 20)
        np.testing.assert_array_equal(points[i], alone[0])
        np.testing.assert_array_equal(valid[i], alone[1])


def test_every_point_lies_on_a_lane(recording: Scenario) -> None:
    lanes = lane_map(recording)
    points, valid = RouteFinder(lanes).centerlines_batch(*states(recording, every=80), 8, 20)
    assert distance_to_lanes(points[valid], lanes).max() < 1e-9


@pytest.mark.parametrize("turn_deg", [40, 90, 166])
def test_turning_and_moving_the_world_turns_and_moves_the_centerlines(
    recording: Scenario, turn_deg: float
) -> None:
    moved = Pose2(-400.0, 900.0, np.deg2rad(turn_deg))
    lanes = lane_map(recording)
    points = moved.apply(lanes.points.astype(np.float64)).astype(np.float32)
    positions, directions = states(recording)
    before = RouteFinder(lanes).centerlines_batch(positions, directions, 8, 20)
    after = RouteFinder(replace(lanes, points=points)).centerlines_batch(
        moved.apply(positions), moved.rotate(directions), 8, 20
    )
    np.testing.assert_array_equal(before[1], after[1])
    seen = before[1]
    # 2 mm: the moved map's points are float32, 1 km from the origin.
    np.testing.assert_allclose(moved.apply(before[0])[seen], after[0][seen], atol=2e-3)


def test_recorded_cars_stay_by_their_candidates(recording: Scenario) -> None:
    """Where a car is 3 s later is as near to a candidate as to the map's nearest lane."""
    lanes = lane_map(recording)
    routes = RouteFinder(lanes)
    worse, total = 0, 0
    for track in recording.tracks:
        positions, directions = states(replace(recording, tracks=(track,)), every=1)
        now = np.arange(0, len(positions) - 30, 10)
        later = positions[now + 30]
        on_map = distance_to_lanes(later, lanes)
        points, valid = routes.centerlines_batch(positions[now], directions[now], 8, 51)
        for place, reach, line, seen in zip(later, on_map, points, valid, strict=True):
            if reach < 2.0:
                total += 1
                worse += np.hypot(*(line[seen] - place).T).min(initial=np.inf) > reach + 1.5
    assert total >= 20
    assert worse <= 0.02 * total


def distance_to_lanes(places: Float64, lanes: LaneMap) -> Float64:
    """(A,) metres from each place (A, 2) to the nearest lane, by trying every segment."""
    begin = lanes.points[:-1].astype(np.float64)
    step = np.diff(lanes.points.astype(np.float64), axis=0)
    within = np.ones(len(begin), np.bool_)
    within[lanes.lane_start[1:-1] - 1] = False  # from one lane's end to the next one's start
    begin, step = begin[within], step[within]
    nearest = np.empty(len(places))
    for i, place in enumerate(places):
        share = ((place - begin) * step).sum(axis=1) / (step**2).sum(axis=1)
        foot = begin + np.clip(share, 0.0, 1.0)[:, None] * step
        nearest[i] = np.hypot(*(foot - place).T).min()
    return nearest
