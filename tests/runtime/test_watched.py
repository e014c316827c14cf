"""A model that raises, hangs, or is broken for good: the service stops waiting and gets it back."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from drives import shipped_predictor
from eqrt.core.errors import ContractError
from eqrt.core.scene import Scene
from eqrt.runtime.prediction import watched
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.watched import MAX_ERRORS, Direct, Failed, TooLate, Watched

CONTRACT = shipped_predictor().contract


def scene(targets: int = 1) -> Scene:
    """Cars that stand alone."""
    c = CONTRACT
    return Scene(
        history=np.zeros((targets, c.num_agents, c.history_steps, 2), np.float32),
        history_valid=np.ones((targets, c.num_agents, c.history_steps), np.bool_),
        heading=np.zeros((targets, 2), np.float32),
        centerlines=np.zeros((targets, c.num_centerlines, c.centerline_points, 2), np.float32),
        centerlines_valid=np.zeros((targets, c.num_centerlines, c.centerline_points), np.bool_),
        origin=np.zeros(2),
    )


class Scripted:
    """A model whose runs do what they are told; when loaded anew, it is the next of the family."""

    contract = CONTRACT

    def __init__(self, *family: Callable[[int], None]) -> None:
        """`family`: what each generation does in its run number n."""
        self._family = family
        self.model_id = "scripted"
        self.runs = 0

    def predict(self, scene: Scene) -> Prediction:
        self.runs += 1
        self._family[0](self.runs - 1)
        return shipped_predictor().predict(scene)

    def again(self) -> Scripted:
        if len(self._family) == 1:
            raise ContractError("model.onnx: damaged")
        return Scripted(*self._family[1:])


def well(_run: int) -> None:
    """Nothing happens."""


def broken(_run: int) -> None:
    raise RuntimeError("no memory\nand a stack trace")


@pytest.fixture
def hang() -> Iterator[Callable[[int], None]]:
    """Does not come back before the test is over."""
    over = threading.Event()

    def wait(_run: int) -> None:
        over.wait(60.0)

    yield wait
    over.set()


@pytest.mark.parametrize("runner", [Direct, Watched])
def test_a_model_that_works_says_the_same_however_it_is_run(
    runner: type[Direct] | type[Watched],
) -> None:
    model = runner(shipped_predictor())
    for targets in (1, 40, 1):
        said = model.run(scene(targets), 60.0)
        expected = shipped_predictor().predict(scene(targets))
        np.testing.assert_array_equal(said.trajectories, expected.trajectories)
        np.testing.assert_array_equal(said.probabilities, expected.probabilities)
    assert (model.errors, model.overruns, model.restarts) == (0, 0, 0)


@pytest.mark.parametrize("runner", [Direct, Watched])
def test_an_error_in_the_model_is_an_outcome(runner: type[Direct] | type[Watched]) -> None:
    def once(run: int) -> None:
        if run == 0:
            raise RuntimeError("no memory")

    model = runner(Scripted(once))
    with pytest.raises(Failed, match="no memory") as caught:
        model.run(scene(), 60.0)
    assert not isinstance(caught.value, TooLate)
    model.run(scene(), 60.0)
    assert model.errors == 1


def test_a_model_that_does_not_answer_in_time_is_not_waited_for() -> None:
    """What it says later is nobody's answer; then it is asked again."""
    answered = threading.Event()

    def first_is_slow(run: int) -> None:
        if run == 0:
            answered.wait(60.0)

    script = Scripted(first_is_slow)
    model = Watched(script)
    begun_s = time.monotonic()
    with pytest.raises(TooLate):
        model.run(scene(1), 0.05)
    assert 0.05 <= time.monotonic() - begun_s < 5.0
    with pytest.raises(Failed, match="earlier scene"):
        model.run(scene(2), 60.0)
    answered.set()
    said = _eventually(lambda: model.run(scene(3), 60.0))
    assert len(said.trajectories) == 3
    assert (model.overruns, model.errors, model.restarts, script.runs) == (1, 0, 0, 2)


def test_a_model_that_is_stuck_is_loaded_anew(
    hang: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watched, "STUCK_S", 0.2)
    model = Watched(Scripted(hang, well))
    with pytest.raises(TooLate):
        model.run(scene(), 0.01)
    with pytest.raises(Failed):  # not stuck yet
        model.run(scene(), 0.01)
    assert model.restarts == 0
    said = _eventually(lambda: model.run(scene(2), 60.0))
    assert len(said.trajectories) == 2
    assert (model.overruns, model.restarts) == (1, 1)


def test_a_model_that_keeps_failing_is_loaded_anew() -> None:
    model = Watched(Scripted(broken, well))
    for _ in range(MAX_ERRORS):
        with pytest.raises(Failed):
            model.run(scene(), 60.0)
    _eventually(lambda: model.run(scene(), 60.0))
    assert model.restarts == 1
    assert model.errors >= MAX_ERRORS


def test_errors_that_are_not_in_a_row_leave_it_alone() -> None:
    def sometimes(run: int) -> None:
        if run % MAX_ERRORS:
            raise RuntimeError("no memory")

    model = Watched(Scripted(sometimes, well))
    for run in range(4 * MAX_ERRORS):
        if run % MAX_ERRORS:
            with pytest.raises(Failed):
                model.run(scene(), 60.0)
        else:
            model.run(scene(), 60.0)
    assert model.restarts == 0


def test_a_model_that_cannot_be_loaded_any_more_is_tried_again_after_a_pause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And meanwhile asked as before: it may come back by itself."""
    tries: list[float] = []

    class Damaged(Scripted):
        def again(self) -> Scripted:
            tries.append(time.monotonic())
            raise ContractError("model.onnx: damaged")

    monkeypatch.setattr(watched, "STUCK_S", 0.05)
    model = Watched(Damaged(lambda run: broken(run) if run < 60 else well(run)))
    model._pause_s = 0.05
    begun_s = time.monotonic()
    while time.monotonic() - begun_s < 60.0:
        try:
            model.run(scene(), 60.0)
            break
        except Failed:
            time.sleep(0.02)
    assert model.errors == 60
    assert model.restarts == 0
    assert len(tries) >= 2
    assert (np.diff(np.diff(tries)) > 0).all()  # the pauses grow


def test_another_model_in_the_same_folder_is_not_taken_for_this_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Files that were replaced wait for a reload, which looks at the contract."""
    tried = threading.Event()

    class Replaced(Scripted):
        def again(self) -> Scripted:
            other = Scripted(well)
            other.model_id = "other"
            tried.set()
            return other

    monkeypatch.setattr(watched, "STUCK_S", 0.05)
    model = Watched(Replaced(broken))
    while not tried.is_set():
        with pytest.raises(Failed):
            model.run(scene(), 60.0)
        time.sleep(0.01)
    time.sleep(0.2)
    with pytest.raises(Failed, match="no memory"):
        model.run(scene(), 60.0)
    assert model.restarts == 0


def _eventually(ask: Callable[[], Prediction]) -> Prediction:
    """The first answer; at most a minute's worth of failures before."""
    end_s = time.monotonic() + 60.0
    while True:
        try:
            return ask()
        except Failed:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.01)
