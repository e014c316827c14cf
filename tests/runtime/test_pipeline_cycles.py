"""When a cycle is predicted, when silence is said, and what a forecast says: to the last number.

With a sensor and a model that are computed by hand, and times that a float holds exactly.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drives import TILE, Car, object_list
from eqrt.core.contract import ModelContract
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.decoding.profile import Profile, load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import Pipeline, StageTimes
from eqrt.runtime.prediction.guard import MIN_STEPS
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.prediction.watched import Direct, Model, Runner
from steady_model import CONTRACT, DT_S, Steady
from tiny_sensor import COUNTED, first, header, profile_of

SLOW_CLOCK = replace(CONTRACT, dt_s=1.0)
"""Of a model that has time enough on any machine."""


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Profile:
    """Of the tiny sensor, a cycle of which ends with its last FIRST."""
    lines = [line for line in COUNTED.splitlines() if "second" not in line]
    return profile_of(tmp_path_factory.mktemp("tiny"), "\n".join(lines))


class Road:
    """A pipeline on the tiny sensor, which stands still and sees objects 10 m ahead and more."""

    def __init__(
        self,
        profile: Profile,
        model: Steady | None = None,
        clock: Callable[[], float] | None = None,
        run_by: Callable[[Model], Runner] | None = None,
    ) -> None:
        self.pipeline = Pipeline(profile, model or Steady(), clock=clock, run_by=run_by)
        self._counter = itertools.count()

    def see(self, *ids: int, at_s: float, age_ms: int = 0) -> ForecastSet | None:
        """A cycle of which every message comes at `at_s`, measured `age_ms` before."""
        counter = next(self._counter) % 16
        messages = [header(len(ids), counter, age_ms)]
        messages += [first(10.0 + n, 0.0, n, counter=counter) for n in ids]
        made = [one for m in messages for one in self.pipeline.feed(m, at_s)]
        assert len(made) <= 1
        return made[0] if made else None

    def predict(self, *ids: int, at_s: float, age_ms: int = 0) -> ForecastSet:
        """Likewise, and it is predicted."""
        made = self.see(*ids, at_s=at_s, age_ms=age_ms)
        assert made is not None
        return made

    def silent_at(self, *times_s: float) -> list[float]:
        """At which of these looks silence is said."""
        said = [made for now_s in times_s for made in self.pipeline.poll(now_s)]
        assert {forecast.mode for forecast in said} <= {Mode.SILENT}
        return [forecast.made_s for forecast in said]


class Counting(Direct):
    """Counts its runs."""

    runs = 0

    def run(self, scene: Scene, patience_s: float) -> Prediction:
        self.runs += 1
        return super().run(scene, patience_s)


# --- which cycles are predicted


@pytest.mark.parametrize(
    ("since_s", "predicted"),
    [
        (0.6 * DT_S, True),
        (0.59 * DT_S, False),
        (0.0, False),
        (-1.0, False),  # disorder
        (-1.125, True),  # the clock was set back
    ],
)
def test_a_cycle_is_predicted_if_it_is_not_too_soon(
    profile: Profile, since_s: float, predicted: bool
) -> None:
    road = Road(profile)
    road.predict(5, at_s=0.0)
    made = road.see(5, at_s=since_s)
    assert (made is not None) == predicted
    road.see(5, at_s=since_s)
    assert road.pipeline.counters.skipped == 2 - predicted


def test_input_a_second_old_is_used_and_older_input_is_not(profile: Profile) -> None:
    road = Road(profile)
    assert road.predict(5, at_s=10.0, age_ms=1000).timestamp_s == 9.0
    for number in range(3):
        assert road.see(5, at_s=11.0 + number, age_ms=1001) is None
        assert road.pipeline.counters.stale == number + 1
    assert road.pipeline.counters.cycles == 1


def test_an_object_is_a_target_until_three_tenths_of_a_second_after_it_was_seen(
    profile: Profile,
) -> None:
    for at_s, targets in ((0.3, [1, 2]), (0.301, [2])):
        road = Road(profile)
        road.predict(1, at_s=0.0)
        assert sorted(road.predict(2, at_s=at_s).object_id.tolist()) == targets


@pytest.mark.parametrize("clock", [None, lambda: 0.0])
def test_the_model_is_run_by_what_the_pipeline_is_told(
    profile: Profile, clock: Callable[[], float] | None
) -> None:
    made: list[Counting] = []

    def counting(model: Model) -> Runner:
        made.append(Counting(model))
        return made[-1]

    model = Steady()
    road = Road(profile, model, clock, run_by=counting)
    road.predict(5, at_s=0.0)
    assert [one.runs for one in made] == [len(model.scenes)] == [1]


def test_an_object_is_a_neighbour_for_longer(profile: Profile) -> None:
    """The model sees where it was until half a second ago."""
    model = Steady(replace(CONTRACT, history_steps=8))
    road = Road(profile, model)
    road.predict(1, at_s=10.0)
    for step in range(1, 5):
        road.predict(2, at_s=10.0 + step * DT_S)
    present = [bool((scene.history[-1, 1:, :, 0] == 11.0).any()) for scene in model.scenes[1:]]
    assert present == [True] * 4
    road.predict(2, at_s=10.0 + 5 * DT_S)
    assert not (model.scenes[-1].history[..., 0] == 11.0).any()


# --- silence


def test_silence_is_said_on_the_dot_and_then_at_every_period(profile: Profile) -> None:
    """Three periods after a cycle came; a look that comes late does not shift those after it."""
    road = Road(profile)
    road.predict(5, at_s=10.0)
    looks = (10.0, 10.3125, 10.375, 10.4375, 10.5, 10.703125, 10.734375, 10.75, 10.8125, 10.875)
    assert road.silent_at(*looks) == [10.375, 10.5, 10.703125, 10.75, 10.875]


def test_silence_counts_from_when_a_cycle_came_and_not_from_when_it_was_measured(
    profile: Profile,
) -> None:
    road = Road(profile)
    road.predict(5, at_s=10.0, age_ms=500)
    assert road.silent_at(10.3125, 10.375) == [10.375]


def test_silence_says_nothing_but_how_long_it_has_lasted(profile: Profile) -> None:
    road = Road(profile)
    road.predict(5, at_s=10.0)
    (silent,) = road.pipeline.poll(11.0)
    assert (silent.mode, silent.num_targets, silent.cycle) == (Mode.SILENT, 0, 1)
    assert (silent.timestamp_s, silent.made_s, silent.compute_s) == (10.0, 11.0, 0.0)
    assert np.isnan(silent.received_s)
    assert silent.map_from_ego is None
    assert np.isnan(silent.ego_speed_mps)
    assert silent.trajectories.shape == (0, CONTRACT.num_modes, CONTRACT.horizon_steps, 2)


def test_after_a_clock_was_set_back_silence_comes_three_periods_later(profile: Profile) -> None:
    road = Road(profile)
    road.predict(5, at_s=5000.0)
    assert road.silent_at(100.0, 100.3125, 100.375, 100.4375, 100.5) == [100.375, 100.5]


def test_the_clock_is_looked_at_a_hundred_times_a_second(profile: Profile) -> None:
    """Looks that come sooner are free."""
    for begun_s in (0.0, 64.0):
        road = Road(profile)
        road.predict(5, at_s=begun_s - 3 * DT_S)
        road.pipeline._silent_due_s = begun_s + 0.001
        assert road.silent_at(begun_s, begun_s + 0.0078125) == []
        assert road.silent_at(begun_s + 0.015625) == [begun_s + 0.015625]
    road = Road(profile)
    road.predict(5, at_s=-0.5)
    road.pipeline._silent_due_s = 0.001
    assert road.silent_at(0.0, 0.01) == [0.01]


# --- its time


class Ticking:
    """A clock on which every look takes the 64th part of a second."""

    def __init__(self, start_s: float) -> None:
        self.looks = itertools.count()
        self._start_s = start_s

    def __call__(self) -> float:
        return self._start_s + next(self.looks) / 64


def test_it_says_how_long_each_stage_took(profile: Profile) -> None:
    """One look per beginning and end of a stage."""
    road = Road(profile, Steady(SLOW_CLOCK), Ticking(7.0))
    forecast = road.predict(5, 6, at_s=6.9375)
    assert road.pipeline.times == StageTimes(
        tracks_s=1 / 64, scene_s=2 / 64, infer_s=1 / 64, guard_s=1 / 64
    )
    assert (forecast.made_s, forecast.compute_s) == (7.0 + 8 / 64, 8 / 64)
    assert forecast.timestamp_s == 6.9375


def test_without_a_clock_no_time_passes(profile: Profile) -> None:
    road = Road(profile)
    forecast = road.predict(5, at_s=6.0)
    assert (forecast.made_s, forecast.compute_s) == (6.0, 0.0)
    assert road.pipeline.times == StageTimes()


@pytest.mark.parametrize(("ticks", "mode"), [(8, Mode.NO_MAP), (9, Mode.LATE)])
def test_a_cycle_is_late_if_it_is_out_more_than_a_period_after_it_came(
    profile: Profile, ticks: int, mode: Mode
) -> None:
    """Of nobody: four looks, and it came so many ticks before the last one."""
    road = Road(profile, clock=Ticking(7.0))
    assert road.predict(at_s=7.0 + (3 - ticks) / 64).mode is mode


def closed_by_timeout(road: Road, *, last_s: float, closed_s: float, state: int = 2) -> ForecastSet:
    """A cycle whose header came at 7 s and announced two objects, of which one came at `last_s`."""
    for message, at_s in ((header(2), 7.0), (first(10.0, 0.0, 1, state=state), last_s)):
        assert road.pipeline.feed(message, at_s) == []
    (made,) = road.pipeline.poll(closed_s)
    assert (made.received_s, made.timestamp_s) == (last_s, 7.0)
    return made


@pytest.mark.parametrize(("last_s", "mode"), [(7.0, Mode.LATE), (7.015625, Mode.NO_MAP)])
def test_a_cycle_that_waited_for_a_message_in_vain_is_late_by_the_last_one_that_came(
    profile: Profile, last_s: float, mode: Mode
) -> None:
    """More than a period after it, though it was made as soon as it was closed."""
    road = Road(profile, clock=lambda: 7.140625)
    made = closed_by_timeout(road, last_s=last_s, closed_s=7.140625, state=0)
    assert (made.mode, made.num_targets, made.made_s) == (mode, 0, 7.140625)


@pytest.mark.parametrize(("last_s", "mode"), [(7.0, Mode.LATE), (7.03125, Mode.PARTIAL)])
def test_the_time_of_the_model_counts_from_the_last_message_that_came(
    profile: Profile, last_s: float, mode: Mode
) -> None:
    """Of a period of 125 ms, 87.5 are the model's; the cycle was closed after 110."""
    model = Steady()
    (sensor,) = profile.sensors
    profile = replace(profile, sensors=(replace(sensor, timeout_s=0.05),))
    road = Road(profile, model, clock=lambda: 7.109375, run_by=Direct)
    made = closed_by_timeout(road, last_s=last_s, closed_s=7.109375)
    assert made.agent_mode.tolist() == [mode]
    assert len(model.scenes) == (mode is Mode.PARTIAL)


def test_where_no_time_passes_nothing_is_late(profile: Profile) -> None:
    """In a log, only the next message tells that the time of a cycle is over."""
    made = closed_by_timeout(Road(profile), last_s=7.0, closed_s=7.9)
    assert (made.mode, made.agent_mode.tolist()) == (Mode.NO_MAP, [Mode.PARTIAL])


def test_a_cycle_from_before_the_clock_was_set_back_is_not_waited_for(profile: Profile) -> None:
    """It came now, as far as deadlines go; else the model would have thousands of seconds."""
    granted_s: list[float] = []

    class Patient(Direct):
        def run(self, scene: Scene, patience_s: float) -> Prediction:
            granted_s.append(patience_s)
            return super().run(scene, patience_s)

    road = Road(profile, clock=lambda: 100.0, run_by=Patient)
    for message in (header(2), first(10.0, 0.0, 1)):
        assert road.pipeline.feed(message, 5000.0) == []
    (made,) = road.pipeline.poll(100.0)
    assert made.received_s == 100.0
    assert granted_s == [DT_S]


@pytest.fixture
def over() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


def test_a_model_that_hangs_is_waited_for_until_the_period_is_over(
    profile: Profile, over: threading.Event
) -> None:
    class Hanging(Steady):
        def predict(self, scene: Scene) -> Prediction:
            over.wait(10.0)
            return super().predict(scene)

    road = Road(profile, Hanging(replace(CONTRACT, dt_s=0.5)), time.monotonic)
    begun_s = time.monotonic()
    forecast = road.predict(5, 6, at_s=begun_s)
    assert 0.49 <= time.monotonic() - begun_s < 5.0
    assert (forecast.mode, forecast.agent_mode.tolist()) == (Mode.LATE, [Mode.LATE, Mode.LATE])
    counters = road.pipeline.counters
    assert (counters.model_overruns, counters.shed, counters.fallbacks) == (1, 2, 0)
    assert (counters.model_errors, counters.model_restarts) == (0, 0)
    again = road.predict(5, 6, at_s=time.monotonic())  # it is not asked: it is still at work
    assert (again.mode, again.agent_mode.tolist()) == (Mode.LATE, [Mode.LATE, Mode.LATE])
    assert (counters.model_overruns, counters.shed, counters.fallbacks) == (1, 4, 0)


# --- what it says


CARS = (
    Car(object_id=7, x_m=5.0, y_m=3.5, speed_mps=12.0),
    Car(object_id=3, x_m=20.0, y_m=0.0),
)


def generic(
    contract: ModelContract = CONTRACT,
    model: Steady | None = None,
    *,
    cycles: int = 4,
    kind: int = ObjectClass.CAR,
    place: Pose2 | None = None,
    tile: Path | None = None,
    cars: tuple[Car, ...] = CARS,
) -> tuple[Pipeline, ForecastSet]:
    """Cycles of the object list from a car that drives at 3 m/s; the last forecast."""
    pipeline = Pipeline(
        load_profile("generic"), model or Steady(contract), load_tile(tile) if tile else None
    )
    made: list[ForecastSet] = []
    for number in range(cycles):
        now_s = 100.0 + number * DT_S
        objects = object_list(cars, 0.0)
        objects = replace(objects, object_class=np.full(len(cars), kind, np.uint8))
        messages = encode_cycle(
            replace(objects, heading_rad=np.full(len(cars), 0.5)),
            timestamp_s=now_s,
            counter=number,
            speed_mps=3.0,
            yaw_rate_rad_s=0.0,
            map_from_ego=place,
        )
        made += [one for message in messages for one in pipeline.feed(message, now_s)]
    assert len(made) == cycles
    return pipeline, made[-1]


def test_a_forecast_says_what_is_known_of_its_targets_and_of_the_ego_vehicle() -> None:
    pipeline, forecast = generic()
    assert (forecast.cycle, forecast.timestamp_s, forecast.dt_s) == (3, 100.375, DT_S)
    assert (forecast.model_id, forecast.tile_id) == ("steady", "")
    assert forecast.ego_speed_mps == pytest.approx(3.0)
    assert forecast.map_from_ego is not None
    assert forecast.map_from_ego.x_m == pytest.approx(3.0 * 0.375)
    assert forecast.object_id.tolist() == [7, 3]
    assert forecast.track_id.tolist() == [1, 2]
    assert forecast.anchor_s.tolist() == [100.375, 100.375]
    assert forecast.agent_mode.tolist() == [Mode.RUN, Mode.RUN]
    assert forecast.object_class.tolist() == [ObjectClass.CAR, ObjectClass.CAR]
    np.testing.assert_allclose(forecast.heading_rad, 0.5, atol=1e-3)
    np.testing.assert_allclose(forecast.length_m, 4.5, atol=0.05)
    np.testing.assert_allclose(forecast.width_m, 1.8, atol=0.05)
    assert forecast.history_valid.shape == (2, 4)
    assert forecast.history_valid.all()
    np.testing.assert_array_equal(forecast.history[:, -1], forecast.position)
    np.testing.assert_allclose(forecast.position, [[6.125, 3.5], [21.125, 0.0]], atol=0.01)
    np.testing.assert_allclose(forecast.velocity, [[3.0, 0.0], [3.0, 0.0]], atol=0.05)
    np.testing.assert_allclose(forecast.probabilities, [[0.75, 0.25]] * 2)
    ahead_m = 3.0 * DT_S * np.arange(1, 4)
    for target, x_m in enumerate((6.125, 21.125)):
        path = np.stack([x_m + ahead_m, np.full(3, 3.5 * (target == 0))], axis=-1)
        np.testing.assert_allclose(forecast.trajectories[target, 1], path, atol=0.01)
    assert forecast.covariances is None
    assert (pipeline.counters.cycles, pipeline.counters.targets) == (4, 8)


def test_a_forecast_says_how_uncertain_it_is_if_the_model_does() -> None:
    _, forecast = generic(replace(CONTRACT, covariances=True))
    assert forecast.covariances is not None
    np.testing.assert_array_equal(forecast.covariances, np.zeros((2, 2, 3, 2, 2)) + np.eye(2))


class SpeedingUp(Steady):
    """By 12 m/s^2 in the last step."""

    def predict(self, scene: Scene) -> Prediction:
        prediction = super().predict(scene)
        prediction.trajectories[:, :, -1, 0] += 12.0 * DT_S**2
        return prediction


def test_a_target_is_held_to_what_its_class_can_do() -> None:
    pipeline, forecast = generic(model=SpeedingUp(), kind=ObjectClass.CAR)
    assert forecast.agent_mode.tolist() == [Mode.RUN, Mode.RUN]
    assert pipeline.counters.fallbacks == 0
    pipeline, forecast = generic(model=SpeedingUp(), kind=ObjectClass.PEDESTRIAN)
    assert forecast.agent_mode.tolist() == [Mode.FALLBACK, Mode.FALLBACK]
    assert pipeline.counters.fallbacks == 2 * (4 - (MIN_STEPS - 1))  # not of what is just found


def test_a_tile_is_named_where_its_lanes_were_used() -> None:
    """And not where there are none."""
    info, points = load_tile(TILE).info, load_tile(TILE).lane_map.points
    near = (Car(object_id=1, x_m=2.0, y_m=0.0),)
    on_a_lane = Pose2(*points[0].tolist())
    _, forecast = generic(place=on_a_lane, tile=TILE, cars=near, cycles=1)
    assert (forecast.mode, forecast.tile_id) == (Mode.RUN, info.tile_id)
    _, forecast = generic(place=Pose2(50_000.0, 50_000.0), tile=TILE, cars=near, cycles=1)
    assert (forecast.mode, forecast.tile_id) == (Mode.NO_MAP, "")


def test_the_yaw_rate_that_the_profile_knows_to_be_wrong_is_put_right() -> None:
    profile = replace(load_profile("generic"), yaw_rate_bias_rad_s=-0.007)
    assert Pipeline(profile, Steady()).ego.yaw_rate_bias.value_rad_s == -0.007
