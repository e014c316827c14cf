"""Faults on the way from the sensor to the pipeline, on a simulated clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import can
import numpy as np

from drives import Car, object_list, shipped_predictor
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.watched import Model
from faults.outcome import Outcome
from faults.promises import Promises
from faults.streams import (
    Injected,
    Operator,
    burst,
    composed,
    corrupt,
    delay,
    drop,
    duplicate,
    extreme,
    flood,
    jump_clock,
    nothing,
    reorder,
    truncate,
)

PROFILE = load_profile("generic")
IDS = sorted(PROFILE.arbitration_ids)
CARS = tuple(
    Car(object_id=n, x_m=8.0 + 12.0 * n, y_m=3.5 * (n % 3), speed_mps=6.0 + n) for n in range(8)
)
GOOD_S, BAD_S, AFTER_S = 3.0, 5.0, 6.0
HERE = Pose2(0.0, 0.0, 0.0)

FAULTS: dict[str, Operator] = {
    "none": nothing,
    "1 % of messages lost": drop(0.01),
    "20 % of messages lost": drop(0.2),
    "every message lost": drop(1.0),
    "bursts of 40 messages lost": burst(0.3, 40),
    "every message twice": duplicate(1.0),
    "30 % of messages overtaken by up to 10 others": reorder(0.3, 10),
    "30 % of messages up to 0.5 s late": delay(0.3, 0.5),
    "one bit flipped in 10 % of messages": corrupt(0.1),
    "eight bits flipped in every message": corrupt(1.0, 8),
    "30 % of messages cut short": truncate(0.3),
    "signals all ones or all zeros in 30 % of messages": extreme(0.3),
    "four random messages of the profile's ids between any two": flood(4, IDS),
    "the log's clock set an hour forward": jump_clock(200, 3600.0),
    "the log's clock set an hour back": jump_clock(200, -3600.0),
    "loss, flips, disorder and babble at once": composed(
        drop(0.1), corrupt(0.1), reorder(0.2), flood(1, IDS)
    ),
}


class Broken:
    """The shipped model, of which something is broken from `begin_s` to `end_s`."""

    def __init__(self, fault: str) -> None:
        self.contract = shipped_predictor().contract
        self.model_id = shipped_predictor().model_id
        self.fault = fault
        self.struck = 0
        self.is_broken = False

    def predict(self, scene: Scene) -> Prediction:
        said = shipped_predictor().predict(scene)
        if not self.is_broken or self.fault == "none":
            return said
        self.struck += 1
        if self.fault == "raises":
            raise RuntimeError("no memory")
        wrong = np.nan if self.fault == "NaN" else said.trajectories + 1e5
        return replace(said, trajectories=np.broadcast_to(wrong, said.trajectories.shape).copy())

    def again(self) -> Model:
        return self


def message_faults() -> Iterator[Outcome]:
    """All of them, one after the other."""
    for name, operator in FAULTS.items():
        yield _Run(Broken("none")).outcome(name, operator, "messages")
    for fault, name in (
        ("raises", "the model raises in every run"),
        ("NaN", "the model says NaN"),
        ("far", "the model predicts 100 km away"),
    ):
        yield _Run(Broken(fault)).outcome(name, nothing, "runs")
    crowd = [
        Car(object_id=n, x_m=2.0 + n % 50, y_m=4.0 * (n // 50), speed_mps=0.0) for n in range(255)
    ]
    yield _Run(Broken("none"), crowd).outcome("255 objects instead of 8", nothing, "objects")
    reused = [replace(car, object_id=(car.object_id + 3) % 8) for car in CARS]
    yield _Run(Broken("none"), reused).outcome("all ids change hands", nothing, "objects")


class _Run:
    """Good traffic, the fault, good traffic."""

    def __init__(self, model: Broken, cars_meanwhile: Sequence[Car] = CARS) -> None:
        self._model = model
        self._meanwhile = cars_meanwhile
        self._pipeline = Pipeline(PROFILE, model)
        self._promises = Promises(model.contract.dt_s)
        self._now_s = 10_000.0
        self._cycle = 0
        self._said: Counter[str] = Counter()
        self._listening = False

    def outcome(self, name: str, fault: Operator, unit: str) -> Outcome:
        injected, recovery_s, broken = Injected(), None, ""
        try:
            self._drive(CARS, 0.0, GOOD_S, nothing, injected)
            self._listening = self._model.is_broken = True
            self._drive(self._meanwhile, GOOD_S, BAD_S, fault, injected)
            self._listening = self._model.is_broken = False
            recovery_s = self._drive(CARS, GOOD_S + BAD_S, AFTER_S, nothing, injected)
        except AssertionError as error:
            broken = str(error).splitlines()[0]
        count = injected.count or self._model.struck or _changed(self._meanwhile)
        said = ", ".join(f"{mode} {share}" for mode, share in self._said.most_common())
        return Outcome(name, f"{count} {unit}" if count else "", broken, said, recovery_s)

    def _drive(
        self,
        cars: Sequence[Car],
        begin_s: float,
        seconds: float,
        fault: Operator,
        injected: Injected,
    ) -> float | None:
        """How long after the beginning all objects were predicted in full, and stayed so."""
        start_s, recovered_s = self._now_s, None
        steps = range(round(10 * seconds))
        messages = [
            message
            for step in steps
            for message in self._messages(cars, begin_s + step / 10, start_s + step / 10)
        ]
        for message in fault(messages, injected):
            if abs(message.timestamp - self._now_s) > 1000.0:
                self._now_s = message.timestamp
                self._promises.clock_was_set(self._now_s)
            for forecast in [*self._wait(message.timestamp), *self._feed(message)]:
                if not self._in_full(forecast):
                    recovered_s = None
                elif recovered_s is None:
                    recovered_s = self._now_s - start_s
        if abs(self._now_s - start_s) < 1000.0:  # else the clock was set meanwhile
            for _ in self._wait(start_s + seconds):
                recovered_s = None
        return recovered_s

    def _messages(self, cars: Sequence[Car], drive_s: float, time_s: float) -> list[can.Message]:
        self._cycle += 1
        return encode_cycle(
            object_list(cars, drive_s),
            timestamp_s=time_s,
            counter=self._cycle,
            speed_mps=0.0,
            yaw_rate_rad_s=0.0,
            map_from_ego=HERE,
        )

    def _wait(self, end_s: float) -> Iterator[ForecastSet]:
        while self._now_s < end_s:
            self._now_s = min(self._now_s + 0.01, end_s)
            yield from self._looked_at(self._pipeline.poll(self._now_s))
            self._promises.tick(self._now_s)

    def _feed(self, message: can.Message) -> Iterator[ForecastSet]:
        return self._looked_at(self._pipeline.feed(message, self._now_s))

    def _looked_at(self, forecasts: Sequence[ForecastSet]) -> Iterator[ForecastSet]:
        for forecast in forecasts:
            self._promises.look(forecast, self._now_s)
            if self._listening:
                self._said[forecast.mode.name] += 1
            yield forecast

    def _in_full(self, forecast: ForecastSet) -> bool:
        return (
            forecast.num_targets == len(CARS)
            and forecast.mode is Mode.NO_MAP
            and set(forecast.agent_mode.tolist()) == {Mode.RUN}
        )


def _changed(cars: Sequence[Car]) -> int:
    return 0 if cars is CARS else len(cars)
