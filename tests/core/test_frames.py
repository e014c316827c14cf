"""Planar rigid transforms keep their promises, with values that can be checked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eqrt.core.frames import Pose2, wrap_angle

coordinates = st.floats(-1e5, 1e5)
angles = st.floats(-10.0, 10.0)
poses = st.builds(Pose2, coordinates, coordinates, angles)

LEFT_TURN = Pose2(10.0, 5.0, math.pi / 2)
"""A car at (10, 5) that faces north."""


def test_ahead_of_a_car_that_faces_north_is_north() -> None:
    np.testing.assert_allclose(LEFT_TURN.apply(np.array([3.0, 0.0])), [10.0, 8.0])


def test_left_of_a_car_that_faces_north_is_west() -> None:
    np.testing.assert_allclose(LEFT_TURN.apply(np.array([0.0, 3.0])), [7.0, 5.0])


def test_a_vector_is_turned_and_not_moved() -> None:
    np.testing.assert_allclose(LEFT_TURN.rotate(np.array([3.0, 0.0])), [0.0, 3.0], atol=1e-15)


def test_any_leading_axes_are_kept() -> None:
    points = np.arange(24.0).reshape(3, 4, 2)
    moved = LEFT_TURN.apply(points)
    assert moved.shape == points.shape
    np.testing.assert_array_equal(moved[2, 3], LEFT_TURN.apply(points[2, 3]))


def test_the_default_pose_changes_nothing() -> None:
    points = np.array([[1.0, 2.0], [-3.0, 4.0]])
    np.testing.assert_array_equal(Pose2().apply(points), points)


@given(poses, coordinates, coordinates)
def test_the_inverse_brings_every_point_back(pose: Pose2, x_m: float, y_m: float) -> None:
    point = np.array([x_m, y_m])
    np.testing.assert_allclose(pose.inverse().apply(pose.apply(point)), point, atol=1e-8)


@given(poses)
def test_a_pose_composed_with_its_inverse_cancels(pose: Pose2) -> None:
    nothing = pose @ pose.inverse()
    assert (nothing.x_m, nothing.y_m) == pytest.approx((0.0, 0.0), abs=1e-8)
    assert nothing.yaw_rad == pytest.approx(0.0, abs=1e-12)


@given(poses, poses, coordinates, coordinates)
def test_composing_is_applying_one_after_the_other(
    map_from_ego: Pose2, ego_from_sensor: Pose2, x_m: float, y_m: float
) -> None:
    point = np.array([x_m, y_m])
    map_from_sensor = map_from_ego @ ego_from_sensor
    expected = map_from_ego.apply(ego_from_sensor.apply(point))
    np.testing.assert_allclose(map_from_sensor.apply(point), expected, atol=1e-8)


@given(poses, poses, poses)
def test_composition_is_associative(a: Pose2, b: Pose2, c: Pose2) -> None:
    left, right = (a @ b) @ c, a @ (b @ c)
    assert (left.x_m, left.y_m) == pytest.approx((right.x_m, right.y_m), abs=1e-8)
    assert wrap_angle(left.yaw_rad - right.yaw_rad) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("angle_deg", "wrapped_deg"),
    [(0, 0), (90, 90), (179, 179), (181, -179), (270, -90), (360, 0), (-181, 179), (721, 1)],
)
def test_angles_wrap_at_half_a_turn(angle_deg: float, wrapped_deg: float) -> None:
    wrapped_rad = wrap_angle(math.radians(angle_deg))
    assert wrapped_rad == pytest.approx(math.radians(wrapped_deg), abs=1e-12)


@given(st.floats(-1e6, 1e6))
def test_a_wrapped_angle_is_the_same_direction_within_half_a_turn(angle_rad: float) -> None:
    wrapped_rad = wrap_angle(angle_rad)
    assert -math.pi <= wrapped_rad <= math.pi
    assert math.cos(wrapped_rad) == pytest.approx(math.cos(angle_rad), abs=1e-9)
    assert math.sin(wrapped_rad) == pytest.approx(math.sin(angle_rad), abs=1e-9)


def test_a_turn_across_half_a_turn_stays_small() -> None:
    """From 179 degrees, two degrees to the left is -179 degrees."""
    turned = Pose2(yaw_rad=math.radians(179)) @ Pose2(yaw_rad=math.radians(2))
    assert math.degrees(turned.yaw_rad) == pytest.approx(-179)
