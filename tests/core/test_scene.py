from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from eqrt.core.contract import ModelContract
from eqrt.core.scene import (
    AgentHistories,
    build_scene,
    build_scenes,
    concatenate,
    direction_of_motion,
    last_seen,
    tile_origin,
)

CONTRACT = ModelContract(
    name="test",
    version="0.0.0",
    num_agents=3,
    history_steps=20,
    num_centerlines=2,
    centerline_points=4,
    horizon_steps=30,
    num_modes=1,
    dt_s=0.1,
)
ORIGIN = np.array([5000.0, -3000.0])


def agents_at(places: list[tuple[float, float]], speed_mps: float = 10.0) -> AgentHistories:
    """Agents that drive east and are at ORIGIN + `places` now."""
    time = (np.arange(20) - 19) * 0.1
    positions = np.array(places)[:, None] + time[:, None] * np.array([speed_mps, 0.0]) + ORIGIN
    valid = np.ones(positions.shape[:2], np.bool_)
    return AgentHistories(positions=positions, valid=valid, heading=np.zeros((len(places), 2)))


class OneLane:
    """A straight lane along every target, and no second one."""

    def centerlines_batch(
        self,
        positions: np.ndarray,
        directions: np.ndarray,
        num_centerlines: int,
        centerline_points: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        along = np.linspace(-10.0, 90.0, centerline_points)[:, None] * directions[:, None]
        points = np.zeros((len(positions), num_centerlines, centerline_points, 2))
        valid = np.zeros(points.shape[:3], np.bool_)
        points[:, 0], valid[:, 0] = positions[:, None] + along, True
        return points, valid


def test_the_target_comes_first_and_its_nearest_neighbours_follow() -> None:
    agents = agents_at([(0, 0), (50, 0), (4, 0), (-20, 3)])
    scene = build_scene(agents, np.array([0, 3]), CONTRACT, None, ORIGIN)
    np.testing.assert_allclose(scene.history[0, :, -1, 0], [0, 4, -20])
    np.testing.assert_allclose(scene.history[1, :, -1, 0], [-20, 0, 4])


def test_rows_without_an_agent_are_not_valid() -> None:
    scene = build_scene(agents_at([(0, 0), (9, 0)]), np.array([0]), CONTRACT, None, ORIGIN)
    np.testing.assert_array_equal(scene.history_valid.any(axis=-1), [[True, True, False]])


def test_a_neighbour_not_seen_for_half_a_second_is_left_out() -> None:
    agents = agents_at([(0, 0), (4, 0), (30, 0)])
    agents.valid[1, -5:] = False
    scene = build_scene(agents, np.array([0]), CONTRACT, None, ORIGIN)
    np.testing.assert_allclose(scene.history[0, :2, -1, 0], [0, 30])


def test_a_neighbour_is_placed_where_it_was_last_seen() -> None:
    agents = agents_at([(0, 0), (7, 0), (6.5, 0)])
    agents.valid[1, -2:] = False  # last seen 0.2 s ago, 2 m back: at x = 5
    scene = build_scene(agents, np.array([0]), CONTRACT, None, ORIGIN)
    np.testing.assert_allclose(scene.history[0, 1, -3, 0], 5.0)


def test_what_is_not_valid_is_zero_even_where_the_track_says_nan() -> None:
    agents = agents_at([(0, 0), (4, 0)])
    agents.valid[:, :7] = False
    agents.positions[:, :7] = np.nan
    scene = build_scene(agents, np.array([0]), CONTRACT, None, ORIGIN)
    assert np.isfinite(scene.history).all()
    np.testing.assert_array_equal(scene.history[0, 0, :7], 0.0)


def test_float32_holds_a_millimetre_because_the_origin_is_subtracted_in_float64() -> None:
    far = np.array([5.0e6, 4.0e6])
    agents = agents_at([(0.001, 0.0)])
    agents.positions[:] += far
    origin = tile_origin(agents.positions[0, -1])
    scene = build_scene(agents, np.array([0]), CONTRACT, None, origin)
    back = scene.history[0, 0, -1] + origin - (far + ORIGIN)
    np.testing.assert_allclose(back, [0.001, 0.0], atol=1e-4)
    assert np.abs(scene.history).max() < 1000.0


def test_without_a_map_no_centerline_is_valid() -> None:
    scene = build_scene(agents_at([(0, 0)]), np.array([0]), CONTRACT, None, ORIGIN)
    assert not scene.centerlines_valid.any()
    assert scene.centerlines.shape == (1, 2, 4, 2)


def test_centerlines_are_asked_for_in_the_direction_of_motion() -> None:
    scene = build_scene(agents_at([(0, 0)]), np.array([0]), CONTRACT, OneLane(), ORIGIN)
    np.testing.assert_allclose(scene.centerlines[0, 0, :, 0], [-10, 70 / 3, 170 / 3, 90], rtol=1e-6)
    np.testing.assert_array_equal(scene.centerlines_valid[0].any(axis=-1), [True, False])


@pytest.mark.parametrize("speed_mps", [0.0, 0.5])
def test_the_measured_heading_is_the_direction_of_what_hardly_moves(speed_mps: float) -> None:
    agents = agents_at([(0, 0)], speed_mps)
    agents.heading[0] = (0.0, 1.0)
    last = last_seen(agents.positions, agents.valid)
    np.testing.assert_allclose(direction_of_motion(agents, last), [[0.0, 1.0]])


def test_scenes_of_one_origin_become_one_batch() -> None:
    agents = agents_at([(0, 0), (4, 0)])
    one = build_scene(agents, np.array([0]), CONTRACT, None, ORIGIN)
    two = build_scene(agents, np.array([1]), CONTRACT, None, ORIGIN)
    both = build_scene(agents, np.array([0, 1]), CONTRACT, None, ORIGIN)
    for name, value in concatenate([one, two]).inputs().items():
        np.testing.assert_array_equal(value, both.inputs()[name])
    with pytest.raises(ValueError, match="origins"):
        concatenate([one, build_scene(agents, np.array([1]), CONTRACT, None, ORIGIN + 1)])


def test_groups_on_clocks_of_their_own_are_one_batch_and_one_search_for_lanes() -> None:
    searches = []

    class Counting(OneLane):
        def centerlines_batch(self, positions: np.ndarray, *more: Any) -> tuple[Any, Any]:
            searches.append(len(positions))
            return super().centerlines_batch(positions, *more)

    groups = [
        (agents_at([(0, 0), (4, 0), (9, 3)]), np.array([0, 2])),
        (agents_at([(-1, 0), (3, 0), (8, 3)], speed_mps=5.0), np.array([1])),
    ]
    together = build_scenes(groups, CONTRACT, Counting(), ORIGIN)
    assert searches == [3]
    apart = [build_scene(agents, rows, CONTRACT, OneLane(), ORIGIN) for agents, rows in groups]
    for name, value in concatenate(apart).inputs().items():
        np.testing.assert_array_equal(together.inputs()[name], value)
        assert together.inputs()[name].dtype == value.dtype
