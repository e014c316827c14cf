"""One cycle's predictions: of whom, in which order, from which scene, and how many in time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from drives import TILE, Car, object_list
from eqrt.core.frames import Pose2
from eqrt.core.lane_choice import centerline_source
from eqrt.core.scene import CenterlineSource, Scene
from eqrt.runtime.decoding.detections import Detections, EgoMotion, EgoPose, ObjectClass
from eqrt.runtime.prediction.forecaster import BATCH, Deadline, Forecaster, Raw
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.targets import Targets
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.prediction.watched import Direct, TooLate
from eqrt.runtime.tracking.ego import EgoTracker
from eqrt.runtime.tracking.tracks import TrackStore
from raw_predictions import driving
from steady_model import CONTRACT, DT_S, Steady

NOW_S = 10.0
STANDING = Pose2()


class Paced(Direct):
    """On a clock of its own, every run takes as long as it is told; the last length goes on."""

    def __init__(self, model: Steady, *seconds: float) -> None:
        super().__init__(model)
        self.now_s = 50.0
        self._seconds = itertools.chain(seconds, itertools.repeat(seconds[-1]))

    def clock(self) -> float:
        return self.now_s

    def run(self, scene: Scene, patience_s: float) -> Prediction:
        seconds = next(self._seconds)
        self.now_s += min(seconds, patience_s)
        if seconds > patience_s:
            raise TooLate("no answer")
        return super().run(scene, patience_s)


class Drive:
    """Tracks of what sensors saw, and an ego vehicle that stands at a place."""

    def __init__(self, place: Pose2 | None = None, *, ego: EgoTracker | None = None) -> None:
        """`place` in the map; None = without a map pose, at its origin."""
        self.ego = ego or EgoTracker(stationary=True)
        self.tracks = TrackStore()
        if place is not None:
            self.ego.pose(EgoPose(timestamp_s=0.0, map_from_ego=place))

    def see(self, cars: Sequence[Car], until_s: float, **seen: object) -> None:
        """Four times, the last time at `until_s`; `seen` says more of the detections."""
        for step in range(3, -1, -1):
            found: Detections = replace(object_list(cars, until_s - step * DT_S), **seen)  # type: ignore[arg-type]  # its own fields
            self.tracks.update(found, self.ego.at(found.timestamp_s), STANDING)

    def predict(
        self,
        runner: Direct,
        *,
        alive: Callable[[NDArray[np.int64]], NDArray[np.bool_]] = lambda ids: ids >= 0,
        lanes: CenterlineSource | None = None,
        deadline: Deadline | None = None,
    ) -> Raw:
        tracks = self.tracks.snapshot(NOW_S)
        ego = self.ego.at(NOW_S)
        assert ego is not None
        forecaster = Forecaster(CONTRACT, runner, lanes, self.tracks, self.ego)
        endless = Deadline(lambda: 0.0, math.inf, math.inf)
        return forecaster.predict(tracks, alive(tracks.object_id), ego, deadline or endless)


def standing(count: int, x_m: float = 10.0) -> list[Car]:
    """In a row, a metre apart; their ids count from 0."""
    return [Car(object_id=n, x_m=x_m + n, y_m=0.0, speed_mps=0.0) for n in range(count)]


# --- whom, and in which order


def test_every_target_ends_at_its_own_last_measurement() -> None:
    """Two sensors, half a period apart; what each of the tracks says goes with its target."""
    drive, model = Drive(), Steady()
    drive.see([Car(object_id=1, x_m=-90.0, y_m=2.0)], NOW_S, sensor="front")
    drive.see(
        [Car(object_id=2, x_m=-80.0, y_m=-2.0, speed_mps=8.0)],
        NOW_S - DT_S / 2,
        sensor="rear",
        heading_rad=np.array([np.nan]),
        object_class=np.array([ObjectClass.TRUCK], np.uint8),
        length_m=np.array([9.0]),
    )
    raw = drive.predict(Direct(model))
    targets = raw.targets
    assert len(targets) == 2
    assert targets.anchor_s.tolist() == [NOW_S - DT_S / 2, NOW_S]
    assert targets.object_id.tolist() == [2, 1]
    assert targets.track_id.tolist() == [2, 1]
    assert targets.object_class.tolist() == [ObjectClass.TRUCK, ObjectClass.CAR]
    assert targets.length_m.tolist() == [9.0, 4.5]
    assert targets.width_m.tolist() == [1.8, 1.8]
    np.testing.assert_array_equal(targets.heading_rad, [np.nan, 0.0])
    np.testing.assert_allclose(targets.history[:, -1], [[-0.5, -2.0], [10.0, 2.0]])
    np.testing.assert_allclose(targets.history[:, -2], [[-1.5, -2.0], [8.75, 2.0]])
    assert targets.valid.all()
    (scene,) = model.scenes
    np.testing.assert_array_equal(scene.heading, [[0.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(scene.history[:, 0], targets.history)
    path = [[[0.5, -2.0], [1.5, -2.0], [2.5, -2.0]], [[11.25, 2.0], [12.5, 2.0], [13.75, 2.0]]]
    np.testing.assert_allclose(raw.trajectories[:, 0], path)
    np.testing.assert_allclose(raw.probabilities, [[0.75, 0.25]] * 2)
    assert raw.covariances is None
    assert not raw.late.any()


def test_the_nearest_to_the_ego_vehicle_come_first() -> None:
    """In batches, those as near as each other as they were seen."""
    drive, model = Drive(Pose2(130.0, -270.0)), Steady()
    around = [
        (3.0, 4.0),
        (0.0, 5.0),
        (-5.0, 0.0),
        (0.0, -4.0),
        (-9.0, 0.0),
        (4.0, -3.0),
        (0.0, 7.0),
    ]
    places = [(x_m * (1 + k // 7), y_m * (1 + k // 7)) for k, (x_m, y_m) in enumerate(around * 11)]
    cars = [
        Car(object_id=n, x_m=x_m, y_m=y_m, speed_mps=0.0) for n, (x_m, y_m) in enumerate(places)
    ][::-1]
    drive.see(cars, NOW_S)
    targets = drive.predict(Direct(model)).targets
    expected = sorted(cars, key=lambda car: math.hypot(car.x_m, car.y_m))
    assert targets.object_id.tolist() == [car.object_id for car in expected]
    assert [len(scene.history) for scene in model.scenes] == [BATCH, BATCH, 77 - 2 * BATCH]
    for number, scene in enumerate(model.scenes):
        assert scene.origin.tolist() == [100.0, -300.0]
        part = slice(BATCH * number, BATCH * (number + 1))
        np.testing.assert_allclose(scene.history[:, 0] + scene.origin, targets.history[part])


def test_a_track_that_is_not_alive_is_a_neighbour_and_no_target() -> None:
    drive, model = Drive(), Steady()
    drive.see(standing(3), NOW_S)
    targets = drive.predict(Direct(model), alive=lambda ids: ids != 1).targets
    assert targets.object_id.tolist() == [0, 2]
    (scene,) = model.scenes
    np.testing.assert_allclose(scene.history[:, 1, -1], [[11.0, 0.0], [11.0, 0.0]])


def test_the_ego_vehicle_is_an_agent_for_as_long_as_it_is_known() -> None:
    """It drives straight on at 8 m/s and was heard of 0.25 s ago for the first time."""
    moving = EgoTracker()
    drive, model = Drive(ego=moving), Steady()
    for step in (2, 1, 0):
        moving.motion(EgoMotion(timestamp_s=NOW_S - step * DT_S, speed_mps=8.0, yaw_rate_rad_s=0.0))
    found = object_list(standing(1), NOW_S)
    drive.tracks.update(found, moving.at(NOW_S), STANDING)
    drive.predict(Direct(model))
    (scene,) = model.scenes
    assert scene.history_valid[0, 1].tolist() == [False, True, True, True]
    np.testing.assert_allclose(scene.history[0, 1, 1:], [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    assert not scene.history_valid[0, 2].any()


# --- the map

LANES = centerline_source(load_tile(TILE).lane_map, CONTRACT)
ON_A_LANE = Pose2(*load_tile(TILE).lane_map.points[0].tolist())
OFF_THE_MAP = Pose2(50_000.0, 50_000.0)


def test_lanes_are_those_around_the_place_in_the_map() -> None:
    for place, has_lanes in ((ON_A_LANE, True), (OFF_THE_MAP, False), (None, False)):
        drive, model = Drive(place), Steady()
        drive.see(standing(2, x_m=0.0), NOW_S)
        raw = drive.predict(Direct(model), lanes=LANES)
        assert raw.has_lanes is has_lanes
        assert model.scenes[0].centerlines_valid.any() == has_lanes
    assert not drive.predict(Direct(model)).has_lanes


def test_without_a_pose_there_are_no_lanes_though_the_origin_may_look_like_a_place() -> None:
    """Dead reckoning that happens to begin where there are lanes."""
    drive, model = Drive(ON_A_LANE), Steady()
    drive.see(standing(2, x_m=0.0), NOW_S)
    ego = drive.ego.at(NOW_S)
    assert ego is not None
    forecaster = Forecaster(CONTRACT, Direct(model), LANES, drive.tracks, drive.ego)
    tracks, endless = drive.tracks.snapshot(NOW_S), Deadline(lambda: 0.0, math.inf, math.inf)
    alive = np.ones(2, np.bool_)
    raw = forecaster.predict(tracks, alive, replace(ego, has_map_pose=False), endless)
    assert not raw.has_lanes


def test_lanes_near_one_batch_are_lanes() -> None:
    """The other car is far from every lane."""
    drive = Drive(ON_A_LANE)
    drive.see([*standing(BATCH, x_m=0.0), Car(object_id=99, x_m=0.0, y_m=-900.0)], NOW_S)
    model = Steady()
    assert drive.predict(Direct(model), lanes=LANES).has_lanes
    assert [s.centerlines_valid.any().item() for s in model.scenes] == [True, False]


# --- in time


def in_time(runner: Paced, *, shed_s: float, end_s: float = math.inf) -> Raw:
    """Of three batches, the last one of a single car; times are from the start."""
    drive = Drive()
    drive.see(standing(2 * BATCH + 1), NOW_S)
    begun_s = runner.now_s
    return drive.predict(runner, deadline=Deadline(runner.clock, begun_s + shed_s, begun_s + end_s))


def batches(flags: ArrayLike) -> list[bool]:
    """What is true of whole batches."""
    parts = np.split(np.asarray(flags), [BATCH, 2 * BATCH])
    assert all(part.all() == part.any() for part in parts)
    return [bool(part.all()) for part in parts]


@pytest.mark.parametrize(
    ("seconds", "shed_s", "late"),
    [
        ([0.25], 0.75, [False, False, False]),  # the third ends just then
        ([0.25], 0.625, [False, False, True]),
        ([0.25], 0.375, [False, True, True]),
        ([0.25], 0.0, [False, True, True]),  # nobody knows yet how long a run takes
        ([0.25], -0.125, [True, True, True]),
        ([0.5, 0.125], 1.0, [False, False, True]),  # the longest so far counts, not the last
        ([0.125, 0.5], 0.5, [False, False, True]),
    ],
)
def test_a_run_that_would_end_too_late_is_not_begun(
    seconds: list[float], shed_s: float, late: list[bool]
) -> None:
    model = Steady()
    raw = in_time(Paced(model, *seconds), shed_s=shed_s)
    assert batches(raw.late) == late
    assert batches(np.isnan(raw.trajectories).all(axis=(1, 2, 3))) == late
    assert len(model.scenes) == late.count(False)


def test_a_run_is_given_up_at_the_deadline() -> None:
    """Its targets are late; those after it have what time is left: none is enough here."""
    raw = in_time(Paced(Steady(), 0.25, 0.75, 0.0), shed_s=math.inf, end_s=0.75)
    assert batches(raw.late) == [False, True, False]
    assert batches(np.isnan(raw.probabilities).all(axis=1)) == [False, True, False]
    assert raw.infer_s == 0.75


def test_a_run_that_fails_leaves_the_others() -> None:
    """Its targets are not late. That there were lanes is said of runs that were made."""

    class SecondFails(Steady):
        def predict(self, scene: Scene) -> Prediction:
            prediction = super().predict(scene)
            if len(self.scenes) == 2:
                raise RuntimeError("no memory")
            return prediction

    raw = in_time(Paced(SecondFails(), 0.25), shed_s=math.inf)
    assert not raw.late.any()
    assert batches(np.isnan(raw.trajectories).all(axis=(1, 2, 3))) == [False, True, False]

    class Fails(Steady):
        def predict(self, scene: Scene) -> Prediction:
            raise RuntimeError(f"no memory for {len(scene.history)} targets")

    drive = Drive(ON_A_LANE)
    drive.see(standing(2, x_m=0.0), NOW_S)
    assert not drive.predict(Direct(Fails()), lanes=LANES).has_lanes


def test_it_says_how_long_scenes_and_runs_took() -> None:
    """By a clock on which every look takes a second: twice in the beginning, thrice per batch."""
    looks = itertools.count(100)
    drive = Drive()
    drive.see(standing(BATCH + 1), NOW_S)
    deadline = Deadline(lambda: next(looks), math.inf, math.inf)
    raw = drive.predict(Direct(Steady()), deadline=deadline)
    assert (raw.scene_s, raw.infer_s) == (1.0 + 2.0, 2.0)
    assert next(looks) == 108


# --- what the model said


def test_a_model_that_has_not_spoken_is_silent_on_everything() -> None:
    targets = driving(targets=3).targets
    raw = Raw.silent(targets, CONTRACT)
    assert raw.targets is targets
    assert raw.trajectories.shape == (3, 2, 3, 2)
    assert raw.probabilities.shape == (3, 2)
    assert np.isnan(raw.trajectories).all()
    assert np.isnan(raw.probabilities).all()
    assert raw.covariances is None
    assert raw.late.tolist() == [False] * 3
    assert raw.late.dtype == np.bool_
    uncertain = Raw.silent(targets, replace(CONTRACT, covariances=True)).covariances
    assert uncertain is not None
    assert uncertain.shape == (3, 2, 3, 2, 2)
    assert np.isnan(uncertain).all()


@pytest.mark.parametrize("promised", [True, False])
@pytest.mark.parametrize("said", [True, False])
def test_covariances_are_taken_if_they_were_promised(promised: bool, said: bool) -> None:
    raw = Raw.silent(driving(targets=3).targets, replace(CONTRACT, covariances=promised))
    covariances = np.tile(np.eye(2), (2, 2, 3, 1, 1)) if said else None
    told = Prediction(np.ones((2, 2, 3, 2)), np.full((2, 2), np.float32(0.5)), covariances)
    raw.take(slice(1, 3), told)
    np.testing.assert_array_equal(np.isnan(raw.trajectories).all(axis=(1, 2, 3)), [1, 0, 0])
    np.testing.assert_array_equal(raw.probabilities[1:], 0.5)
    if not promised:
        assert raw.covariances is None
    else:
        assert raw.covariances is not None
        unsaid = np.isnan(raw.covariances).all(axis=(1, 2, 3, 4))
        np.testing.assert_array_equal(unsaid, [True, not said, not said])


def test_no_targets_are_targets_with_every_field_empty() -> None:
    nobody, some = Targets.none(CONTRACT), driving(targets=2).targets
    assert len(nobody) == 0
    assert len(Raw.silent(nobody, CONTRACT).trajectories) == 0
    assert nobody.history.shape == (0, CONTRACT.history_steps, 2)
    assert nobody.valid.shape == (0, CONTRACT.history_steps)
    assert nobody.velocity.shape == (0, 2)
    for field in fields(Targets):
        empty, full = getattr(nobody, field.name), getattr(some, field.name)
        assert (len(empty), empty.dtype) == (0, full.dtype), field.name


def test_targets_are_joined_field_by_field() -> None:
    some = driving(targets=2).targets
    joined = Targets.join([some, Targets.join([some])])
    assert len(joined) == 4
    for field in fields(Targets):
        part = getattr(some, field.name)
        np.testing.assert_array_equal(getattr(joined, field.name), np.concatenate([part, part]))
