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
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.watched import (
    MAX_ERRORS,
    STUCK_S,
    Direct,
    Failed,
    Model,
    TooLate,
    Watched,
)

PATIENCE_S = 10.0
"""However busy the machine is, what is waited for comes sooner."""
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
        self.loads = 0
        """Times that it was loaded anew."""

    def predict(self, scene: Scene) -> Prediction:
        self.runs += 1
        self._family[0](self.runs - 1)
        return shipped_predictor().predict(scene)

    def again(self) -> Scripted:
        self.loads += 1
        return Scripted(*self._family[self.loads :])


def well(_run: int) -> None:
    """Nothing happens."""


def broken(_run: int) -> None:
    raise RuntimeError("no memory\nand a stack trace")


class Clock:
    """Stands still until it is set."""

    def __init__(self) -> None:
        self.now_s = 500.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


class Hang:
    """Does not come back before it is told to, or the test is over."""

    def __init__(self) -> None:
        self.over = threading.Event()

    def __call__(self, _run: int) -> None:
        self.over.wait(PATIENCE_S)


@pytest.fixture
def hang() -> Iterator[Hang]:
    waiting = Hang()
    yield waiting
    waiting.over.set()


@pytest.fixture
def started() -> Callable[[str], list[threading.Thread]]:
    """The threads of this name that this test has started and that are alive."""
    before = threading.enumerate()

    def found(name: str) -> list[threading.Thread]:
        return [t for t in threading.enumerate() if t not in before and t.name == name]

    return found


def fail(model: Direct | Watched, times: int = 1) -> None:
    for _ in range(times):
        with pytest.raises(Failed, match="no memory"):
            model.run(scene(), PATIENCE_S)


def loaded() -> None:
    """Wait until no model is being loaded."""
    for thread in threading.enumerate():
        if thread.name == "model loader":
            thread.join(PATIENCE_S)


# --- one run


@pytest.mark.parametrize("runner", [Direct, Watched])
def test_a_model_that_works_says_the_same_however_it_is_run(
    runner: type[Direct] | type[Watched],
) -> None:
    model = runner(shipped_predictor())
    for targets in (1, 40, 1):
        said = model.run(scene(targets), PATIENCE_S)
        expected = shipped_predictor().predict(scene(targets))
        np.testing.assert_array_equal(said.trajectories, expected.trajectories)
        np.testing.assert_array_equal(said.probabilities, expected.probabilities)
    assert (model.errors, model.overruns, model.restarts) == (0, 0, 0)


@pytest.mark.parametrize("runner", [Direct, Watched])
def test_an_error_in_the_model_is_an_outcome(runner: type[Direct] | type[Watched]) -> None:
    def twice(run: int) -> None:
        if run < 2:
            raise RuntimeError("no memory")

    model = runner(Scripted(twice))
    for _ in range(2):
        with pytest.raises(Failed, match=r"^no memory$") as caught:
            model.run(scene(), PATIENCE_S)
        assert not isinstance(caught.value, TooLate)
    model.run(scene(), PATIENCE_S)
    assert (model.errors, model.overruns, model.restarts) == (2, 0, 0)


def test_a_model_that_does_not_answer_in_time_is_not_waited_for() -> None:
    """What it says later is nobody's answer; then it is asked again."""
    answered = threading.Event()

    def every_second_is_slow(run: int) -> None:
        if run % 2 == 0:
            answered.wait(PATIENCE_S)
            answered.clear()

    script = Scripted(every_second_is_slow)
    model = Watched(script)
    for overruns in (1, 2):
        begun_s = time.monotonic()
        with pytest.raises(TooLate, match=r"^no answer within 0\.050 s$"):
            model.run(scene(1), 0.05)
        assert 0.05 <= time.monotonic() - begun_s < 5.0
        with pytest.raises(TooLate, match=r"^the model is still at work on an earlier scene$"):
            model.run(scene(2), PATIENCE_S)
        answered.set()
        said = _eventually(lambda: model.run(scene(3), PATIENCE_S))
        assert len(said.trajectories) == 3
        assert (model.overruns, model.errors, model.restarts) == (overruns, 0, 0)
    assert script.runs == 4


def test_when_there_is_no_time_left_nothing_is_waited_for(hang: Hang) -> None:
    model = Watched(Scripted(hang))
    begun_s = time.monotonic()
    with pytest.raises(TooLate):
        model.run(scene(), -0.01)
    assert time.monotonic() - begun_s < 0.9


# --- a model that is broken


def test_a_model_that_is_stuck_is_loaded_anew(hang: Hang, clock: Clock) -> None:
    family = Scripted(hang, well)
    model = Watched(family, clock)
    with pytest.raises(TooLate):
        model.run(scene(), 0.01)
    clock.now_s += STUCK_S
    with pytest.raises(TooLate, match="still at work"):  # not stuck yet
        model.run(scene(), PATIENCE_S)
    loaded()
    assert family.loads == 0
    clock.now_s += 0.001
    with pytest.raises(Failed, match=r"^the model has been at work for more than 2 s$") as caught:
        model.run(scene(), PATIENCE_S)  # while another is loaded
    assert not isinstance(caught.value, TooLate)
    loaded()
    assert len(model.run(scene(2), PATIENCE_S).trajectories) == 2
    assert (family.loads, model.overruns, model.restarts) == (1, 1, 1)


def test_it_is_not_stuck_that_began_just_now(hang: Hang, clock: Clock) -> None:
    """However long ago the run before was."""
    family = Scripted(lambda run: hang(run) if run else well(run), well)
    model = Watched(family, clock)
    model.run(scene(), PATIENCE_S)
    clock.now_s += 10.0 * STUCK_S
    with pytest.raises(TooLate):
        model.run(scene(), 0.01)
    with pytest.raises(TooLate):
        model.run(scene(), PATIENCE_S)
    loaded()
    assert family.loads == 0


def test_a_model_that_keeps_failing_is_loaded_anew(clock: Clock) -> None:
    """Again and again, if the next one is no better; it may raise from its first run on."""
    family = Scripted(broken, broken, well)
    model = Watched(family, clock)
    for generation in (1, 2):
        fail(model, MAX_ERRORS)
        loaded()
        assert family.loads == generation - 1
        fail(model)
        loaded()
        assert family.loads == generation
        clock.now_s += STUCK_S
        if generation == 1:
            assert model.restarts == 0
    model.run(scene(), PATIENCE_S)
    assert (model.errors, model.restarts) == (2 * (MAX_ERRORS + 1), 2)


def test_errors_that_are_not_in_a_row_leave_it_alone(clock: Clock) -> None:
    def sometimes(run: int) -> None:
        if run % MAX_ERRORS:
            raise RuntimeError("no memory")

    family = Scripted(sometimes, well)
    model = Watched(family, clock)
    for _ in range(4):
        model.run(scene(), PATIENCE_S)
        fail(model, MAX_ERRORS - 1)
    loaded()
    assert (family.loads, model.restarts) == (0, 0)


@pytest.mark.parametrize("error", [ContractError("model.onnx: damaged"), OSError("no such disk")])
def test_a_model_that_cannot_be_loaded_is_tried_again_after_pauses_that_grow(
    error: Exception, clock: Clock
) -> None:
    """To a minute; after a good run they begin anew. Meanwhile it is asked as before."""
    tries: list[float] = []

    class Damaged(Scripted):
        def again(self) -> Scripted:
            tries.append(clock.now_s)
            raise error

    model = Watched(Damaged(lambda run: well(run) if run == 400 else broken(run)), clock)
    while model.errors < 400:
        fail(model)
        loaded()
        clock.now_s += 0.5
    assert np.diff(tries).tolist() == [2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    tries.clear()
    model.run(scene(), PATIENCE_S)
    while model.errors < 530:
        fail(model)
        loaded()
        clock.now_s += 0.5
    assert np.diff(tries).tolist() == [2.0, 4.0, 8.0]
    assert model.restarts == 0


def test_a_model_that_takes_long_to_load_is_waited_for(hang: Hang, clock: Clock) -> None:
    """However many cycles come meanwhile; it is not given up for another attempt."""
    loading = Hang()

    class SlowToLoad(Scripted):
        def again(self) -> Scripted:
            successor = super().again()
            loading(0)
            return successor

    family = SlowToLoad(hang, well)
    model = Watched(family, clock)
    with pytest.raises(TooLate):
        model.run(scene(), 0.01)
    for _ in range(3):
        clock.now_s += 10.0 * STUCK_S
        with pytest.raises(Failed):
            model.run(scene(), PATIENCE_S)
    loading.over.set()
    loaded()
    assert len(model.run(scene(2), PATIENCE_S).trajectories) == 2
    assert (family.loads, model.restarts) == (1, 1)


def test_another_model_in_the_same_folder_is_not_taken_for_this_one(clock: Clock) -> None:
    """Files that were replaced wait for a reload, which looks at the contract."""

    class Replaced(Scripted):
        def again(self) -> Scripted:
            other = super().again()
            other.model_id = "other"
            return other

    family = Replaced(broken, well)
    model = Watched(family, clock)
    fail(model, MAX_ERRORS + 1)
    loaded()
    fail(model)
    assert (family.loads, model.restarts) == (1, 0)


# --- its threads


def test_a_thread_that_is_stuck_does_not_keep_the_program_from_ending(
    hang: Hang, clock: Clock, started: Callable[[str], list[threading.Thread]]
) -> None:
    loading = Hang()

    class SlowToLoad(Scripted):
        def again(self) -> Scripted:
            loading(0)
            return super().again()

    model = Watched(SlowToLoad(hang, well), clock)
    with pytest.raises(TooLate):
        model.run(scene(), 0.01)
    clock.now_s += 2.0 * STUCK_S
    for _ in range(2):
        with pytest.raises(Failed):
            model.run(scene(), PATIENCE_S)
    threads = [*started("model"), *started("model loader")]
    assert [thread.daemon for thread in threads] == [True, True]
    loading.over.set()


def test_a_model_that_was_replaced_is_let_go(
    clock: Clock, started: Callable[[str], list[threading.Thread]]
) -> None:
    """Else a model that fails for hours would fill the memory with its predecessors."""
    model = Watched(Scripted(broken, broken, broken, well), clock)
    for _ in range(3):
        fail(model, MAX_ERRORS + 1)
        loaded()
        clock.now_s += 100.0
    model.run(scene(), PATIENCE_S)
    assert model.restarts == 3
    _wait_until(lambda: len(started("model")) == 1)


def test_a_model_that_was_stuck_is_let_go_when_it_comes_back(
    hang: Hang, clock: Clock, started: Callable[[str], list[threading.Thread]]
) -> None:
    model = Watched(Scripted(hang, well), clock)
    with pytest.raises(TooLate):
        model.run(scene(), 0.01)
    clock.now_s += 2.0 * STUCK_S
    with pytest.raises(Failed):
        model.run(scene(), PATIENCE_S)
    loaded()
    model.run(scene(), PATIENCE_S)
    assert len(started("model")) == 2
    hang.over.set()
    _wait_until(lambda: len(started("model")) == 1)


def test_a_successor_counts_on_and_the_model_before_it_is_let_go(
    clock: Clock, hang: Hang, started: Callable[[str], list[threading.Thread]]
) -> None:
    first: Model = Scripted(lambda run: (well, well, broken, broken, hang)[run](run))
    before = Watched(first, clock)
    for _ in range(2):
        before.run(scene(), PATIENCE_S)
    fail(before, 2)
    with pytest.raises(TooLate):
        before.run(scene(), 0.01)
    before.restarts = 3
    family = Scripted(broken, broken, well)
    after = before.succeeded_by(family)
    assert (after.errors, after.overruns, after.restarts) == (2, 1, 3)
    hang.over.set()
    _wait_until(lambda: len(started("model")) == 1)
    for _ in range(2):
        fail(after, MAX_ERRORS + 1)
        loaded()
        clock.now_s += STUCK_S  # another attempt is due, by this clock
    assert after.run(scene(), PATIENCE_S)
    assert (after.errors, after.restarts, family.loads) == (2 + 2 * (MAX_ERRORS + 1), 5, 2)


def test_a_successor_where_no_time_passes_counts_on() -> None:
    before = Direct(Scripted(broken))
    fail(before, 2)
    after = before.succeeded_by(Scripted(lambda run: broken(run) if run == 0 else well(run)))
    fail(after)
    after.run(scene(), PATIENCE_S)
    assert (after.errors, after.overruns, after.restarts) == (3, 0, 0)


def _eventually(ask: Callable[[], Prediction]) -> Prediction:
    """The first answer; failures before it for a while."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return ask()
        except Failed:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.01)


def _wait_until(holds: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.01)
