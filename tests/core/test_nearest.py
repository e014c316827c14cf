"""The nearest lanes, whole, nearest first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.lane_choice import centerline_source
from eqrt.core.lanes import Lane, build_lane_map, evenly_spaced
from eqrt.core.nearest import NearestLanes
from eqrt.core.routes import RouteFinder

NOWHERE = np.zeros((1, 2))


def lane(lane_id: int, begin: tuple[float, float], end: tuple[float, float]) -> Lane:
    return Lane(lane_id=lane_id, centerline=evenly_spaced(np.array([begin, end])))


def find(
    *lanes: Lane, at: tuple[float, float] = (0.0, 0.0), q: int = 3, points: int = 5
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    source = NearestLanes(build_lane_map(lanes, "test"))
    found, valid = source.centerlines_batch(np.array([at]), NOWHERE, q, points)
    return found[0], valid[0]


def test_the_nearest_comes_first_and_runs_from_its_first_point_to_its_last() -> None:
    points, valid = find(lane(1, (-20, 8), (20, 8)), lane(2, (-20, -3), (20, -3)))
    np.testing.assert_allclose(points[0, :, 0], [-20, -10, 0, 10, 20])
    np.testing.assert_allclose(points[:2, :, 1], [[-3] * 5, [8] * 5])
    assert valid.tolist() == [[True] * 5, [True] * 5, [False] * 5]


def test_a_long_lane_counts_fifty_meters_to_either_side() -> None:
    points, _ = find(lane(1, (-300, 2), (500, 2)), at=(100.0, 0.0))
    np.testing.assert_allclose(points[0, :, 0], [50, 75, 100, 125, 150])


def test_only_as_many_as_asked_for_and_none_beyond_reach() -> None:
    lanes = [lane(i, (-10, 4.0 * i), (10, 4.0 * i)) for i in range(12)]
    points, valid = find(*lanes, q=4)
    np.testing.assert_allclose(points[:, 0, 1], [0, 4, 8, 12])
    assert valid.all()
    assert not find(lane(1, (-10, 45), (10, 45)))[1].any()


def test_many_targets_at_once_are_the_same_as_one_by_one() -> None:
    lanes = [lane(i, (-10.0 * i, 3.0 * i), (40.0, -2.0 * i)) for i in range(9)]
    source = NearestLanes(build_lane_map(lanes, "test"))
    places = np.random.default_rng(0).uniform(-20.0, 20.0, (17, 2))
    together = source.centerlines_batch(places, np.zeros((17, 2)), 4, 6)
    for row, place in enumerate(places):
        alone = source.centerlines_batch(place[None], NOWHERE, 4, 6)
        np.testing.assert_array_equal(together[0][row], alone[0][0])
        np.testing.assert_array_equal(together[1][row], alone[1][0])


def test_the_contract_decides_how_lanes_are_chosen() -> None:
    lanes = build_lane_map([lane(1, (-10, 0), (10, 0))], "test")
    contract = ModelContract(
        name="test",
        version="0.0.0",
        num_agents=2,
        history_steps=4,
        num_centerlines=2,
        centerline_points=5,
        horizon_steps=3,
        num_modes=1,
        dt_s=0.1,
    )
    assert isinstance(centerline_source(lanes, contract), RouteFinder)
    nearest = replace(contract, lane_choice="nearest")
    assert isinstance(centerline_source(lanes, nearest), NearestLanes)
