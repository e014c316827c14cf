"""Running a model that may raise, or never come back, without going down with it.

The model runs in a thread of its own, so that the service can stop waiting for it: what is not
predicted in time falls back to physics, and the service goes on. A model that is stuck, or fails
again and again, is loaded anew.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import Protocol, TypeVar

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.core.scene import Scene
from eqrt.runtime.operation.realtime import stand_back
from eqrt.runtime.prediction.predictor import Prediction

STUCK_S = 2.0
"""A run that takes longer does not come back."""
MAX_ERRORS = 5
"""So many runs in a row that raise: this session is broken."""
_LONGEST_PAUSE_S = 60.0  # between two attempts to load the model anew: each takes some 0.2 s of CPU


class Model(Protocol):
    """What predicts: `Predictor`."""

    contract: ModelContract
    model_id: str

    def predict(self, scene: Scene) -> Prediction:
        """Predict all targets of the scene; may raise anything."""

    def again(self) -> Model:
        """The same model, loaded anew. Raises EqrtError."""


class Runner(Protocol):
    """Runs a model in some way."""

    @property
    def errors(self) -> int:
        """Runs that raised."""

    @property
    def overruns(self) -> int:
        """Runs that were given up."""

    @property
    def restarts(self) -> int:
        """Times that the model was loaded anew."""

    def run(self, scene: Scene, patience_s: float) -> Prediction:
        """Predict within `patience_s`. Raises Failed, or TooLate."""

    def succeeded_by(self, model: Model) -> Runner:
        """One for another model, which counts on; this one is not used any more."""


class Failed(Exception):  # noqa: N818  # an outcome, which the caller expects
    """The model said nothing."""


class TooLate(Failed):
    """It may say something yet, but this cycle's time is over."""


class Direct:
    """Runs a model and waits for it, however long it takes: where no time passes (replay)."""

    def __init__(self, model: Model) -> None:
        self.errors = 0
        """Runs that raised."""
        self.overruns = 0
        """Runs that were given up."""
        self.restarts = 0
        """Times that the model was loaded anew."""
        self._model = model

    def run(self, scene: Scene, patience_s: float) -> Prediction:  # noqa: ARG002
        """Predict. Raises Failed if the model raises."""
        try:
            return self._model.predict(scene)
        except Exception as error:  # onnxruntime raises its own classes, with no common base
            self.errors += 1
            raise Failed(str(error)) from error

    def succeeded_by(self, model: Model) -> Direct:
        """One for another model, which counts on."""
        return _counting_on(self, Direct(model))


class Watched:
    """Runs a model in a thread, and stops waiting when its time is over.

    By `clock` a model is stuck, or is due for another attempt to load it.
    """

    def __init__(self, model: Model, clock: Callable[[], float] = time.monotonic) -> None:
        self.errors = self.overruns = self.restarts = 0  # as of Direct
        self._model = model
        self._clock = clock
        self._worker = _Worker(model)
        self._errors_in_a_row = 0
        self._pause_s = STUCK_S
        self._next_restart_s = -math.inf
        self._successor: _Successor | None = None

    def run(self, scene: Scene, patience_s: float) -> Prediction:
        """Predict within `patience_s`.

        Raises TooLate if that is over before, or the model is still at work on an earlier scene;
        Failed if it raises, or has been at work for so long that it is stuck.
        """
        now_s = self._clock()
        self._replace_if_broken(now_s)
        if self._is_stuck(now_s):
            raise Failed(f"the model has been at work for more than {STUCK_S:g} s")
        if self._worker.busy_since_s() is not None:
            raise TooLate("the model is still at work on an earlier scene")
        answer = self._worker.ask(scene, patience_s, now_s)
        if answer is None:
            self.overruns += 1
            raise TooLate(f"no answer within {patience_s:.3f} s")
        if isinstance(answer, Exception):
            self.errors += 1
            self._errors_in_a_row += 1
            raise Failed(str(answer)) from answer
        self._errors_in_a_row, self._pause_s = 0, STUCK_S
        return answer

    def succeeded_by(self, model: Model) -> Watched:
        """One for another model, which counts on; this one and its thread come to an end."""
        self._worker.retire()
        return _counting_on(self, Watched(model, self._clock))

    def _replace_if_broken(self, now_s: float) -> None:
        """Have the model loaded anew, beside the loop; take it when it is there."""
        if self._successor is not None:
            if self._successor.is_loading():
                return
            if self._successor.model is not None:
                self._worker.retire()
                self._worker, self._errors_in_a_row = _Worker(self._successor.model), 0
                self.restarts += 1
            self._successor = None
        is_broken = self._is_stuck(now_s) or self._errors_in_a_row >= MAX_ERRORS
        if is_broken and now_s >= self._next_restart_s:
            self._next_restart_s = now_s + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
            self._successor = _Successor(self._model)

    def _is_stuck(self, now_s: float) -> bool:
        since_s = self._worker.busy_since_s()
        return since_s is not None and now_s - since_s > STUCK_S


Counting = TypeVar("Counting", Direct, Watched)


def _counting_on(before: Counting, after: Counting) -> Counting:
    after.errors, after.overruns, after.restarts = before.errors, before.overruns, before.restarts
    return after


class _Worker:
    """A thread with one model, which is asked one thing at a time.

    Two locks are its doorbells: nothing in the standard library wakes a thread faster.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._asked, self._answered = threading.Lock(), threading.Lock()
        self._asked.acquire()
        self._answered.acquire()
        self._scene: Scene | None  # to be worked on; None = no more
        self._answer: Prediction | Exception
        self._begun_s: float | None = None
        threading.Thread(target=self._work, name="model", daemon=True).start()

    def busy_since_s(self) -> float | None:
        """Since when it is at work on something that nobody waits for any more; None = idle."""
        if self._begun_s is not None and self._answered.acquire(blocking=False):
            self._begun_s = None
        return self._begun_s

    def ask(self, scene: Scene, patience_s: float, now_s: float) -> Prediction | Exception | None:
        """What the model says or raises; None = nothing yet."""
        self._scene, self._begun_s = scene, now_s
        self._asked.release()
        if not self._answered.acquire(timeout=max(patience_s, 0.0)):
            return None
        self._begun_s = None
        return self._answer

    def retire(self) -> None:
        """Nothing will be asked any more: the thread ends when it can, and lets go of the model."""
        self._scene = None
        self._asked.acquire(blocking=False)  # it may have been rung for, and not heard yet
        self._asked.release()

    def _work(self) -> None:
        while True:
            self._asked.acquire()
            scene = self._scene
            if scene is None:
                return
            try:
                self._answer = self._model.predict(scene)
            except Exception as error:
                self._answer = error
            self._answered.release()


class _Successor:
    """A model being loaded in a thread."""

    def __init__(self, model: Model) -> None:
        self.model: Model | None = None
        self._is_over = threading.Event()
        threading.Thread(target=self._load, args=[model], name="model loader", daemon=True).start()

    def _load(self, model: Model) -> None:
        stand_back()
        try:
            with contextlib.suppress(EqrtError, OSError):  # damaged: tried again after a pause
                loaded = model.again()
                if loaded.model_id == model.model_id:  # another one is for `Pipeline.exchange`
                    self.model = loaded
        finally:
            self._is_over.set()

    def is_loading(self) -> bool:
        return not self._is_over.is_set()
