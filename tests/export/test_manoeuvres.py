"""Every manoeuvre as a hand-made path, and what is just not one."""

from __future__ import annotations

import numpy as np
import pytest

from eqrt.export.evaluation.manoeuvres import MANOEUVRES, SPEED_BANDS, manoeuvres, speed_bands
from eqrt.export.evaluation.selection import turned
from eqrt.training.dataset.windows import Windows, join
from window_cases import DT_S, TIME_S, bend, lane, lane_change, straight, window

THREE_LANES = [lane(0.0), lane(3.5), lane(-3.5)]


def manoeuvre_of(windows: Windows) -> str:
    return MANOEUVRES[manoeuvres(windows)[0]]


def test_driving_along_a_lane_is_straight() -> None:
    assert manoeuvre_of(window(straight(12.0), THREE_LANES)) == "straight"


def test_less_than_two_metres_in_three_seconds_is_stopped() -> None:
    """0.6 m/s is 1.8 m, 0.7 m/s is 2.1 m."""
    assert manoeuvre_of(window(straight(0.6), THREE_LANES)) == "stopped"
    assert manoeuvre_of(window(straight(0.7), THREE_LANES)) == "straight"


def test_a_standing_target_that_drives_off_is_not_stopped() -> None:
    path = straight(0.0)
    path[:, 0] = np.where(TIME_S > 0.0, TIME_S**2, 0.0)  # 9 m in 3 s
    assert manoeuvre_of(window(path, THREE_LANES)) == "straight"


@pytest.mark.parametrize(
    ("radius_m", "expected"), [(15.0, "turn left"), (-15.0, "turn right"), (150.0, "straight")]
)
def test_a_turn_is_twenty_degrees_or_more(radius_m: float, expected: str) -> None:
    """8 m/s for 3 s is 24 m: 92 degrees on 15 m, 9 degrees on 150 m."""
    assert manoeuvre_of(window(bend(8.0, radius_m))) == expected


def test_a_standing_target_turns_from_its_measured_heading() -> None:
    """It stands, points along +x, and drives off along +y."""
    path = straight(0.0)
    path[:, 1] = np.where(TIME_S > 0.0, TIME_S**2, 0.0)
    assert manoeuvre_of(window(path, heading=(1.0, 0.0))) == "turn left"
    assert manoeuvre_of(window(path, heading=(-1.0, 0.0))) == "turn right"
    assert manoeuvre_of(window(path, heading=(0.0, 1.0))) == "straight"


def test_a_standing_target_of_unknown_heading_turns_from_its_first_metre() -> None:
    path = straight(0.0)
    path[:, 1] = np.where(TIME_S > 0.0, TIME_S**2, 0.0)
    assert manoeuvre_of(window(path)) == "straight"


@pytest.mark.parametrize("shift_m", [3.5, -3.5])
def test_leaving_a_line_for_the_next_is_a_lane_change(shift_m: float) -> None:
    assert manoeuvre_of(window(lane_change(20.0, shift_m), THREE_LANES)) == "lane change"


def test_wandering_within_a_lane_is_straight() -> None:
    assert manoeuvre_of(window(lane_change(20.0, 1.5), THREE_LANES)) == "straight"


def test_without_lane_lines_nothing_is_a_lane_change() -> None:
    assert manoeuvre_of(window(lane_change(20.0, 3.5))) == "straight"


def test_the_line_it_ends_on_must_run_its_way() -> None:
    """Overtaking through the oncoming lane is not a change of lane."""
    lines = [lane(0.0), lane(3.5, backwards=True)]
    assert manoeuvre_of(window(lane_change(20.0, 3.5), lines)) == "straight"


def test_following_a_lane_that_bends_is_no_lane_change() -> None:
    """On 300 m at 20 m/s: 6 m sideways of where it was headed, on its line all the way."""
    path = bend(20.0, 300.0)
    radii = (300.0, 296.5, 303.5)
    angle = np.linspace(-0.05, 0.35, 25)
    lines = [np.stack([r * np.sin(angle), 300.0 - r * np.cos(angle)], axis=-1) for r in radii]
    assert manoeuvre_of(window(path, lines)) == "straight"


def test_taking_a_branch_is_no_lane_change() -> None:
    """Two routes share their beginning; the target leaves one for the other, and was on both."""
    branch = lane(0.0)
    ahead = np.maximum(branch[:, 0] - 10.0, 0.0)
    branch[:, 1] = ahead**2 / 600.0
    path = straight(20.0)
    path[:, 1] = np.maximum(path[:, 0] - 10.0, 0.0) ** 2 / 600.0  # 4.2 m sideways at 60 m
    assert manoeuvre_of(window(path, [lane(0.0), branch])) == "straight"


def test_a_line_that_goes_on_as_another_is_the_same_lane() -> None:
    """Its own line ends 20 m ahead, before a bend; the one that begins there continues it."""
    path = straight(20.0)
    path[:, 1] = np.maximum(path[:, 0] - 20.0, 0.0) ** 2 / 500.0  # 3.2 m sideways at 60 m
    own = np.stack([np.linspace(-20.0, 20.0, 25), np.zeros(25)], axis=-1)
    x = np.linspace(20.0, 80.0, 25)
    following = np.stack([x, (x - 20.0) ** 2 / 500.0], axis=-1)
    assert manoeuvre_of(window(path, [own, following])) == "straight"


@pytest.mark.parametrize("degrees", [37.0, 180.0, -91.0])
def test_turning_the_world_changes_no_manoeuvre(degrees: float) -> None:
    paths = [straight(12.0), straight(0.3), bend(8.0, 15.0), bend(8.0, -15.0)]
    windows = join([window(p, THREE_LANES) for p in [*paths, lane_change(20.0, 3.5)]])
    np.testing.assert_array_equal(manoeuvres(turned(windows, degrees)), manoeuvres(windows))
    np.testing.assert_array_equal(
        speed_bands(turned(windows, degrees), DT_S), speed_bands(windows, DT_S)
    )


@pytest.mark.parametrize(
    ("speed_mps", "expected"),
    [
        (0.0, "0 to 2 m/s"),
        (1.9, "0 to 2 m/s"),
        (2.1, "2 to 5 m/s"),
        (14.0, "10 to 15 m/s"),
        (19.0, "15 to 20 m/s"),
        (35.0, "over 20 m/s"),
    ],
)
def test_speed_bands(speed_mps: float, expected: str) -> None:
    assert SPEED_BANDS[speed_bands(window(straight(speed_mps)), DT_S)[0]] == expected
