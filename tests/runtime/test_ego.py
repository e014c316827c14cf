"""Where the ego is at any time: exact arcs, poses, jumps, and what a real drive drifts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.detections import EgoMotion, EgoPose
from eqrt.runtime.tracking.ego import EgoTracker
from rav4_drive import Drive, read_drive


@pytest.fixture(scope="module")
def drive() -> Drive:
    return read_drive()


def drive_steadily(
    tracker: EgoTracker, *, speed_mps: float, yaw_rate_rad_s: float, from_s: float, to_s: float
) -> None:
    for time_s in np.linspace(from_s, to_s, round((to_s - from_s) * 50) + 1):
        tracker.motion(
            EgoMotion(timestamp_s=float(time_s), speed_mps=speed_mps, yaw_rate_rad_s=yaw_rate_rad_s)
        )


def give_pose(tracker: EgoTracker, time_s: float, *pose: float) -> None:
    tracker.pose(EgoPose(timestamp_s=time_s, map_from_ego=Pose2(*pose)))


def assert_pose(pose: Pose2 | None, *expected: float, atol: float = 1e-9) -> None:
    assert pose is not None
    np.testing.assert_allclose((pose.x_m, pose.y_m, pose.yaw_rad), expected, atol=atol)


def test_driving_straight_goes_speed_times_time() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=100.0, to_s=102.0)
    assert_pose(tracker.map_from_ego(100.0), 0.0, 0.0, 0.0)
    assert_pose(tracker.map_from_ego(101.234), 12.34, 0.0, 0.0)
    assert_pose(tracker.map_from_ego(102.0), 20.0, 0.0, 0.0)


def test_a_left_turn_of_a_quarter_circle_ends_one_radius_ahead_and_one_to_the_left() -> None:
    """10 m/s and pi/4 rad/s: a radius of 40/pi m, a quarter in 2 s."""
    tracker, radius_m = EgoTracker(), 40.0 / math.pi
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=math.pi / 4, from_s=0.0, to_s=2.0)
    assert_pose(tracker.map_from_ego(2.0), radius_m, radius_m, math.pi / 2)
    eighth = radius_m * math.sqrt(0.5)
    assert_pose(tracker.map_from_ego(1.0), eighth, radius_m - eighth, math.pi / 4)


def test_speed_that_comes_rarely_is_followed_linearly_between_its_samples() -> None:
    """v = 2 t from samples every 0.1 s, yaw rate every 0.01 s: the way is t squared."""
    tracker = EgoTracker()
    for tick in range(201):
        time_s = tick / 100.0
        tracker.motion(EgoMotion(timestamp_s=time_s, yaw_rate_rad_s=0.0))
        if tick % 10 == 0:
            tracker.motion(EgoMotion(timestamp_s=time_s, speed_mps=2.0 * time_s))
    assert_pose(tracker.map_from_ego(2.0), 4.0, 0.0, 0.0)
    assert_pose(tracker.map_from_ego(1.5), 2.25, 0.0, 0.0)
    state = tracker.at(1.25)
    assert state is not None
    np.testing.assert_allclose(state.velocity, (2.5, 0.0))


@settings(max_examples=60, deadline=None)
@given(
    steps_s=st.lists(st.floats(0.001, 0.15), min_size=5, max_size=60),
    is_speed=st.lists(st.booleans(), min_size=60, max_size=60),
    speed_mps=st.floats(-10.0, 60.0),
    yaw_rate_rad_s=st.floats(-1.0, 1.0),
)
def test_a_steady_motion_is_one_arc_however_its_messages_are_spread(
    steps_s: list[float], is_speed: list[bool], speed_mps: float, yaw_rate_rad_s: float
) -> None:
    tracker, time_s = EgoTracker(), 0.0
    tracker.motion(EgoMotion(timestamp_s=0.0, speed_mps=speed_mps, yaw_rate_rad_s=yaw_rate_rad_s))
    asked_s = []
    for step_s, says_speed in zip(steps_s, is_speed, strict=False):
        time_s += step_s
        said = {"speed_mps": speed_mps} if says_speed else {"yaw_rate_rad_s": yaw_rate_rad_s}
        tracker.motion(EgoMotion(timestamp_s=time_s, **said))
        asked_s.append(time_s - 0.4 * step_s)
    assume(tracker.epoch == 1)  # else one signal was silent for more than a second
    for at_s in asked_s:
        pose = tracker.map_from_ego(at_s)
        if pose is None:
            continue  # more than 0.2 s after the last word of one signal
        turn = yaw_rate_rad_s * at_s
        chord = speed_mps * at_s * np.sinc(turn / math.tau)
        expected = (chord * math.cos(turn / 2), chord * math.sin(turn / 2))
        np.testing.assert_allclose((pose.x_m, pose.y_m), expected, atol=1e-6)


def test_the_future_is_told_for_a_fifth_of_a_second_and_no_more() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.0, to_s=1.0)
    assert_pose(tracker.map_from_ego(1.199), 11.99, 0.0, 0.0)
    assert tracker.map_from_ego(1.201) is None
    assert tracker.map_from_ego(-0.001) is None


def test_the_last_five_seconds_are_remembered_at_a_hundred_messages_a_second_each() -> None:
    tracker = EgoTracker()
    for tick in range(6000):
        tracker.motion(EgoMotion(timestamp_s=tick / 100, speed_mps=1.0))
        tracker.motion(EgoMotion(timestamp_s=tick / 100 + 0.005, yaw_rate_rad_s=0.0))
    assert_pose(tracker.map_from_ego(54.99), 54.985, 0.0, 0.0, atol=1e-6)


@pytest.mark.parametrize("source", ["motion", "poses"])
@pytest.mark.parametrize("per_s", [1, 10, 50])
def test_ten_seconds_are_remembered_and_twenty_at_most(source: str, per_s: int) -> None:
    """However long it drives: a service that runs for days must not grow."""
    tracker = EgoTracker(max_pose_age_s=1.0)
    for tick in range(100 * per_s + 1):
        time_s = tick / per_s
        if source == "motion":
            tracker.motion(EgoMotion(timestamp_s=time_s, speed_mps=1.0, yaw_rate_rad_s=0.0))
        else:
            give_pose(tracker, time_s, time_s, 0.0, 0.0)
        if time_s > 30.0:
            assert_pose(tracker.map_from_ego(time_s - 9.9), time_s - 9.9, 0.0, 0.0)
            assert tracker.map_from_ego(time_s - 21.1) is None


def test_without_input_there_is_no_pose_unless_the_sensor_never_moves() -> None:
    assert EgoTracker().map_from_ego(1.0) is None
    state = EgoTracker(stationary=True).at(1.0)
    assert state is not None
    assert_pose(state.map_from_ego, 0.0, 0.0, 0.0)
    assert (state.velocity, state.yaw_rate_rad_s, state.has_map_pose) == ((0.0, 0.0), 0.0, False)


def test_speed_without_yaw_rate_is_not_enough() -> None:
    tracker = EgoTracker()
    for tick in range(100):
        tracker.motion(EgoMotion(timestamp_s=tick / 100, speed_mps=10.0))
    assert tracker.map_from_ego(0.99) is None


def test_samples_that_come_late_are_ignored_and_counted() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.0, to_s=1.0)
    tracker.motion(EgoMotion(timestamp_s=0.9, speed_mps=90.0))
    tracker.motion(EgoMotion(timestamp_s=1.0, yaw_rate_rad_s=3.0))
    assert tracker.counters.stale == 2
    assert_pose(tracker.map_from_ego(1.1), 11.0, 0.0, 0.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e6])
def test_values_that_cannot_be_are_refused_and_counted(bad: float) -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.0, to_s=1.0)
    tracker.motion(EgoMotion(timestamp_s=1.01, speed_mps=bad, yaw_rate_rad_s=bad))
    give_pose(tracker, 1.02, bad * 1e6, 0.0, 0.0)
    assert tracker.counters.refused == 3
    assert_pose(tracker.map_from_ego(1.1), 11.0, 0.0, 0.0)


def test_nothing_is_said_about_a_time_that_is_not_a_number() -> None:
    tracker = EgoTracker()
    tracker.motion(EgoMotion(timestamp_s=math.nan, speed_mps=1.0, yaw_rate_rad_s=0.0))
    give_pose(tracker, math.nan, 0.0, 0.0, 0.0)
    assert tracker.counters.refused == 3
    assert tracker.at(0.0) is None


def test_a_short_silence_is_bridged_and_a_long_one_starts_an_epoch() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.0, to_s=1.0)
    epoch = tracker.epoch
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=1.9, to_s=2.0)
    assert tracker.epoch == epoch
    assert_pose(tracker.map_from_ego(1.5), 15.0, 0.0, 0.0)
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=3.1, to_s=3.2)
    assert tracker.epoch == epoch + 1
    assert tracker.map_from_ego(1.5) is None
    assert tracker.map_from_ego(3.2) is not None


def test_one_silent_signal_starts_an_epoch_when_it_comes_back() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.0, to_s=1.0)
    epoch = tracker.epoch
    for tick in range(150):
        tracker.motion(EgoMotion(timestamp_s=1.02 + tick / 50, speed_mps=10.0))
    assert tracker.map_from_ego(4.0) is None
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=4.02, to_s=4.1)
    assert tracker.epoch == epoch + 1
    assert tracker.map_from_ego(4.1) is not None


def test_a_clock_set_back_starts_an_epoch_instead_of_ignoring_everything() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=1000.0, to_s=1001.0)
    epoch = tracker.epoch
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=5.0, to_s=6.0)
    assert tracker.epoch == epoch + 1
    assert tracker.map_from_ego(6.0) is not None


def test_between_two_poses_the_ego_is_on_the_arc_that_joins_them() -> None:
    """A quarter circle of 10 m radius in 0.4 s, asked halfway; no speed, no yaw rate."""
    tracker = EgoTracker()
    give_pose(tracker, 0.0, 100.0, 50.0, 0.0)
    give_pose(tracker, 0.4, 110.0, 60.0, math.pi / 2)
    half = 10.0 * math.sqrt(0.5)
    state = tracker.at(0.2)
    assert state is not None
    assert_pose(state.map_from_ego, 100.0 + half, 60.0 - half, math.pi / 4)
    assert state.has_map_pose
    np.testing.assert_allclose(state.velocity, (12.5 * math.pi, 0.0), atol=1e-9)
    assert state.yaw_rate_rad_s == pytest.approx(1.25 * math.pi)


def test_after_the_newest_pose_the_dead_reckoning_goes_on_from_it() -> None:
    """Heading north at 10 m/s from (1000, 500)."""
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.0, to_s=1.0)
    give_pose(tracker, 1.0, 1000.0, 500.0, math.pi / 2)
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=1.02, to_s=3.0)
    near, far = tracker.at(1.4), tracker.at(3.0)
    assert near is not None
    assert far is not None
    assert_pose(near.map_from_ego, 1000.0, 504.0, math.pi / 2)
    assert_pose(far.map_from_ego, 1000.0, 520.0, math.pi / 2)
    assert near.has_map_pose
    assert not far.has_map_pose  # the pose is 2 s old, more than the 0.5 s allowed


def test_a_pose_that_corrects_a_little_keeps_the_epoch_and_one_that_jumps_does_not() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.0, to_s=1.0)
    give_pose(tracker, 1.0, 500.0, 0.0, 0.0)
    epoch = tracker.epoch
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=1.02, to_s=1.1)
    give_pose(tracker, 1.1, 501.0, 0.6, 0.02)  # 501 was expected
    assert (tracker.epoch, tracker.counters.pose_jumps) == (epoch, 0)
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=1.12, to_s=1.2)
    give_pose(tracker, 1.2, 504.0, 0.6, 0.02)
    assert (tracker.epoch, tracker.counters.pose_jumps) == (epoch + 1, 1)
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=1.22, to_s=1.3)
    give_pose(tracker, 1.3, 505.0, 0.6, 0.2)
    assert (tracker.epoch, tracker.counters.pose_jumps) == (epoch + 2, 2)
    assert_pose(tracker.map_from_ego(1.3), 505.0, 0.6, 0.2)


def test_the_first_pose_starts_an_epoch_because_the_frame_is_another() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.0, to_s=1.0)
    epoch = tracker.epoch
    give_pose(tracker, 1.0, 10.0, 0.0, 0.0)
    assert tracker.epoch == epoch + 1


def test_a_pose_source_alone_moves_the_ego() -> None:
    """20 Hz poses going east at 30 m/s, no CAN motion: one epoch, told 0.2 s ahead."""
    tracker = EgoTracker()
    for tick in range(41):
        give_pose(tracker, tick / 20, 1.5 * tick, 0.0, 0.0)
    assert tracker.epoch == 1
    state = tracker.at(2.1)
    assert state is not None
    assert_pose(state.map_from_ego, 63.0, 0.0, 0.0)
    np.testing.assert_allclose(state.velocity, (30.0, 0.0), atol=1e-9)
    assert tracker.at(2.21) is None


def test_a_steady_pose_source_outlives_a_failure_of_the_speed_message() -> None:
    tracker = EgoTracker()
    for tick in range(200):
        time_s = tick / 50
        give_pose(tracker, time_s, 0.2 * tick, 0.0, 0.0)
        said = {} if 50 < tick < 150 else {"speed_mps": 10.0}
        tracker.motion(EgoMotion(timestamp_s=time_s, yaw_rate_rad_s=0.0, **said))
        if tick > 1:
            assert_pose(tracker.map_from_ego(time_s), 0.2 * tick, 0.0, 0.0, atol=1e-6)
    assert tracker.counters.pose_jumps == 0
    assert tracker.epoch <= 2  # where the poses began, and the dead reckoning before them


def test_poses_that_end_before_the_dead_reckoning_begins_are_where_it_begins() -> None:
    tracker = EgoTracker()
    give_pose(tracker, 0.0, 100.0, 0.0, 0.0)
    give_pose(tracker, 0.1, 101.0, 0.0, 0.0)
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=0.3, to_s=3.0)
    state = tracker.at(3.0)
    assert state is not None
    assert not state.has_map_pose
    assert 110.0 < state.map_from_ego.x_m < 130.0


@pytest.mark.parametrize("half", [{"speed_mps": 3.0}, {"yaw_rate_rad_s": 0.1}])
def test_a_stationary_sensor_stands_until_all_of_its_motion_is_told(half: dict[str, float]) -> None:
    """Half of it says nothing: it does not make a sensor that stands one without ego motion."""
    tracker = EgoTracker(stationary=True)
    for tick in range(50):
        tracker.motion(EgoMotion(timestamp_s=tick / 10, **half))
    state = tracker.at(4.9)
    assert state is not None
    assert_pose(state.map_from_ego, 0.0, 0.0, 0.0)
    assert state.velocity[0] == 0.0
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.0, from_s=5.0, to_s=6.0)
    state = tracker.at(6.0)
    assert state is not None
    assert state.velocity[0] == pytest.approx(10.0)


def test_a_stationary_sensor_keeps_the_pose_it_was_given() -> None:
    tracker = EgoTracker(stationary=True)
    give_pose(tracker, 0.0, 7.0, 8.0, 0.5)
    state = tracker.at(3600.0)
    assert state is not None
    assert state.has_map_pose
    assert_pose(state.map_from_ego, 7.0, 8.0, 0.5)


def test_late_poses_are_ignored_and_counted() -> None:
    tracker = EgoTracker()
    give_pose(tracker, 1.0, 0.0, 0.0, 0.0)
    give_pose(tracker, 0.9, 50.0, 0.0, 0.0)
    give_pose(tracker, 1.0, 50.0, 0.0, 0.0)
    assert (tracker.counters.stale, tracker.counters.poses, tracker.epoch) == (2, 1, 1)


def test_the_bias_is_what_the_yaw_rate_says_while_the_car_stands() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=10.0, yaw_rate_rad_s=0.05, from_s=0.0, to_s=10.0)
    assert tracker.yaw_rate_bias.value_rad_s == 0.0
    std_rad_s = tracker.yaw_rate_bias.std_rad_s
    drive_steadily(tracker, speed_mps=0.0, yaw_rate_rad_s=-0.007, from_s=10.02, to_s=30.0)
    assert tracker.yaw_rate_bias.value_rad_s == pytest.approx(-0.007, abs=1e-4)
    assert tracker.yaw_rate_bias.std_rad_s < std_rad_s / 5
    state = tracker.at(30.0)
    assert state is not None
    assert state.yaw_rate_rad_s == pytest.approx(0.0, abs=1e-4)


NUMBERS = st.one_of(st.floats(-200.0, 200.0), st.floats(), st.sampled_from([0.0, math.nan, 1e7]))
STEPS_S = st.one_of(st.floats(0.0, 0.1), st.floats(-3.0, 3.0), st.just(math.nan))


@settings(max_examples=100, deadline=None)
@given(
    inputs=st.lists(st.tuples(STEPS_S, st.integers(0, 3), NUMBERS, NUMBERS), max_size=60),
    stationary=st.booleans(),
)
def test_whatever_comes_the_tracker_neither_fails_nor_tells_what_is_not_a_number(
    inputs: list[tuple[float, int, float, float]], stationary: bool
) -> None:
    tracker, time_s = EgoTracker(stationary=stationary), 50.0
    for step_s, kind, first, second in inputs:
        said_s = time_s + step_s
        time_s = said_s if math.isfinite(said_s) else time_s
        if kind == 3:
            give_pose(tracker, said_s, first, second, first)
        else:
            speed, yaw_rate = (None, first, first)[kind], (second, None, second)[kind]
            motion = EgoMotion(timestamp_s=said_s, speed_mps=speed, yaw_rate_rad_s=yaw_rate)
            tracker.motion(motion)
        for asked_s in (time_s - 0.5, time_s, time_s + 0.1, said_s):
            state = tracker.at(asked_s)
            if state is not None:
                pose = state.map_from_ego
                told = (pose.x_m, pose.y_m, pose.yaw_rad, *state.velocity, state.yaw_rate_rad_s)
                assert all(map(math.isfinite, told))


def test_a_car_that_is_not_heard_of_is_not_taken_to_stand() -> None:
    """It stood, its speed falls silent, and it drives round a roundabout until it is back."""
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=0.0, yaw_rate_rad_s=0.001, from_s=0.0, to_s=5.0)
    value_rad_s = tracker.yaw_rate_bias.value_rad_s
    for tick in range(1000):
        tracker.motion(EgoMotion(timestamp_s=5.02 + 0.02 * tick, yaw_rate_rad_s=0.04))
    assert tracker.yaw_rate_bias.value_rad_s == value_rad_s
    drive_steadily(tracker, speed_mps=0.0, yaw_rate_rad_s=0.001, from_s=25.02, to_s=30.0)
    assert tracker.yaw_rate_bias.value_rad_s == pytest.approx(0.001, abs=1e-4)


def test_the_bias_is_learned_from_speeds_of_twice_a_second() -> None:
    tracker = EgoTracker()
    for tick in range(1500):
        speed = 0.0 if tick % 25 == 0 else None
        motion = EgoMotion(timestamp_s=0.02 * tick, speed_mps=speed, yaw_rate_rad_s=-0.007)
        tracker.motion(motion)
    assert tracker.yaw_rate_bias.value_rad_s == pytest.approx(-0.007, abs=1e-4)


def test_a_car_on_a_turntable_does_not_spoil_the_bias() -> None:
    tracker = EgoTracker()
    drive_steadily(tracker, speed_mps=0.0, yaw_rate_rad_s=0.2, from_s=0.0, to_s=10.0)
    assert tracker.yaw_rate_bias.value_rad_s == 0.0


def drive_with_poses(tracker: EgoTracker, *, spoiled_at: int | None = None) -> None:
    """A minute of bends at 20 m/s; yaw rate 0.5 deg/s too high, speed 2 % too high, 10 Hz poses."""
    rng = np.random.default_rng(1)
    truth, dt_s = Pose2(), 0.02
    for tick in range(3000):
        time_s, yaw_rate = tick * dt_s, 0.1 * math.sin(tick * dt_s / 3.0)
        tracker.motion(
            EgoMotion(
                timestamp_s=time_s,
                speed_mps=20.0 * 1.02,
                yaw_rate_rad_s=yaw_rate + math.radians(0.5),
            )
        )
        if tick % 5 == 0:
            noise_m, noise_rad = rng.normal(0.0, 0.05, 2), rng.normal(0.0, math.radians(0.3))
            away_m = 300.0 if tick == spoiled_at else 0.0
            give_pose(
                tracker,
                time_s,
                truth.x_m + noise_m[0] + away_m,
                truth.y_m + noise_m[1],
                truth.yaw_rad + noise_rad + away_m / 100.0,
            )
        truth = truth @ Pose2(20.0 * dt_s, 0.0, 0.0) @ Pose2(0.0, 0.0, yaw_rate * dt_s)


@pytest.mark.parametrize("spoiled_at", [None, 1000])
def test_bias_and_speed_scale_are_learned_from_poses(spoiled_at: int | None) -> None:
    """And a pose that is far off in between changes nothing about it."""
    tracker = EgoTracker()
    drive_with_poses(tracker, spoiled_at=spoiled_at)
    bias, scale = tracker.yaw_rate_bias, tracker.speed_scale
    assert math.degrees(bias.value_rad_s) == pytest.approx(0.5, abs=0.05)
    assert math.degrees(bias.std_rad_s) < 0.06
    assert scale.value == pytest.approx(1 / 1.02, abs=0.005)
    assert scale.std < 0.005
    assert tracker.counters.pose_jumps == (0 if spoiled_at is None else 2)


def test_rav4_drifts_no_more_than_its_yaw_rate_bias_explains(drive: Drive) -> None:
    """Against the GNSS track, median over 109 windows: 0.39 m in 2 s, 1.75 m in 5 s."""
    drift_m = drive.drift([(0.0, 1.0)] * len(drive.window_starts_s))
    assert drift_m[2.0] <= 0.39
    assert drift_m[5.0] <= 1.75


def test_rav4_drifts_less_with_the_bias_known(drive: Drive) -> None:
    drift_m = drive.drift([(math.radians(-0.42), 1.0)] * len(drive.window_starts_s))
    assert drift_m[2.0] <= 0.31
    assert drift_m[5.0] <= 0.77


def test_rav4_drifts_a_tenth_with_what_was_learned_from_poses_before(drive: Drive) -> None:
    learned = drive.learn()
    drift_m = drive.drift(learned)
    assert drift_m[2.0] <= 0.10
    assert drift_m[5.0] <= 0.25
    assert math.degrees(learned[-1][0]) == pytest.approx(-0.41, abs=0.04)
