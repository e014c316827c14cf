"""Identity, the map frame and the model's clock: what becomes of detections."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.detections import Detections, EgoMotion, ObjectClass, VelocityKind
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.tracking.ego import EgoState, EgoTracker
from eqrt.runtime.tracking.track_history import resample
from eqrt.runtime.tracking.tracks import TrackStore
from rav4_drive import read_events

AT_ORIGIN = Pose2()
ARS408_LOG = Path(__file__).parents[1] / "data" / "can" / "ars408" / "candump.log.gz"
Float64 = NDArray[np.float64]


def see(
    time_s: float,
    objects: dict[int, tuple[float, float]] | Sequence[tuple[int, tuple[float, float]]],
    *,
    new: Sequence[int] = (),
    sensor: str = "radar",
    velocity: tuple[float, float] = (math.nan, math.nan),
    kind: VelocityKind = VelocityKind.NONE,
    heading_rad: float = math.nan,
) -> Detections:
    """A cycle that sees objects (id -> x, y in metres, sensor frame)."""
    items = list(objects.items()) if isinstance(objects, dict) else list(objects)
    ids = np.array([object_id for object_id, _ in items], np.int64)
    nothing = np.full(len(items), math.nan)
    return Detections(
        sensor=sensor,
        timestamp_s=time_s,
        received_s=time_s + 0.005,
        complete=True,
        object_id=ids,
        is_new=np.isin(ids, np.array(new, np.int64)),
        position=np.array([place for _, place in items], np.float64).reshape(-1, 2),
        velocity=np.tile(np.array(velocity), (len(items), 1)),
        velocity_kind=kind,
        heading_rad=np.full(len(items), heading_rad),
        length_m=nothing,
        width_m=nothing,
        object_class=np.full(len(items), ObjectClass.CAR, np.uint8),
        existence=nothing,
    )


def standing(pose: Pose2 = AT_ORIGIN, epoch: int = 0) -> EgoState:
    return moving(pose, epoch=epoch)


def moving(
    pose: Pose2, *, speed_mps: float = 0.0, yaw_rate_rad_s: float = 0.0, epoch: int = 0
) -> EgoState:
    return EgoState(
        map_from_ego=pose,
        velocity=(speed_mps, 0.0),
        yaw_rate_rad_s=yaw_rate_rad_s,
        has_map_pose=True,
        epoch=epoch,
    )


def ids_by_object(store: TrackStore, now_s: float, max_age_s: float = 0.3) -> dict[int, int]:
    tracks = store.snapshot(now_s, max_age_s)
    return dict(zip(tracks.object_id.tolist(), tracks.track_id.tolist(), strict=True))


# --- identity ---------------------------------------------------------------------------------


def test_an_object_keeps_its_track_while_its_id_goes_on() -> None:
    store = TrackStore()
    for k in range(20):
        store.update(see(k * 0.05, {7: (10.0 + k, 0.0), 9: (50.0, 5.0)}), standing(), AT_ORIGIN)
    tracks = store.snapshot(0.95)
    assert ids_by_object(store, 0.95) == {7: 1, 9: 2}
    np.testing.assert_array_equal(tracks.position, [[29.0, 0.0], [50.0, 5.0]])
    np.testing.assert_array_equal(tracks.num_measurements, [20, 20])
    np.testing.assert_allclose(tracks.timestamp_s, [0.95, 0.95])
    np.testing.assert_array_equal(tracks.object_class, [ObjectClass.CAR] * 2)
    assert store.counters.tracks == 2


@pytest.mark.parametrize(
    ("next_s", "place", "new", "epoch"),
    [
        pytest.param(1.05, (20.0, 0.0), (7,), 0, id="the sensor says that it is new"),
        pytest.param(1.301, (20.0, 0.0), (), 0, id="a gap of more than 0.3 s"),
        pytest.param(1.05, (60.0, 0.0), (), 0, id="a jump that no vehicle makes"),
        pytest.param(1.05, (20.0, 0.0), (), 1, id="the map frame jumped"),
    ],
)
def test_another_object_under_the_same_id_gets_another_track_and_no_past(
    next_s: float, place: tuple[float, float], new: tuple[int, ...], epoch: int
) -> None:
    store = TrackStore()
    for k in range(11):
        store.update(see(0.5 + k * 0.05, {7: (20.0, 0.0)}), standing(), AT_ORIGIN)
    store.update(see(next_s, {7: place}, new=new), standing(epoch=epoch), AT_ORIGIN)
    tracks = store.snapshot(next_s, max_age_s=2.0)
    np.testing.assert_array_equal(tracks.track_id, [2])
    np.testing.assert_array_equal(tracks.num_measurements, [1])
    _, valid = store.history(next_s, 10, 0.1, tracks.row)
    np.testing.assert_array_equal(valid, [[False] * 9 + [True]])


def test_a_gap_of_up_to_three_tenths_of_a_second_keeps_the_track() -> None:
    store = TrackStore()
    for time_s in (1.0, 1.05, 1.35, 1.65):
        store.update(see(time_s, {7: (20.0, 0.0)}), standing(), AT_ORIGIN)
    assert ids_by_object(store, 1.65) == {7: 1}


def test_a_vehicle_that_brakes_hard_keeps_its_track() -> None:
    """From 30 m/s at 10 m/s2, told at 20 Hz with half a metre of noise."""
    store, rng = TrackStore(), np.random.default_rng(0)
    for k in range(60):
        time_s = k * 0.05
        place = (10.0 + 30.0 * time_s - 5.0 * time_s**2, rng.uniform(-0.5, 0.5))
        store.update(see(time_s, {7: place}), standing(), AT_ORIGIN)
    assert ids_by_object(store, 60 * 0.05) == {7: 1}


def test_track_ids_are_never_given_again() -> None:
    store = TrackStore(capacity=4)
    given_ids: set[int] = set()
    for k in range(50):
        store.update(see(k * 0.05, {k % 3: (20.0, 0.0)}, new=range(3)), standing(), AT_ORIGIN)
        given_ids.update(ids_by_object(store, k * 0.05, max_age_s=0.0).values())
    assert given_ids == set(range(1, 51))


def test_two_sensors_may_use_the_same_id_for_different_objects() -> None:
    store = TrackStore()
    for k in range(10):
        store.update(see(k * 0.1, {7: (20.0, 0.0)}, sensor="front"), standing(), AT_ORIGIN)
        store.update(see(k * 0.1 + 0.03, {7: (-20.0, 0.0)}, sensor="rear"), standing(), AT_ORIGIN)
    tracks = store.snapshot(0.93)
    np.testing.assert_array_equal(tracks.object_id, [7, 7])
    np.testing.assert_array_equal(tracks.position[:, 0], [20.0, -20.0])
    assert [store.sensors[index] for index in tracks.sensor] == ["front", "rear"]
    assert store.counters.tracks == 2


def test_of_an_id_said_twice_in_a_cycle_the_first_counts() -> None:
    store = TrackStore()
    store.update(
        see(1.0, [(3, (10.0, 0.0)), (3, (90.0, 0.0)), (4, (5.0, 5.0))]), standing(), AT_ORIGIN
    )
    np.testing.assert_array_equal(store.snapshot(1.0).position, [[10.0, 0.0], [5.0, 5.0]])
    assert store.counters.duplicates == 1


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e9])
def test_a_position_that_cannot_be_is_refused_and_the_others_are_not(bad: float) -> None:
    store = TrackStore()
    store.update(see(1.0, {1: (bad, 0.0), 2: (10.0, bad), 3: (10.0, 0.0)}), standing(), AT_ORIGIN)
    np.testing.assert_array_equal(store.snapshot(1.0).object_id, [3])
    assert store.counters.refused == 2


@pytest.mark.parametrize("bad", [math.inf, 1e9])
def test_a_velocity_or_heading_that_cannot_be_is_not_known(bad: float) -> None:
    store = TrackStore()
    detections = see(
        1.0,
        {1: (10.0, 0.0)},
        velocity=(bad, 0.0),
        kind=VelocityKind.RELATIVE,
        heading_rad=math.inf,
    )
    store.update(detections, standing(), AT_ORIGIN)
    tracks = store.snapshot(1.0)
    assert np.isnan(tracks.velocity).all()
    assert np.isnan(tracks.heading_rad).all()


def test_an_older_cycle_of_the_same_sensor_changes_nothing() -> None:
    store = TrackStore()
    for time_s in (1.0, 1.1, 1.05, 1.1):
        store.update(see(time_s, {7: (10.0 * time_s, 0.0)}), standing(), AT_ORIGIN)
    np.testing.assert_array_equal(store.snapshot(1.1).position, [[11.0, 0.0]])
    np.testing.assert_array_equal(store.snapshot(1.1).num_measurements, [2])
    assert store.counters.late == 2


def test_a_clock_set_back_forgets_the_tracks_instead_of_refusing_all_cycles() -> None:
    store = TrackStore()
    store.update(see(1000.0, {7: (10.0, 0.0)}), standing(), AT_ORIGIN)
    store.update(see(5.0, {7: (10.0, 0.0)}), standing(), AT_ORIGIN)
    assert ids_by_object(store, 5.0) == {7: 2}
    assert store.counters.resets == 1


def test_a_cycle_whose_ego_pose_is_not_known_is_counted_and_ignored() -> None:
    store = TrackStore()
    store.update(see(1.0, {7: (10.0, 0.0)}), None, AT_ORIGIN)
    assert store.counters.without_ego == 1
    assert len(store.snapshot(1.0).row) == 0


def test_an_empty_cycle_is_a_cycle() -> None:
    store = TrackStore()
    store.update(see(1.0, {}), standing(), AT_ORIGIN)
    assert store.counters.cycles == 1
    positions, valid = store.history(1.0, 20, 0.1, store.snapshot(1.0).row)
    assert positions.shape == (0, 20, 2)
    assert valid.shape == (0, 20)


def test_a_full_store_forgets_the_stalest_track() -> None:
    store = TrackStore(capacity=3)
    for time_s, object_id in ((1.0, 1), (1.1, 2), (1.2, 3), (1.3, 2), (1.4, 4)):
        store.update(see(time_s, {object_id: (10.0, 0.0)}), standing(), AT_ORIGIN)
    assert ids_by_object(store, 1.4, max_age_s=9.0) == {2: 2, 3: 3, 4: 4}
    assert store.counters.dropped == 1


def test_a_full_store_forgets_no_track_that_may_go_on() -> None:
    """Object 1 was seen 0.3 s ago: object 4 has to wait for the next cycle."""
    store = TrackStore(capacity=3)
    store.update(see(1.0, {n: (10.0 * n, 0.0) for n in (1, 2, 3)}), standing(), AT_ORIGIN)
    for time_s, there in ((1.3, {1: 1, 2: 2, 3: 3}), (1.35, {2: 2, 3: 3, 4: 4})):
        seen = {n: (10.0 * n, 0.0) for n in (2, 3, 4)}
        store.update(see(time_s, seen), standing(), AT_ORIGIN)
        assert ids_by_object(store, time_s) == there
    assert store.counters.dropped == 2


@pytest.mark.parametrize("late_s", [0.0, 0.35])
def test_sensors_with_too_many_objects_do_not_drive_out_each_others(late_s: float) -> None:
    """300 that stand still, and room for 256: those that came first have full histories."""
    store = TrackStore()
    for k in range(30):
        for n, sensor in enumerate(("front", "left", "right")):
            time_s = 0.1 * k + 0.01 * n
            seen = {i: (10.0 + i, 5.0 * n) for i in range(100)}
            cycle = see(time_s - n * late_s, seen, sensor=sensor)
            store.update(replace(cycle, received_s=time_s), standing(), AT_ORIGIN)
    tracks = store.snapshot(2.9)
    assert store.counters.tracks == len(tracks.row) == 256
    assert store.counters.dropped == 30 * (300 - 256)
    for anchor_s in np.unique(tracks.timestamp_s):
        _, valid = store.history(anchor_s, 20, 0.1, tracks.row)
        assert valid[tracks.timestamp_s == anchor_s].all()


def test_more_objects_than_the_store_holds_leave_those_that_came_first() -> None:
    store = TrackStore(capacity=3)
    store.update(see(1.0, {2: (10.0, 0.0)}), standing(), AT_ORIGIN)
    crowd = {object_id: (10.0 * object_id, 0.0) for object_id in (5, 4, 1, 3)} | {2: (10.0, 0.0)}
    store.update(see(1.1, crowd), standing(), AT_ORIGIN)
    assert ids_by_object(store, 1.1) == {2: 1, 5: 2, 4: 3}
    assert store.counters.dropped == 2


def test_a_snapshot_shows_what_was_seen_lately() -> None:
    store = TrackStore()
    store.update(see(1.0, {1: (10.0, 0.0)}), standing(), AT_ORIGIN)
    store.update(see(1.2, {2: (10.0, 0.0)}), standing(), AT_ORIGIN)
    assert set(ids_by_object(store, 1.3)) == {1, 2}
    assert set(ids_by_object(store, 1.31)) == {2}


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_no_history_ever_mixes_two_objects(data: st.DataObject) -> None:
    """Twelve objects, 60 m apart, wander under four ids that are dealt anew without any flag."""
    store, time_s = TrackStore(capacity=8), 100.0
    for _ in range(data.draw(st.integers(5, 40))):
        time_s += data.draw(st.sampled_from([0.0, 0.02, 0.05, 0.1, 0.29, 0.31, 2.5]))
        dealt = data.draw(st.dictionaries(st.integers(0, 3), st.integers(0, 11), max_size=4))
        wander = data.draw(st.floats(-1.0, 1.0))
        seen = {key: (60.0 * thing + wander, wander) for key, thing in dealt.items()}
        store.update(see(time_s, seen), standing(), AT_ORIGIN)
        tracks = store.snapshot(time_s, max_age_s=10.0)
        assert len(set(tracks.track_id.tolist())) == len(tracks.track_id)
        assert len(set(tracks.object_id.tolist())) == len(tracks.object_id)
        positions, valid = store.history(time_s, 30, 0.1, tracks.row)
        for track, seen_at in zip(positions, valid, strict=True):
            assert len(set(np.round(track[seen_at, 0] / 60.0))) <= 1


# --- the map frame ----------------------------------------------------------------------------


def test_a_static_object_stays_where_it_is_while_the_ego_turns_on_the_spot() -> None:
    """A radar 3 m ahead and 1 m to the left, looking 90 degrees left; the ego spins at 0.5 rad/s.

    The object stands at (10, 5) in the map; relative to the moving mount point it moves.
    """
    store, ego_from_radar = TrackStore(), Pose2(3.0, 1.0, math.pi / 2)
    ego, spin = EgoTracker(), 0.5
    for k in range(60):
        time_s = k * 0.05
        ego.motion(EgoMotion(timestamp_s=time_s, speed_mps=0.0, yaw_rate_rad_s=spin))
        map_from_radar = Pose2(0.0, 0.0, spin * time_s) @ ego_from_radar
        mount_velocity = Pose2(0.0, 0.0, spin * time_s).rotate(spin * np.array([-1.0, 3.0]))
        seen = map_from_radar.inverse().apply(np.array([10.0, 5.0]))
        relative = map_from_radar.inverse().rotate(-mount_velocity)
        detections = see(
            time_s,
            {1: (seen[0], seen[1])},
            velocity=(relative[0], relative[1]),
            kind=VelocityKind.RELATIVE,
            heading_rad=-map_from_radar.yaw_rad,
        )
        store.update(detections, ego.at(time_s), ego_from_radar)
        tracks = store.snapshot(time_s)
        np.testing.assert_allclose(tracks.position, [[10.0, 5.0]], atol=1e-6)
        np.testing.assert_allclose(tracks.velocity, [[0.0, 0.0]], atol=1e-6)
        np.testing.assert_allclose(np.sin(tracks.heading_rad), [0.0], atol=1e-6)
    assert not tracks.is_moving.any()
    assert store.counters.tracks == 1


def test_a_parked_car_ahead_of_a_moving_ego_has_no_velocity_over_ground() -> None:
    """Ego drives north at 15 m/s; RELATIVE says 15 m/s towards us, ABSOLUTE says nothing moves."""
    north = moving(Pose2(100.0, 200.0, math.pi / 2), speed_mps=15.0)
    for kind, velocity in ((VelocityKind.RELATIVE, -15.0), (VelocityKind.ABSOLUTE, 0.0)):
        store = TrackStore()
        store.update(
            see(1.0, {1: (30.0, 0.0)}, velocity=(velocity, 0.0), kind=kind), north, AT_ORIGIN
        )
        tracks = store.snapshot(1.0)
        np.testing.assert_allclose(tracks.position, [[100.0, 230.0]])
        np.testing.assert_allclose(tracks.velocity, [[0.0, 0.0]], atol=1e-12)


def test_a_radial_velocity_alone_is_not_a_velocity() -> None:
    store = TrackStore()
    detections = see(1.0, {1: (30.0, 0.0)}, velocity=(-15.0, 0.0), kind=VelocityKind.RADIAL)
    store.update(detections, standing(), AT_ORIGIN)
    assert np.isnan(store.snapshot(1.0).velocity).all()


def test_what_moves_is_told_from_the_displacement_of_the_last_second() -> None:
    """A lorry at 12 m/s, a pedestrian at 0.5 m/s, and one of whom too little was seen."""
    store = TrackStore()
    for k in range(21):
        seen = {1: (30.0 + 0.6 * k, 0.0), 2: (10.0, 0.025 * k)} | (
            {3: (50.0, 0.0)} if k > 18 else {}
        )
        store.update(see(k * 0.05, seen), standing(), AT_ORIGIN)
    tracks = store.snapshot(1.0)
    np.testing.assert_allclose(tracks.speed_mps, [12.0, 0.5, math.nan])
    np.testing.assert_array_equal(tracks.is_moving, [True, False, False])
    assert np.isnan(tracks.velocity).all()


# --- the model's clock ------------------------------------------------------------------------


def ring(*samples: tuple[float, float], depth: int = 8) -> tuple[Float64, Float64]:
    """Measurements (time, x) of one track as the store keeps them; y is ten times x."""
    times_s, positions = np.full((1, depth), -np.inf), np.full((1, depth, 2), np.nan)
    times_s[0, depth - len(samples) :] = [time_s for time_s, _ in samples]
    positions[0, depth - len(samples) :] = [(x, 10.0 * x) for _, x in samples]
    return times_s, positions


def test_steps_between_measurements_lie_on_the_straight_line_between_them() -> None:
    """Measured at 0.95, 1.05 and 1.15 s; steps at 0.9, 1.0 and 1.1 s."""
    times_s, positions = ring((0.95, 2.0), (1.05, 4.0), (1.15, 10.0))
    resampled, valid = resample(times_s, positions, now_s=1.1, steps=3, dt_s=0.1)
    np.testing.assert_array_equal(valid, [[False, True, True]])
    np.testing.assert_allclose(resampled[0, 1:], [[3.0, 30.0], [7.0, 70.0]])
    assert np.isnan(resampled[0, 0]).all()


@pytest.mark.parametrize("start_s", [0.0, 1.7e9])
def test_a_measurement_at_the_step_itself_is_taken_as_it_is(start_s: float) -> None:
    """Also the only one, the newest one, and with clocks that count from 1970."""
    times_s, positions = ring((start_s + 0.5, 2.0), (start_s + 1.1, 4.0))
    resampled, valid = resample(times_s, positions, now_s=start_s + 1.1, steps=8, dt_s=0.1)
    np.testing.assert_array_equal(valid[0], [False, True, *[False] * 5, True])
    np.testing.assert_array_equal(resampled[0, [1, 7], 0], [2.0, 4.0])


def test_nothing_is_told_after_the_newest_measurement_or_before_the_oldest() -> None:
    times_s, positions = ring((1.0, 2.0), (1.1, 3.0))
    _, valid = resample(times_s, positions, now_s=1.25, steps=4, dt_s=0.1)
    np.testing.assert_array_equal(valid, [[False, True, False, False]])  # 0.95 1.05 1.15 1.25


@pytest.mark.parametrize(
    ("gap_s", "expected"),
    [
        pytest.param(0.3, [True, True, True, True], id="0.3 s apart: joined"),
        pytest.param(0.32, [True, False, False, True], id="0.32 s apart: not joined"),
    ],
)
def test_a_gap_is_never_bridged(gap_s: float, expected: list[bool]) -> None:
    times_s, positions = ring((1.0, 0.0), (1.0 + gap_s, 3.0))
    _, valid = resample(times_s, positions, now_s=1.0 + gap_s, steps=4, dt_s=gap_s / 3)
    np.testing.assert_array_equal(valid[0], expected)


def test_a_step_needs_a_measurement_within_one_step_of_it() -> None:
    """0.3 s apart on a clock of 0.05 s: only the steps next to a measurement are true."""
    times_s, positions = ring((1.0, 0.0), (1.3, 3.0))
    resampled, valid = resample(times_s, positions, now_s=1.3, steps=7, dt_s=0.05)
    np.testing.assert_array_equal(valid[0], [True, True, False, False, False, True, True])
    np.testing.assert_allclose(resampled[0, valid[0], 0], [0.0, 0.5, 2.5, 3.0])


@settings(max_examples=150, deadline=None)
@given(
    gaps_s=st.lists(
        st.lists(st.floats(0.004, 0.5), min_size=1, max_size=15), min_size=1, max_size=5
    ),
    dt_s=st.sampled_from([0.05, 0.1, 0.2]),
    start_s=st.sampled_from([0.0, 5e4, 1.7e9]),
    late_s=st.floats(-0.5, 0.5),
)
def test_resampling_says_what_its_rules_say_step_by_step(
    gaps_s: list[list[float]], dt_s: float, start_s: float, late_s: float
) -> None:
    rng, depth, steps = np.random.default_rng(0), 12, 10
    times_s, positions = (
        np.full((len(gaps_s), depth), -np.inf),
        np.full((len(gaps_s), depth, 2), np.nan),
    )
    for track, gaps in enumerate(gaps_s):
        kept = (start_s + np.cumsum(gaps))[-depth:]
        times_s[track, depth - len(kept) :] = kept
        positions[track, depth - len(kept) :] = rng.normal(0.0, 100.0, (len(kept), 2))
    newest_s = times_s.max() if np.isfinite(times_s).any() else start_s
    now_s = float(newest_s + late_s)
    resampled, valid = resample(times_s, positions, now_s, steps, dt_s)
    for track in range(len(gaps_s)):
        real = np.isfinite(times_s[track])
        for step in range(steps):
            expected = one_step(
                times_s[track, real],
                positions[track, real],
                now_s - (steps - 1 - step) * dt_s,
                dt_s,
            )
            assert valid[track, step] == (expected is not None)
            if expected is not None:
                np.testing.assert_allclose(resampled[track, step], expected, atol=0.06)


def one_step(times_s: Float64, positions: Float64, step_s: float, dt_s: float) -> Float64 | None:
    """The rules in plain words; a microsecond is what a clock from 1970 may be off."""
    hit = np.abs(times_s - step_s) <= 1e-6
    if hit.any():
        return np.asarray(positions[hit][0])
    before, after = np.flatnonzero(times_s < step_s), np.flatnonzero(times_s > step_s)
    if not len(before) or not len(after):
        return None
    k = before[-1]
    start_s, end_s = times_s[k], times_s[k + 1]
    if end_s - start_s > 0.3 + 1e-6 or min(step_s - start_s, end_s - step_s) > dt_s + 1e-6:
        return None
    weight = (step_s - start_s) / (end_s - start_s)
    return np.asarray((1.0 - weight) * positions[k] + weight * positions[k + 1])


def test_every_track_ends_on_its_own_measurement_when_the_clock_is_anchored_there() -> None:
    """A radar at 20 Hz and a camera at 15 Hz: 20 steps of 0.1 s end on each one's last word."""
    store = TrackStore()
    radar = [see(k / 20, {1: (10.0 + k / 20, 0.0)}) for k in range(60)]
    camera = [see(0.013 + k / 15, {1: (30.0, k / 15)}, sensor="camera") for k in range(44)]
    for cycle in sorted([*radar, *camera], key=lambda cycle: cycle.timestamp_s):
        store.update(cycle, standing(), AT_ORIGIN)
    tracks = store.snapshot(2.95)
    assert len(tracks.row) == 2
    for k, anchor_s in enumerate(tracks.timestamp_s):
        positions, valid = store.history(float(anchor_s), 20, 0.1, tracks.row)
        assert valid[k].all()
        np.testing.assert_array_equal(positions[k, -1], tracks.position[k])
        speed = np.linalg.norm(np.diff(positions[k], axis=0), axis=1) / 0.1
        np.testing.assert_allclose(speed, 1.0)


def followed_for(store: TrackStore, times_s: Sequence[float]) -> None:
    """An object that drives 10 m/s and is seen at these times."""
    for time_s in times_s:
        store.update(see(time_s, {1: (10.0 * time_s, 0.0)}), standing(), AT_ORIGIN)


@pytest.mark.parametrize(("steps", "dt_s"), [(20, 0.1), (50, 0.1), (40, 0.05), (5, 0.5), (1, 0.1)])
@pytest.mark.parametrize("rate_hz", [5, 10, 14, 20, 24, 26, 33, 40, 50, 77, 100, 400])
def test_a_history_reaches_as_far_back_as_the_model_asks_however_fast_the_sensor_is(
    rate_hz: int, steps: int, dt_s: float
) -> None:
    """On the clock of a target that was last seen 0.3 s before the newest measurement, too."""
    store = TrackStore(steps, dt_s)
    past_s = max(1.0, (steps - 1) * dt_s) + 1.0
    times_s = [k / rate_hz for k in range(round(past_s * rate_hz) + 1)]
    followed_for(store, times_s)
    tracks = store.snapshot(times_s[-1])
    assert tracks.timestamp_s == times_s[-1]
    assert tracks.num_measurements == len(times_s)
    for now_s in (times_s[-1], times_s[-1] - 0.3):
        clock_s = now_s - dt_s * np.arange(steps - 1, -1, -1)
        positions, valid = store.history(now_s, steps, dt_s, tracks.row)
        near_s = np.abs(np.subtract.outer(clock_s, times_s)).min(axis=1)
        np.testing.assert_array_equal(valid[0], near_s <= dt_s + 1e-6)
        np.testing.assert_allclose(positions[0, valid[0], 0], 10.0 * clock_s[valid[0]])


@settings(max_examples=100, deadline=None)
@given(
    gaps_s=st.lists(st.floats(0.001, 0.35), min_size=1, max_size=300),
    dt_s=st.sampled_from([0.02, 0.05, 0.1, 0.5]),
)
def test_thinning_takes_no_step_away_and_widens_no_gap_that_matters(
    gaps_s: list[float], dt_s: float
) -> None:
    """A weaving object: as if all since its track began were kept, to what it moves in 80 ms."""
    steps, times_s = 20, np.cumsum(gaps_s)
    places = np.stack([10.0 * times_s, np.sin(2.0 * times_s)], axis=1)
    store = TrackStore(steps, dt_s)
    for time_s, place in zip(times_s.tolist(), places.tolist(), strict=True):
        store.update(see(time_s, {1: tuple(place)}), standing(), AT_ORIGIN)
    tracks, now_s = store.snapshot(times_s[-1]), float(times_s[-1])
    count = int(tracks.num_measurements[0])
    positions, valid = store.history(now_s, steps, dt_s, tracks.row)
    whole, known = resample(times_s[None, -count:], places[None, -count:], now_s, steps, dt_s)
    np.testing.assert_array_equal(valid, known)
    np.testing.assert_array_equal(positions[0, -1], places[-1])
    np.testing.assert_allclose(positions[valid], whole[valid], atol=4.0 * 0.08**2 / 8 + 1e-9)
    if min(gaps_s) > 0.0401:
        np.testing.assert_array_equal(positions[valid], whole[valid])


def test_a_store_can_be_made_ready_for_longer_histories() -> None:
    """What it knows stays; a model that reads less later takes nothing away."""
    store = TrackStore(20, 0.1)
    times_s = [k / 20 for k in range(201)]
    followed_for(store, times_s[:101])
    store.reach(50, 0.1)
    followed_for(store, times_s[101:])
    store.reach(20, 0.1)
    positions, valid = store.history(10.0, 50, 0.1, store.snapshot(10.0).row)
    assert valid.all()
    np.testing.assert_allclose(positions[0, :, 0], 10.0 * (10.0 - 0.1 * np.arange(49, -1, -1)))


# --- a real drive -----------------------------------------------------------------------------

STATIC_MPS = 0.7


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """What a minute of a radar behind a RAV4's badge became."""

    store: TrackStore
    static_mps: Float64
    """Speed in the map of everything that the radar's own Doppler measurement calls static."""
    moving_mps: Float64
    """And of everything else."""


def follow(yaw_rate_bias_rad_s: float, *, flags: bool = True) -> Followed:
    """The log through decoder, ego motion and tracks; without flags, nothing is said to be new."""
    ego, store = EgoTracker(yaw_rate_bias_rad_s=yaw_rate_bias_rad_s), TrackStore()
    mount = load_profile("toyota-rav4").sensor("toyota").mount
    speeds: dict[bool, list[float]] = {True: [], False: []}
    for event in read_events():
        if isinstance(event, EgoMotion):
            ego.motion(event)
        elif isinstance(event, Detections):
            state = ego.at(event.timestamp_s)
            cycle = event if flags else replace(event, is_new=np.zeros_like(event.is_new))
            store.update(cycle, state, mount)
            if state is None:
                continue
            static = dict(zip(event.object_id, is_static(event, state), strict=True))
            tracks = store.snapshot(event.timestamp_s, max_age_s=0.0)
            for k in np.flatnonzero(tracks.num_measurements >= 10):
                speeds[bool(static[tracks.object_id[k]])].append(float(tracks.speed_mps[k]))
    return Followed(
        store=store, static_mps=np.array(speeds[True]), moving_mps=np.array(speeds[False])
    )


def is_static(detections: Detections, ego: EgoState) -> NDArray[np.bool_]:
    """The range rate is what our own motion towards the object makes it."""
    sight = detections.position / np.linalg.norm(detections.position, axis=1, keepdims=True)
    range_rate_mps = (detections.velocity * sight).sum(axis=1)
    return np.asarray(np.abs(range_rate_mps + ego.velocity[0] * sight[:, 0]) < STATIC_MPS)


@pytest.fixture(scope="module")
def followed() -> Followed:
    return follow(math.radians(-0.42))


def test_every_point_of_the_rav4_log_becomes_part_of_a_track(followed: Followed) -> None:
    counters = followed.store.counters
    assert counters.without_ego == 1  # the first cycle, 13 points, comes before any ego motion
    assert counters.measurements == 10_100 - 13
    assert (counters.refused, counters.duplicates, counters.late, counters.dropped) == (0, 0, 0, 0)
    assert counters.resets == 0
    assert 120 <= counters.tracks <= 170  # the radar flags 131 new ones


def test_reused_ids_are_told_apart_even_if_the_sensor_does_not_say_so(followed: Followed) -> None:
    """76 flagged objects follow another within 0.3 s; 67 of them are too far from where it was."""
    flagless = follow(math.radians(-0.42), flags=False).store.counters
    assert followed.store.counters.tracks - flagless.tracks <= 9


def test_what_stands_beside_the_road_stands_in_the_map(followed: Followed) -> None:
    assert len(followed.static_mps) > 700
    assert np.median(followed.static_mps) < 0.30
    assert np.mean(followed.static_mps < 1.0) > 0.95
    assert np.median(followed.moving_mps) > 10.0


def test_a_yaw_rate_bias_makes_the_roadside_swim(followed: Followed) -> None:
    """0.42 deg/s seen over 60 m are 0.44 m/s, sideways."""
    biased = follow(0.0)
    assert np.median(biased.static_mps) > np.median(followed.static_mps) + 0.15
    wrong_way = follow(math.radians(0.42))
    assert np.median(wrong_way.static_mps) > np.median(biased.static_mps) + 0.15


def test_a_parked_ars408_follows_every_object_it_lists() -> None:
    decoder, ego, store = Decoder(load_profile("ars408")), EgoTracker(stationary=True), TrackStore()
    for message in read_log(ARS408_LOG):
        for event in decoder.feed(message, message.timestamp):
            if isinstance(event, Detections):
                store.update(event, ego.at(event.timestamp_s), AT_ORIGIN)
    assert (store.counters.measurements, store.counters.tracks) == (5609, 88)
    assert (store.counters.late, store.counters.duplicates, store.counters.refused) == (0, 0, 0)
