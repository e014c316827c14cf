"""The budgets of deploy/budgets.toml, kept in this process; `make bench` measures them.

Every round waits for its tick, as in the car: caches and clocks have gone cold. Without measuring,
each is one round that checks what came out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drives import TILE, shipped_predictor
from eqrt.runtime.bench.budget import load_budget
from eqrt.runtime.bench.percentiles import estimates, samples_needed
from eqrt.runtime.bench.predictors import PHYSICS
from eqrt.runtime.bench.report import MODEL, SERVICE, counted
from eqrt.runtime.bench.scenes import ScenePool, record_scenes
from eqrt.runtime.bench.service.crowd import PROFILE, Cycle, crowded_cycles
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Prediction
from eqrt.runtime.prediction.tiles import load_tile
from source_tree import ROOT

PATH = ROOT / "deploy/budgets.toml"
BUDGETS = {benchmark: load_budget(PATH, benchmark) for benchmark in (MODEL, SERVICE)}
ROUNDS = round(1.05 * samples_needed("p99"))
WARM_UP = 25  # rounds: histories of 20 steps fill up
HORIZON, DT_S = 30, 0.1  # of physics


@pytest.fixture(scope="module")
def pool() -> ScenePool:
    return record_scenes(DEFAULT_ARTIFACT)


@pytest.mark.parametrize("targets", sorted(BUDGETS[MODEL].targets))
def test_the_model_keeps_its_budget(benchmark: Any, pool: ScenePool, targets: int) -> None:
    predictor = shipped_predictor()
    contract = predictor.contract

    def predict(number: int) -> Prediction:
        return predictor.predict(pool.draw(number, targets))

    found = measured(benchmark, predict, MODEL)
    shape = (targets, contract.num_modes, contract.horizon_steps, 2)
    assert found.trajectories.shape == shape
    assert np.isfinite(found.trajectories).all()
    judge(benchmark, MODEL, targets)


@pytest.mark.parametrize("objects", sorted(BUDGETS[SERVICE].targets))
def test_the_pipeline_keeps_the_budget_of_the_service(benchmark: Any, objects: int) -> None:
    """From the last message of a cycle to its predictions, on no bus: what the bus adds is free."""
    drive = _Drive(objects)
    found = measured(benchmark, drive.last_message, SERVICE, before=drive.all_but_the_last)
    assert found.num_targets >= objects
    assert np.isfinite(found.trajectories).all()
    judge(benchmark, SERVICE, objects)


@pytest.mark.parametrize("name", PHYSICS)
@pytest.mark.parametrize("targets", sorted(BUDGETS[MODEL].targets))
def test_what_physics_costs(benchmark: Any, pool: ScenePool, name: str, targets: int) -> None:
    """For comparison: it has no budget."""
    scene = pool.draw(0, targets)
    found = benchmark.pedantic(PHYSICS[name], (scene, HORIZON, DT_S), rounds=300, warmup_rounds=20)
    assert found.shape == (targets, HORIZON, 2)
    assert np.isfinite(found).all()


def measured(
    benchmark: Any,
    run: Callable[[int], Any],
    duty: str,
    before: Callable[[int], None] = lambda _number: None,
) -> Any:
    """What the last round gave; `before` is not in its time."""
    rate_hz = BUDGETS[duty].rate_hz
    assert rate_hz is not None
    ticks = _ticks(1.0 / rate_hz) if benchmark.enabled else iter(range(WARM_UP + 1))

    def wait() -> tuple[tuple[int], dict[str, Any]]:
        number = next(ticks)
        before(number)
        return (number,), {}

    for _ in range(WARM_UP):
        run(*wait()[0])
    return benchmark.pedantic(run, setup=wait, rounds=ROUNDS if benchmark.enabled else 1)


def judge(benchmark: Any, of: str, count: int) -> None:
    """Compare the percentiles of the rounds with the limits, if they were measured."""
    if not benchmark.enabled:
        return
    rounds_ns = np.round(1e9 * np.array(benchmark.stats.stats.data)).astype(np.int64)
    found = {f"{name}_ms": one.value_ns / 1e6 for name, one in estimates(rounds_ns).items()}
    limits = BUDGETS[of].targets[count]
    over = [
        f"{counted(count, of)}: {key.removesuffix('_ms')} is {found[key]:.4g} ms, allowed {limit:g}"
        for key, limit in limits.items()
        if key in found and found[key] > limit
    ]
    if over:
        pytest.fail("; ".join(over), pytrace=False)


def _ticks(period_s: float) -> Iterator[int]:
    """0, 1, 2, ... at their times, which do not wait for who is late."""
    start_s = time.perf_counter()
    number = 0
    while True:
        due_s = start_s + number * period_s
        time.sleep(max(0.0, due_s - time.perf_counter()))
        yield number
        number += 1


class _Drive:
    """A pipeline, and the messages of the next cycle."""

    def __init__(self, objects: int) -> None:
        tile = load_tile(Path(TILE))
        self._pipeline = Pipeline(load_profile(PROFILE), shipped_predictor(), tile)
        self._cycles: list[Cycle] = list(crowded_cycles(objects))

    def all_but_the_last(self, number: int) -> None:
        """Of the messages of this cycle."""
        for message in self._messages(number)[:-1]:
            assert not self._feed(number, message)

    def last_message(self, number: int) -> ForecastSet:
        """And what it makes the pipeline predict."""
        (made,) = self._feed(number, self._messages(number)[-1])
        return made

    def _messages(self, number: int) -> Cycle:
        return self._cycles[number % len(self._cycles)]

    def _feed(self, number: int, message: can.Message) -> list[ForecastSet]:
        now_s = number / 10 + message.timestamp
        return [*chain(self._pipeline.poll(now_s), self._pipeline.feed(message, now_s))]
