"""What a training leaves behind: metrics, pictures, checkpoints, and words for who watches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from eqrt.training.checkpoint import Card, save_checkpoint
from eqrt.training.configuration import TrainConfig
from eqrt.training.evaluate import evaluate, evaluate_constant_velocity
from eqrt.training.loader import LoaderTimes
from eqrt.training.meter import LossMeter, Stopwatch
from eqrt.training.plots import plot_metrics
from eqrt.training.progress import Display, MetricsLog
from eqrt.training.ranks import Ranks
from eqrt.training.start import Start, credited
from eqrt.training.state import TrainingState, save_state
from eqrt.training.training_data import TrainingData

MODEL_FILE = "model.safetensors"
STATE_FILE = "state.safetensors"
METRICS_FILE = "metrics.jsonl"


@dataclass(frozen=True, slots=True)
class Goal:
    """What is trained, on what, from what, and where it goes."""

    config: TrainConfig
    data: TrainingData
    out: Path
    command: str
    """As typed, for the model card."""
    start: Start | None = None
    """None = random weights."""

    def fingerprint(self) -> dict[str, int]:
        """Tells trainings of one configuration apart by what went in."""
        start = {} if self.start is None else self.start.fingerprint()
        return self.data.pool.fingerprint() | start


class Recorder:
    """Follows one training into one folder. Every rank has one; the first alone writes."""

    def __init__(self, goal: Goal, state: TrainingState, *, ranks: Ranks, display: Display) -> None:
        self._goal = goal
        self._state = state
        self._ranks = ranks
        self._display = display
        self._meter = LossMeter(ranks)
        self._watch = Stopwatch()
        self._seen = state.step
        if ranks.leads:
            self._fingerprint = goal.fingerprint()
            self._log = MetricsLog(goal.out / METRICS_FILE, after=state.step)
            scene, held_out = goal.config.model.scene, goal.data.held_out
            self._baseline = evaluate_constant_velocity(held_out, scene.num_modes, scene.dt_s)
            display.line(f"constant velocity   {row(self._baseline)}")

    def add(self, loss: Tensor, grad_norm: Tensor) -> None:
        """Of the step just done: the loss, and the length of its gradient."""
        self._meter.add(loss, grad_norm)

    def report(self) -> None:
        """Where the training is. Raises EqrtError if the loss is no longer a number."""
        self._meter.settle(self._state)
        if self._ranks.leads:
            self._log.write(self._course(self._lap()))

    def evaluate(self) -> None:
        """Measure the averaged network, and write everything there is. Raises as `report`."""
        self._meter.settle(self._state)
        if not self._ranks.leads:
            return
        config, out, state = self._goal.config, self._goal.out, self._state
        speed = self._lap()
        metrics = evaluate(state.average, self._goal.data.held_out, config.model.scene.dt_s)
        self._log.write(self._course(speed) | metrics)
        save_checkpoint(out / MODEL_FILE, state.average, config.model, self._card(metrics))
        self.save_state()  # before it is said: whoever listens may have gone
        self._display.line(f"step {state.step:>6} loss {state.loss:.3f} {row(metrics)}")
        self._watch.resume()

    def save_state(self) -> None:
        """Write all that is needed to go on from here. Raises as `report`."""
        self._meter.settle(self._state)
        if self._ranks.leads:
            goal = self._goal
            save_state(goal.out / STATE_FILE, self._state, goal.config, self._fingerprint)

    def plot(self) -> None:
        """Draw the metrics so far."""
        if self._ranks.leads:
            plot_metrics(self._goal.out / METRICS_FILE, self._goal.out, self._baseline)

    def summarize(self, loaded: LoaderTimes, threads: int) -> None:
        """Say how fast the data came, and how fast it was used."""
        if not (self._watch.seconds and loaded.busy_s):
            return
        self._display.line(
            f"speed               loader {threads * loaded.samples / loaded.busy_s:.0f} samples/s, "
            f"training {self._watch.samples / self._watch.seconds:.0f} samples/s, "
            f"{loaded.waited_s / self._watch.seconds:.1%} of the time waiting for data"
        )

    def close(self) -> None:
        """Nothing more comes."""
        if self._ranks.leads:
            self._log.close()

    def _lap(self) -> float:
        """Samples/s of all ranks since the last time."""
        state = self._state
        speed = self._watch.lap((state.step - self._seen) * self._goal.config.train.batch_size)
        self._seen = state.step
        self._display.advance(state.step, state.loss, speed)
        return speed

    def _course(self, samples_per_s: float) -> dict[str, float]:
        state = self._state
        assert state.loss is not None  # settled after at least one step
        return {
            "step": state.step,
            "loss": state.loss,
            "learning_rate": float(state.optimizer.param_groups[0]["lr"]),
            "samples_per_s": round(samples_per_s, 1),
        }

    def _card(self, metrics: dict[str, float]) -> Card:
        config, data = self._goal.config, self._goal.data
        source = credited(data.source, self._goal.start)
        before = () if self._goal.start is None else self._goal.start.trained_on
        return Card(
            name=config.name,
            data=source.credits,
            license=source.license,
            non_commercial=source.non_commercial,
            metrics=metrics,
            baseline=self._baseline,
            command=self._goal.command,
            config_sha256=config.sha256,
            parameters=sum(weight.numel() for weight in self._state.network.parameters()),
            steps=self._state.step,
            seed=config.train.seed,
            recordings=data.recordings,
            samples=self._state.step * config.train.batch_size,
            trained_on=tuple(sorted({*data.trained_on, *before})),
        )


def row(metrics: Mapping[str, float]) -> str:
    """Names and values in one line."""
    return " ".join(f"{name} {value:.3f}" for name, value in metrics.items())
