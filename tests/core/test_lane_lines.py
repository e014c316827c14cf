"""Lanes as lines, also those that say a point twice."""

from __future__ import annotations

import numpy as np
import pytest

from eqrt.core.lane_lines import LaneLines, from_complex
from eqrt.core.lanes import Lane, LaneMap, build_lane_map
from eqrt.core.nearest import NearestLanes
from eqrt.core.routes import RouteFinder


def line(y_m: float) -> np.ndarray:
    """(51, 2) to the east, a point every 2 m."""
    return np.stack([np.arange(0.0, 101.0, 2.0), np.full(51, y_m)], axis=-1)


def lanes(*lines: np.ndarray) -> LaneMap:
    return build_lane_map([Lane(lane_id=i, centerline=c) for i, c in enumerate(lines)], "test")


@pytest.mark.parametrize("doubled", [0, 20, 50])
def test_a_point_that_comes_twice_changes_nothing(doubled: int) -> None:
    plain = LaneLines(lanes(line(0.0), line(4.0)))
    twice = np.insert(line(0.0), doubled, line(0.0)[doubled], axis=0)
    found = LaneLines(lanes(twice, np.repeat(line(4.0), 3, axis=0)))
    for name in ("points", "start", "lane", "segment_m", "direction", "along_m", "length_m"):
        np.testing.assert_array_equal(getattr(found, name), getattr(plain, name))


def test_a_lane_that_says_a_point_twice_is_as_far_away_as_any() -> None:
    """It lies 25 m from the car, and the others 0.5 and 4 m."""
    far = np.insert(line(25.0), 20, line(25.0)[20], axis=0)
    found = lanes(far, line(0.5), line(4.0))
    place, still = np.array([[39.0, 0.0]]), np.zeros((1, 2))
    for source in (NearestLanes(found), RouteFinder(found)):
        centerlines, valid = source.centerlines_batch(place, still, 3, 21)
        assert valid[0, :, 5].all()
        np.testing.assert_allclose(centerlines[0, :, 5, 1], [0.5, 4.0, 25.0])


def test_a_lane_that_is_one_point_is_as_far_away_as_that_point() -> None:
    """Compilers refuse it; the reader of a tile does not look for it."""
    found = lanes(line(25.0), line(0.5))
    found.points[:51] = (39.0, 25.0)
    lines = LaneLines(found)
    assert lines.start.tolist() == [0, 2, 53]
    np.testing.assert_array_equal(from_complex(lines.points[:2]), [[39.0, 25.0], [39.0, 25.0]])
    place, still = np.array([[39.0, 0.0]]), np.zeros((1, 2))
    centerlines, valid = NearestLanes(found).centerlines_batch(place, still, 2, 21)
    np.testing.assert_allclose(centerlines[0, :, 0, 1], [0.5, 25.0])
    assert valid.all()
