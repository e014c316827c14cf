"""What became of the model's runs, kept so that a replay does not depend on how fast it is.

A service gives up a run that takes too long, and asks nothing more of a model that is stuck. How
long a run takes is nobody's to repeat; that it was given up is.
"""

from __future__ import annotations

from enum import IntEnum

from eqrt.core.scene import Scene
from eqrt.runtime.prediction.predictor import Prediction
from eqrt.runtime.prediction.watched import Direct, Failed, Model, Runner, TooLate
from eqrt.runtime.recording.steps import ReplayedClock


class Outcome(IntEnum):
    """Of one run."""

    ANSWERED = 0
    FAILED = 1
    """The model raised an error, or was stuck."""
    GIVEN_UP = 2
    """Its time was over, or the model still at work on an earlier scene."""


class RunTape:
    """Keeps the outcomes of a step."""

    def __init__(self) -> None:
        self._outcomes: list[Outcome] = []

    def note(self, outcome: Outcome) -> None:
        """One more run."""
        self._outcomes.append(outcome)

    def take(self) -> list[Outcome]:
        """Since this was last asked for, in order; empty if all were answered."""
        outcomes, self._outcomes = self._outcomes, []
        return outcomes if any(outcomes) else []


class TapedRunner:
    """Runs a model as another runner does, and keeps what became of it."""

    def __init__(self, runner: Runner, tape: RunTape) -> None:
        self._runner = runner
        self._tape = tape

    @property
    def errors(self) -> int:
        """Runs that raised."""
        return self._runner.errors

    @property
    def overruns(self) -> int:
        """Runs that were given up."""
        return self._runner.overruns

    @property
    def restarts(self) -> int:
        """Times that the model was loaded anew."""
        return self._runner.restarts

    def run(self, scene: Scene, patience_s: float) -> Prediction:
        """As the other one: raises Failed, or TooLate."""
        try:
            said = self._runner.run(scene, patience_s)
        except TooLate:
            self._tape.note(Outcome.GIVEN_UP)
            raise
        except Failed:
            self._tape.note(Outcome.FAILED)
            raise
        self._tape.note(Outcome.ANSWERED)
        return said

    def succeeded_by(self, model: Model) -> TapedRunner:
        """One for another model, on the same tape."""
        return TapedRunner(self._runner.succeeded_by(model), self._tape)


class ReplayedRunner:
    """Waits for a model however long it takes, but not where a recorded run said nothing."""

    def __init__(self, model: Model, clock: ReplayedClock) -> None:
        """`clock` knows the present step."""
        self.errors = self.overruns = self.restarts = 0  # as of Direct
        self._direct = Direct(model)
        self._clock = clock

    def run(self, scene: Scene, patience_s: float) -> Prediction:
        """Predict. Raises TooLate or Failed if the recorded run did, Failed if the model raises."""
        outcome = self._clock.outcome()
        if outcome == Outcome.GIVEN_UP:
            self.overruns += 1
            raise TooLate("the recorded run was given up")
        if outcome == Outcome.FAILED:
            self.errors += 1
            raise Failed("the recorded run said nothing")
        return self._direct.run(scene, patience_s)

    def succeeded_by(self, model: Model) -> ReplayedRunner:
        """One for another model, which counts on."""
        after = ReplayedRunner(model, self._clock)
        after.errors, after.overruns = self.errors, self.overruns
        return after
