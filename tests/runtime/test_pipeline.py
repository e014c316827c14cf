"""From messages to predictions: what is predicted when, in which mode; and nothing breaks it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from drives import (
    DRIVES,
    TILE,
    Car,
    cycle,
    first_seconds,
    object_list,
    shipped_predictor,
    traffic,
)
from eqrt.core.contract import ModelContract
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.guard import MIN_STEPS
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.prediction.watched import Model
from tiny_sensor import COUNTED, first, header, profile_of

CARS = (
    Car(object_id=7, x_m=5.0, y_m=3.5, speed_mps=12.0),
    Car(object_id=3, x_m=20.0, y_m=0.0),
    Car(object_id=9, x_m=60.0, y_m=-3.5, speed_mps=0.0),
)
POSE = Pose2(0.0, 0.0, 0.0)


def pipeline_of(profile: str = "generic", *, tile: Path | None = None) -> Pipeline:
    return Pipeline(load_profile(profile), shipped_predictor(), load_tile(tile) if tile else None)


def feed(pipeline: Pipeline, messages: Iterable[can.Message]) -> list[ForecastSet]:
    """As replay does, but nothing is closed at the end."""
    made: list[ForecastSet] = []
    for message in messages:
        made += pipeline.poll(message.timestamp)
        made += pipeline.feed(message, message.timestamp)
    return made


def poll(pipeline: Pipeline, start_s: float, end_s: float) -> list[ForecastSet]:
    """Time passes without messages, as a service lets it: a hundredth at a time."""
    times_s = np.arange(round(100 * start_s), round(100 * end_s)) / 100
    return [made for now_s in times_s.tolist() for made in pipeline.poll(now_s)]


def test_every_object_is_predicted_in_every_cycle() -> None:
    """From where it was last measured, at its speed, under an id of our own that stays; the nearest
    first.
    """
    forecasts = feed(pipeline_of(), traffic(CARS, 3.0, start_s=1000.0))
    assert len(forecasts) == 31
    for number, forecast in enumerate(forecasts):
        assert forecast.cycle == number
        assert forecast.timestamp_s == pytest.approx(1000.0 + number / 10, abs=1e-6)
        np.testing.assert_array_equal(forecast.object_id, [7, 3, 9])
        np.testing.assert_array_equal(forecast.track_id, forecasts[0].track_id)
        np.testing.assert_allclose(forecast.anchor_s, forecast.timestamp_s)
        x_m = [car.x_m + car.speed_mps * number / 10 for car in CARS]
        np.testing.assert_allclose(forecast.position[:, 0], x_m, atol=0.005)
    last = forecasts[-1]
    np.testing.assert_allclose(last.velocity, [[12.0, 0.0], [10.0, 0.0], [0.0, 0.0]], atol=0.05)
    contract = shipped_predictor().contract
    assert last.trajectories.shape == (3, contract.num_modes, contract.horizon_steps, 2)
    assert last.dt_s == contract.dt_s
    assert last.model_id == shipped_predictor().model_id


def test_predictions_go_on_from_the_measurement() -> None:
    """One second ahead, a car that drives steadily is where it will be within two metres."""
    last = feed(pipeline_of(), traffic(CARS, 3.0))[-1]
    steps = round(1.0 / last.dt_s)
    expected = last.position + np.array([[12.0, 0.0], [10.0, 0.0], [0.0, 0.0]])
    assert np.linalg.norm(last.trajectories[:, 0, steps - 1] - expected, axis=-1).max() < 2.0


def test_an_object_is_partial_until_its_history_is_full() -> None:
    """The model reads two seconds; a car that comes later does not wait for the others."""
    contract = shipped_predictor().contract
    late = [*traffic(CARS[:1], 0.9)]
    for step in range(10, 41):
        late += cycle(CARS[:2], step / 10)
    for step, forecast in enumerate(feed(pipeline_of(), late)):
        for object_id, mode in zip(forecast.object_id, forecast.agent_mode, strict=True):
            since = step if object_id == CARS[0].object_id else step - 10
            assert mode == (Mode.RUN if since >= contract.history_steps - 1 else Mode.PARTIAL)


def test_an_object_that_is_not_seen_keeps_its_anchor_and_then_goes() -> None:
    """Predicted for 0.3 s from its last measurement, and its age says so."""
    messages = [*traffic(CARS[:2], 2.0)]
    for step in range(21, 27):
        messages += cycle(CARS[:1], step / 10)
    forecasts = feed(pipeline_of(), messages)[21:]
    present = [CARS[1].object_id in forecast.object_id for forecast in forecasts]
    assert present == [True, True, True, False, False, False]
    for forecast in forecasts[:3]:
        row = int(np.flatnonzero(forecast.object_id == CARS[1].object_id)[0])
        assert forecast.anchor_s[row] == pytest.approx(2.0)
        assert forecast.anchor_s[1 - row] == pytest.approx(forecast.timestamp_s)
        assert forecast.age_s[row] == pytest.approx(forecast.made_s - 2.0)
        np.testing.assert_allclose(forecast.position[row], [40.0, 0.0], atol=0.005)


def test_cycles_that_come_too_close_share_a_prediction() -> None:
    """A radar at 20 Hz is predicted ten times a second, and every cycle is tracked."""
    pipeline = pipeline_of()
    messages = [m for step in range(41) for m in cycle(CARS, step / 20)]
    forecasts = feed(pipeline, messages)
    assert len(forecasts) == 21
    assert np.diff([forecast.timestamp_s for forecast in forecasts]) == pytest.approx(0.1)
    assert pipeline.counters.skipped == 20
    assert pipeline.tracks.counters.cycles == 41


@pytest.mark.parametrize("rate_hz", [40, 50])
def test_a_fast_sensor_does_not_leave_its_objects_partial(rate_hz: int) -> None:
    """Two seconds are in their histories after two seconds."""
    messages = []
    for step in range(round(2.2 * rate_hz)):
        cars = object_list(CARS, step / rate_hz)
        messages += encode_cycle(
            cars,
            timestamp_s=step / rate_hz,
            counter=step % 256,
            speed_mps=0.0,
            yaw_rate_rad_s=0.0,
            message_s=1e-4,
        )
    last = feed(pipeline_of(), messages)[-1]
    assert last.agent_mode.tolist() == [Mode.RUN] * 3


def test_every_sensor_may_list_as_many_objects_as_its_count_can_say(tmp_path: Path) -> None:
    pipeline = two_sensors(tmp_path, 0.0)
    everybody = range(255)
    for message in (m for step in range(3) for m in of_both(step, everybody, everybody)):
        pipeline.feed(message, message.timestamp)
        pipeline.poll(message.timestamp)
    pipeline.finish(100.3)
    assert (pipeline.tracks.counters.tracks, pipeline.tracks.counters.dropped) == (510, 0)


def test_a_second_sensor_that_measured_earlier_adds_no_prediction(tmp_path: Path) -> None:
    """Its objects are in the next one."""
    twin = COUNTED.replace('"tiny"', '"twin"', 1).replace(
        "timeout_s", "latency_s = 0.03\ntimeout_s"
    )
    tables = twin[twin.index("[[sensor]]") :]
    profile = profile_of(tmp_path, COUNTED + tables)
    pipeline = Pipeline(profile, shipped_predictor())
    made = []
    for step in range(5):
        for message in (header(1, step), first(20.0, 0.0, 5, counter=step)):
            made += pipeline.feed(message, step / 10)
        made += pipeline.poll(step / 10 + 0.06)
    assert [round(forecast.timestamp_s, 3) for forecast in made] == [0.0, 0.1, 0.2, 0.3, 0.4]
    assert [forecast.num_targets for forecast in made] == [1, 2, 2, 2, 2]


def two_sensors(folder: Path, latency_s: float) -> Pipeline:
    """One that tells at once, and one on ids 0x200 higher that tells so much later."""
    slow = COUNTED[COUNTED.index("[[sensor]]") :].replace('"tiny"', '"slow"', 1)
    keys = f"latency_s = {latency_s}\narbitration_id_offset = 0x200\ntimeout_s"
    profile = profile_of(folder, COUNTED + slow.replace("timeout_s", keys, 1))
    return Pipeline(profile, shipped_predictor())


def of_both(step: int, prompt: Sequence[int], slow: Sequence[int] | None) -> list[can.Message]:
    """Object lists of both sensors 50 ms apart, ten a second; None = the slow one is silent."""
    messages = []
    for offset, late_s, numbers in ((0, 0.0, prompt), (0x200, 0.05, slow)):
        for message in (
            []
            if numbers is None
            else [
                header(len(numbers), step % 16),
                *(first(20.0 + n, 0.0, n, counter=step % 16) for n in numbers),
            ]
        ):
            message.arbitration_id += offset
            message.timestamp = 100.0 + step / 10 + late_s
            messages.append(message)
    return messages


@pytest.mark.parametrize("latency_s", [0.0, 0.2, 0.25, 0.3, 0.35, 0.9])
def test_objects_of_a_sensor_that_tells_later_are_predicted_in_every_cycle(
    tmp_path: Path, latency_s: float
) -> None:
    """From its own newest cycle, and their age is told."""
    pipeline = two_sensors(tmp_path, latency_s)
    made = [f for step in range(40) for f in feed(pipeline, of_both(step, [1], [2]))][-20:]
    assert [f.timestamp_s for f in made] == pytest.approx(102.0 + np.arange(20) / 10, abs=1e-6)
    for forecast in made:
        anchor_s = dict(zip(forecast.object_id.tolist(), forecast.anchor_s, strict=True))
        assert anchor_s[1] == pytest.approx(forecast.timestamp_s, abs=1e-6)
        assert anchor_s[2] == pytest.approx(forecast.timestamp_s - 0.05 - latency_s, abs=1e-6)
        assert (forecast.age_s == forecast.made_s - forecast.anchor_s).all()


@pytest.mark.parametrize("latency_s", [0.0, 0.35])
@pytest.mark.parametrize("slow", [[], None], ids=["lists it no more", "falls silent"])
def test_what_a_sensor_has_not_seen_for_three_tenths_of_a_second_goes_however_late_it_tells(
    tmp_path: Path, latency_s: float, slow: list[int] | None
) -> None:
    """Last seen in the cycle that comes at 102.05 s: there until 102.3, not at 102.4."""
    pipeline = two_sensors(tmp_path, latency_s)
    messages = [m for step in range(21) for m in of_both(step, [1], [2])]
    messages += [m for step in range(21, 30) for m in of_both(step, [1], slow)]
    present = [f.timestamp_s for f in feed(pipeline, messages) if 2 in f.object_id]
    assert max(present) == pytest.approx(102.3, abs=1e-6)


def test_silence_is_said_after_three_periods_and_then_every_period() -> None:
    pipeline = pipeline_of()
    feed(pipeline, traffic(CARS, 1.0))
    said = poll(pipeline, 1.0, 2.0)
    assert {forecast.mode for forecast in said} == {Mode.SILENT}
    np.testing.assert_allclose([f.made_s for f in said], np.arange(1.3, 2.0, 0.1), atol=0.011)
    for forecast in said:
        assert forecast.num_targets == 0
        assert forecast.timestamp_s == pytest.approx(1.0, abs=1e-6)  # how old the input is


def test_the_first_cycle_after_a_silence_is_predicted_again() -> None:
    pipeline = pipeline_of()
    feed(pipeline, traffic(CARS, 1.0))
    poll(pipeline, 1.0, 5.0)
    forecast = feed(pipeline, cycle(CARS, 5.0))[-1]
    assert forecast.mode is Mode.NO_MAP
    assert forecast.num_targets == 3


def test_before_any_input_nothing_is_said() -> None:
    assert poll(pipeline_of(), 0.0, 2.0) == []


def test_an_hour_without_a_message_is_not_made_up_for() -> None:
    """One word of silence when the log goes on, not one for every period that has passed."""
    pipeline = pipeline_of()
    feed(pipeline, traffic(CARS, 1.0))
    said = poll(pipeline, 3600.0, 3600.5)
    assert len(said) in (5, 6)
    assert {forecast.mode for forecast in said} == {Mode.SILENT}


def test_a_clock_that_was_set_back_starts_anew() -> None:
    """Predictions come at once, and cycles that stay unfinished are closed again."""
    pipeline = pipeline_of()
    feed(pipeline, traffic(CARS, 2.0, start_s=5000.0))
    forecasts = feed(pipeline, traffic(CARS, 2.0, start_s=100.0))
    assert [f.timestamp_s for f in forecasts] == pytest.approx(np.arange(100.0, 102.05, 0.1))
    assert {f.num_targets for f in forecasts} == {3}
    unfinished = cycle(CARS, 2.1, start_s=100.0)[:-1]
    assert feed(pipeline, unfinished) == []
    (late,) = poll(pipeline, 102.1, 102.2)
    assert late.timestamp_s == pytest.approx(102.1)


def test_silence_is_said_after_a_clock_that_was_set_back() -> None:
    """Not an hour later."""
    pipeline = pipeline_of()
    feed(pipeline, traffic(CARS, 1.0, start_s=5000.0))
    said = poll(pipeline, 100.0, 101.0)
    assert {forecast.mode for forecast in said} == {Mode.SILENT}
    assert 100.28 <= said[0].made_s <= 100.32


def test_cycles_that_are_too_old_to_be_predicted_do_not_put_silence_off() -> None:
    """What comes was measured before what has been predicted: half a second late."""
    pipeline = pipeline_of()
    feed(pipeline, traffic(CARS, 1.0))
    said = []
    for step in range(5):
        late = cycle(CARS, 1.1 + 0.1 * step)
        for message in aged(late, by_s=0.6):
            said += [*pipeline.poll(message.timestamp), *pipeline.feed(message, message.timestamp)]
    assert {forecast.mode for forecast in said} == {Mode.SILENT}
    assert pipeline.counters.skipped > 0


def test_a_cycle_that_says_it_is_seconds_old_is_not_used_and_undoes_nothing() -> None:
    """A flipped bit in the stated age: the histories go on."""
    pipeline = pipeline_of()
    feed(pipeline, traffic(CARS, 2.0))
    assert feed(pipeline, aged(cycle(CARS, 2.1), by_s=5.0)) == []
    assert pipeline.counters.stale > 0
    (forecast,) = feed(pipeline, cycle(CARS, 2.2))
    assert set(forecast.agent_mode.tolist()) == {Mode.RUN}
    assert pipeline.tracks.counters.resets == 0


def aged(messages: Iterable[can.Message], by_s: float) -> list[can.Message]:
    """The same, but the header of the object list says that it was measured so long before."""
    made = list(messages)
    for message in made:
        if message.arbitration_id == 0x5A3:
            message.data[2:4] = round(1e4 * by_s).to_bytes(2, "little")  # AGE, 0.1 ms per bit
    return made


def test_an_unfinished_cycle_is_predicted_when_its_time_is_over() -> None:
    """Its first car came whole, of the second only the position."""
    pipeline = pipeline_of()
    assert feed(pipeline, cycle(CARS[:2], 0.0)[:-1]) == []
    (forecast,) = poll(pipeline, 0.0, 0.1)
    np.testing.assert_array_equal(forecast.object_id, [7, 3])


@pytest.mark.parametrize("end_s", [0.0, 1.0])
def test_finishing_closes_what_is_open(end_s: float) -> None:
    """Whether or not other messages came since."""
    pipeline = pipeline_of()
    feed(pipeline, cycle(CARS[:2], 0.0)[:-1])
    (forecast,) = pipeline.finish(end_s)
    assert forecast.num_targets == 2
    assert pipeline.finish(end_s) == []


def test_a_cycle_without_objects_says_that_there_are_none() -> None:
    (forecast,) = feed(pipeline_of(), cycle([], 0.0))
    assert (forecast.num_targets, forecast.mode) == (0, Mode.NO_MAP)


def test_a_map_makes_full_service() -> None:
    forecasts = feed(pipeline_of(tile=TILE), traffic(CARS, 0.5, pose=POSE))
    assert {forecast.mode for forecast in forecasts} == {Mode.RUN}
    assert {forecast.tile_id for forecast in forecasts} == {load_tile(TILE).info.tile_id}


def test_without_a_pose_a_map_is_no_use() -> None:
    """Objects are predicted all the same, without it."""
    forecasts = feed(pipeline_of(tile=TILE), traffic(CARS, 0.5))
    assert {forecast.mode for forecast in forecasts} == {Mode.NO_POSE}
    without = feed(pipeline_of(), traffic(CARS, 0.5))
    assert {forecast.mode for forecast in without} == {Mode.NO_MAP}
    np.testing.assert_array_equal(forecasts[-1].trajectories, without[-1].trajectories)


def test_without_ego_motion_nothing_is_predicted_unless_the_sensor_stands_still() -> None:
    """The object list alone does not say how the car moves under it."""
    alone = [m for m in traffic(CARS, 0.5) if m.arbitration_id != 0x5A0]
    forecasts = feed(pipeline_of(), alone)
    assert {(f.mode, f.num_targets) for f in forecasts} == {(Mode.NO_POSE, 0)}
    assert {f.map_from_ego for f in forecasts} == {None}
    profile = load_profile("generic")
    standing = feed(Pipeline(profile, shipped_predictor(), stationary=True), alone)
    assert {(f.mode, f.num_targets) for f in standing} == {(Mode.NO_MAP, 3)}


def test_predictions_turn_and_move_with_the_map() -> None:
    """Where the map has its origin is no matter to anybody: within a millimetre."""
    here = feed(pipeline_of(), traffic(CARS, 2.0, pose=POSE))[-1]
    elsewhere = Pose2(4000.0, -2500.0, 2.0)
    there = feed(pipeline_of(), traffic(CARS, 2.0, pose=elsewhere))[-1]
    np.testing.assert_allclose(elsewhere.apply(here.position), there.position, atol=1e-3)
    np.testing.assert_allclose(elsewhere.apply(here.trajectories), there.trajectories, atol=1e-3)


class Stub:
    """The shipped model, until told otherwise."""

    def __init__(self) -> None:
        self.contract: ModelContract = shipped_predictor().contract
        self.model_id = "stub"
        self.runs = 0

    def predict(self, scene: Scene) -> Prediction:
        self.runs += 1
        return shipped_predictor().predict(scene)

    def again(self) -> Model:
        return Stub()


class Altered(Stub):
    """Something is done to what it says."""

    def __init__(self, rows: slice, value: float) -> None:
        super().__init__()
        self._rows, self._value = rows, value

    def predict(self, scene: Scene) -> Prediction:
        prediction = super().predict(scene)
        trajectories = prediction.trajectories.copy()
        trajectories[self._rows, :, 10:] = self._value
        return replace(prediction, trajectories=trajectories)


class Raising(Stub):
    """Raises in some of its runs."""

    def __init__(self, runs: Container[int]) -> None:
        super().__init__()
        self._raising = runs

    def predict(self, scene: Scene) -> Prediction:
        prediction = super().predict(scene)
        if self.runs - 1 in self._raising:
            raise RuntimeError("out of memory")
        return prediction


def pipeline_with(model: Model, clock: Callable[[], float] | None = None) -> Pipeline:
    return Pipeline(load_profile("generic"), model, clock=clock)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e9])
def test_an_impossible_prediction_is_replaced_and_marked(value: float) -> None:
    """For one car: the cycle goes on. For all of them: the cycle says so."""
    for rows, mode in ((slice(1, 2), Mode.NO_MAP), (slice(None), Mode.FALLBACK)):
        pipeline = pipeline_with(Altered(rows, value))
        last = feed(pipeline, traffic(CARS, 2.0))[-1]
        assert last.mode is mode
        fell_back = last.agent_mode == Mode.FALLBACK
        np.testing.assert_array_equal(np.flatnonzero(fell_back), np.arange(3)[rows])
        asked = 21 if not np.isfinite(value) else 21 - (MIN_STEPS - 1)  # not of what is just found
        assert pipeline.counters.fallbacks == asked * fell_back.sum()
        end = last.position + 3.0 * last.velocity
        np.testing.assert_allclose(last.trajectories[1, 0, -1], end[1], atol=0.2)


def test_a_model_that_raises_costs_its_cycle_and_no_other() -> None:
    """Physics answers for it; the cycle's mode stays for half a second, the objects' do not."""
    pipeline = pipeline_with(Raising({5}))
    forecasts = feed(pipeline, traffic(CARS, 2.0))
    assert len(forecasts) == 21
    fell_back = [bool((f.agent_mode == Mode.FALLBACK).all()) for f in forecasts]
    assert fell_back == [number == 5 for number in range(21)]
    modes = [forecast.mode for forecast in forecasts]
    assert modes == [Mode.NO_MAP] * 5 + [Mode.FALLBACK] * 5 + [Mode.NO_MAP] * 11
    assert np.isfinite(forecasts[5].trajectories).all()
    assert (pipeline.counters.model_errors, pipeline.counters.fallbacks) == (1, 3)


ONCOMING = Car(object_id=7, x_m=120.0, y_m=0.0, speed_mps=-25.0)


@pytest.mark.parametrize("model", [Stub, lambda: Raising({0}), lambda: Altered(slice(1), 1e9)])
def test_a_car_that_was_seen_once_goes_on_as_the_sensor_says(model: Callable[[], Model]) -> None:
    """Whether the model fails or has another opinion: 75 m nearer after 3 s, not where it is."""
    (forecast,) = feed(pipeline_with(model()), cycle([ONCOMING], 0.0))
    np.testing.assert_allclose(forecast.velocity, [[-25.0, 0.0]], atol=0.05)
    np.testing.assert_allclose(forecast.trajectories[0, 0, -1], [45.0, 0.0], atol=0.2)
    assert not forecast.is_standstill_assumed.any()


def test_a_car_that_was_seen_once_goes_on_though_there_is_no_time_for_the_model() -> None:
    model = Slow(0.01)
    model.now_s = 0.08
    pipeline = pipeline_with(model, model.clock)
    (forecast,) = pipeline_fed(pipeline, cycle([ONCOMING], 0.0), 0.0)
    assert forecast.agent_mode.tolist() == [Mode.LATE]
    np.testing.assert_allclose(forecast.trajectories[0, 0, -1], [45.0, 0.0], atol=0.2)


@pytest.mark.parametrize("fails", [False, True])
def test_of_what_was_seen_once_by_a_sensor_that_measures_no_velocity_none_is_known(
    tmp_path: Path, *, fails: bool
) -> None:
    """Nobody can say where it goes. From the second cycle on there is a velocity."""
    model = Raising({0, 1} if fails else ())
    pipeline = Pipeline(profile_of(tmp_path, COUNTED), model)
    made = []
    for step in range(2):
        for message in (header(1, step), first(20.0 - step, 0.0, 5, counter=step)):
            made += pipeline.feed(message, step / 10)
    made += pipeline.finish(0.1)
    assert np.isnan(made[0].velocity).all()
    assert made[0].is_standstill_assumed.tolist() == [True]
    np.testing.assert_allclose(made[1].velocity, [[-10.0, 0.0]], atol=0.1)
    assert made[1].is_standstill_assumed.tolist() == [False]


def test_a_prediction_that_took_longer_than_a_period_says_so() -> None:
    """By a clock on which every look takes 30 ms: over when the model has answered."""
    looks = itertools.count()
    pipeline = pipeline_with(shipped_predictor(), clock=lambda: 0.03 * next(looks))
    (forecast,) = feed(pipeline, cycle(CARS, 0.0))
    assert forecast.mode is Mode.LATE
    assert forecast.compute_s > 0.1


class Slow(Stub):
    """Takes its time, by a clock of its own that the pipeline goes by."""

    def __init__(self, seconds_per_run: float) -> None:
        super().__init__()
        self.now_s = 0.0
        self._seconds = seconds_per_run

    def predict(self, scene: Scene) -> Prediction:
        self.now_s += self._seconds
        return super().predict(scene)

    def clock(self) -> float:
        return self.now_s


def crowd(count: int) -> list[Car]:
    """Cars that stand 2 m apart ahead of the ego vehicle, the farthest first."""
    return [Car(object_id=n, x_m=10.0 + 2.0 * n, y_m=0.0, speed_mps=0.0) for n in range(count)][
        ::-1
    ]


@pytest.mark.parametrize(
    ("seconds_per_run", "predicted"), [(0.01, 80), (0.02, 80), (0.03, 64), (0.05, 32)]
)
def test_what_there_is_no_time_for_is_the_farthest(seconds_per_run: float, predicted: int) -> None:
    """80 cars in batches of 32, in the 70 ms of a cycle: the rest goes by physics and says so."""
    model = Slow(seconds_per_run)
    pipeline = pipeline_with(model, model.clock)
    (forecast,) = pipeline_fed(pipeline, cycle(crowd(80), 0.0), 0.0)
    np.testing.assert_array_equal(forecast.object_id, np.arange(80))
    late = forecast.agent_mode == Mode.LATE
    np.testing.assert_array_equal(np.flatnonzero(late), np.arange(predicted, 80))
    assert (forecast.agent_mode[:predicted] == Mode.PARTIAL).all()
    assert forecast.mode is (Mode.LATE if predicted < 80 else Mode.NO_MAP)
    standing = np.broadcast_to(forecast.position[:, None, None], forecast.trajectories.shape)
    np.testing.assert_array_equal(forecast.trajectories[late], standing[late])
    assert pipeline.counters.shed == 80 - predicted
    assert pipeline.counters.fallbacks == 0


def test_a_cycle_that_waited_too_long_is_not_given_to_the_model() -> None:
    """It came 80 ms ago: nothing queues up behind it."""
    model = Slow(0.01)
    model.now_s = 0.08
    pipeline = pipeline_with(model, model.clock)
    (forecast,) = pipeline_fed(pipeline, cycle(CARS, 0.0), 0.0)
    assert (forecast.agent_mode == Mode.LATE).all()
    assert (forecast.mode, model.runs) == (Mode.LATE, 0)
    (forecast,) = pipeline_fed(pipeline, cycle(CARS, 0.1), 0.1)  # 20 ms early
    assert (forecast.agent_mode == Mode.PARTIAL).all()
    assert (pipeline.counters.shed, pipeline.counters.targets) == (3, 6)


def pipeline_fed(
    pipeline: Pipeline, messages: Iterable[can.Message], arrived_s: float
) -> list[ForecastSet]:
    """All at the same time."""
    return [made for message in messages for made in pipeline.feed(message, arrived_s)]


def test_a_messages_channel_decides_which_bus_it_is_of() -> None:
    """The same messages on another bus of the car are nobody's."""
    profile = load_profile("toyota-rav4")
    lines = first_seconds(DRIVES["rav4"].log, 1.0).splitlines()
    messages = [candump_message(line) for line in lines]
    found = []
    for channels in (DRIVES["rav4"].roles, {"radar": "can0", "car": "can1"}):
        pipeline = Pipeline(profile, shipped_predictor(), channels=channels)
        feed(pipeline, messages)
        found.append(pipeline.decoder.counters.objects)
    assert found[0] > 50
    assert found[1] == 0
