"""A state machine throws faults at the pipeline, in any order; its promises hold, and it recovers.

`test_pipeline.py` says what the pipeline does with good input. Here hypothesis looks for a history
of bad input after which it does something else.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

import can
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from drives import TILE, Car, object_list, shipped_predictor
from eqrt.core.contract import ModelContract
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.prediction.watched import Model
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
    nothing,
    reorder,
    truncate,
)

EXAMPLES = int(os.environ.get("FAULT_EXAMPLES", "15"))
PROFILE = load_profile("generic")
IDS = sorted(PROFILE.arbitration_ids)
CARS = tuple(
    Car(object_id=n, x_m=8.0 + 9.0 * n, y_m=3.5 * (n % 3), speed_mps=0.0) for n in range(4)
)
POSE = Pose2(0.0, 0.0, 0.0)
SHARES = st.sampled_from([0.01, 0.1, 0.5, 1.0])
FAULTS: st.SearchStrategy[Operator] = st.one_of(
    st.just(nothing),
    SHARES.map(drop),
    st.builds(burst, SHARES, st.integers(2, 40)),
    SHARES.map(duplicate),
    st.builds(reorder, SHARES, st.integers(1, 20)),
    st.builds(delay, SHARES, st.sampled_from([0.02, 0.2, 2.0])),
    st.builds(corrupt, SHARES, st.integers(1, 8)),
    SHARES.map(truncate),
    SHARES.map(extreme),
    st.builds(flood, st.integers(1, 4), st.just(IDS)),
)


class Faulty:
    """The shipped model, which raises or says nonsense when it is told to."""

    def __init__(self) -> None:
        self.contract: ModelContract = shipped_predictor().contract
        self.model_id = shipped_predictor().model_id
        self.fault = "none"

    def predict(self, scene: Scene) -> Prediction:
        if self.fault == "raises":
            raise RuntimeError("no memory")
        prediction = shipped_predictor().predict(scene)
        if self.fault == "says NaN":
            return replace(prediction, trajectories=np.full_like(prediction.trajectories, np.nan))
        if self.fault == "says far away":
            return replace(prediction, trajectories=prediction.trajectories + 1e6)
        return prediction

    def again(self) -> Model:
        return self


class PipelineMachine(RuleBasedStateMachine):
    """A drive, and what happens to it."""

    @initialize(with_tile=st.booleans())
    def begin(self, with_tile: bool) -> None:
        """A pipeline before its first message."""
        self.model = Faulty()
        self.pipeline = Pipeline(PROFILE, self.model, load_tile(TILE) if with_tile else None)
        self.promises = Promises(self.model.contract.dt_s)
        self.now_s = 1000.0
        self.step = 0
        self.made: list[ForecastSet] = []

    @rule(cycles=st.integers(1, 12), fault=FAULTS, other=FAULTS, seed=st.integers(0, 99))
    def drive(self, cycles: int, fault: Operator, other: Operator, seed: int) -> None:
        """For some cycles, through two faults at once."""
        self._feed(CARS, cycles, composed(fault, other), seed)

    @rule(count=st.sampled_from([0, 1, 65, 255]), seed=st.integers(0, 99))
    def meet(self, count: int, seed: int) -> None:
        """Another number of objects, up to all that a list can hold, in any order of ids."""
        order = np.random.default_rng(seed).permutation(255)[:count].tolist()
        crowd = [
            Car(object_id=n, x_m=2.0 + n % 50, y_m=4.0 * (n // 50), speed_mps=0.0) for n in order
        ]
        self._feed(crowd, 2, nothing, seed)

    @rule(seconds=st.sampled_from([0.05, 0.2, 0.35, 1.0, 5.0]))
    def hear_nothing(self, seconds: float) -> None:
        """The bus is quiet."""
        self._until(self.now_s + seconds)

    @rule(by_s=st.sampled_from([-3600.0, -5.0, 0.5, 60.0, 86_400.0]))
    def jump(self, by_s: float) -> None:
        """The log's clock is set, as that of a recorder may be; silence is counted anew.

        (Stamps that go back by less than a second are taken for disorder in the log.)
        """
        self.now_s = max(self.now_s + by_s, 1.0)
        for forecast in self.pipeline.poll(self.now_s):
            self._look(forecast)
        self.promises.clock_was_set(self.now_s)

    @rule(fault=st.sampled_from(["none", "raises", "says NaN", "says far away"]))
    def break_the_model(self, fault: str) -> None:
        """Or mend it."""
        self.model.fault = fault

    @precondition(lambda self: self.model.fault == "none")
    @rule()
    def recover(self) -> None:
        """Whatever was before: three seconds of good input, and everybody is predicted in full."""
        self._feed(CARS, 31, nothing, 0)
        last = self.made[-1]
        assert sorted(last.object_id.tolist()) == [car.object_id for car in CARS]
        assert set(last.agent_mode.tolist()) == {Mode.RUN}
        assert last.mode is (Mode.RUN if self.pipeline.tile else Mode.NO_MAP)

    def teardown(self) -> None:
        """Once more at the end."""
        if hasattr(self, "model"):
            self.model.fault = "none"
            self.recover()

    def _feed(self, cars: Sequence[Car], cycles: int, fault: Operator, seed: int) -> None:
        """Ten cycles a second from now on."""
        begun_s = self.now_s
        messages = [m for number in range(cycles) for m in self._cycle(cars, begun_s + number / 10)]
        injected = Injected()
        injected.dice.seed(seed)
        for message in fault(messages, injected):
            self._until(message.timestamp)
            for forecast in self.pipeline.feed(message, self.now_s):
                self._look(forecast)
        self._until(begun_s + cycles / 10)

    def _cycle(self, cars: Sequence[Car], time_s: float) -> list[can.Message]:
        self.step += 1
        return encode_cycle(
            object_list(cars, 0.0),
            timestamp_s=time_s,
            counter=self.step,
            speed_mps=0.0,
            yaw_rate_rad_s=0.0,
            map_from_ego=POSE,
        )

    def _look(self, forecast: ForecastSet) -> None:
        self.made.append(forecast)
        self.promises.look(forecast, self.now_s)

    def _until(self, end_s: float) -> None:
        """Time passes, as a service lets it: a hundredth at a time."""
        while self.now_s < end_s:
            self.now_s = min(self.now_s + 0.01, end_s)
            for forecast in self.pipeline.poll(self.now_s):
                self._look(forecast)
            self.promises.tick(self.now_s)


Machine = PipelineMachine.TestCase
Machine.settings = settings(
    max_examples=EXAMPLES,
    stateful_step_count=10,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


@pytest.mark.parametrize("seed", range(3))
def test_no_fault_at_all_breaks_no_promise(seed: int) -> None:
    """The promises can be kept: so much is true of good input."""
    machine = PipelineMachine()
    machine.begin(seed == 1)
    machine.recover()
    machine.hear_nothing(1.0)
    machine.recover()
