"""Measuring: one dataset, batch by batch, a model and its baselines on the same targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import EqrtError
from eqrt.export.evaluation.manoeuvres import heading_at_end, manoeuvres, speed_bands
from eqrt.export.evaluation.predictors import Forecast, Model, ModelCard, baselines, load_model
from eqrt.export.evaluation.selection import Choice, Selection, select, turned
from eqrt.export.evaluation.tally import Tally, end_errors, errors_of, membership
from eqrt.runtime.prediction.guard import guard
from eqrt.training.dataset.windows import Windows
from eqrt.training.evaluate import Predicted
from eqrt.training.recordings.recording import Source

Float64 = NDArray[np.float64]

MODEL = "model"
"""What the evaluated model is called among the predictors of a tally."""
PUBLISHED = "published"
"""The model behind the service's guard, which replaces what no vehicle can do."""
REFUSED = "refused"
"""The error that counts what the guard replaced: 1 for such a target, else 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How it is measured."""

    choice: Choice
    rotate_deg: float = 0.0
    """The world is turned by so much, counter-clockwise, about each tile frame's zero."""
    batch: int = 256
    """Windows in memory at a time."""
    threads: int = 1
    """CPU threads of the model."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """One dataset to measure a model on. Plain data: it crosses processes."""

    model: Path
    """As the user typed it."""
    data: Path
    """Likewise."""
    base: Path
    """The folder that relative paths start from, absolute: workers may stand elsewhere."""
    settings: Settings

    @property
    def name(self) -> str:
        """How errors call it."""
        return str(self.data)


@dataclass(frozen=True, slots=True, kw_only=True)
class DataCard:
    """Which data was evaluated on."""

    path: str
    recordings: int
    """Of the chosen split."""
    targets: str
    """Which windows were chosen: `focal`, `complete` or `all`."""
    evaluated: int
    left_out: int
    """Chosen, but with gaps in history or future."""
    trained_on: int
    """Of the recordings; by the names of their groups, as far as the model tells."""
    source: Source


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What came out. Plain data: it crosses processes."""

    model: ModelCard
    data: DataCard
    tally: Tally


def measure_piece(piece: Piece) -> Measured:
    """Load, measure; the function that runs on a worker. Raises EqrtError."""
    model = load_model(piece.base / piece.model, piece.settings.threads)
    model = replace(model, card=replace(model.card, path=str(piece.model)))
    selection = select(piece.base / piece.data, model.contract, piece.settings.choice)
    return measure(model, selection, piece)


def measure(model: Model, selection: Selection, piece: Piece) -> Measured:
    """The errors of a model and of the baselines on the windows of a selection.

    Raises EqrtError if none of them is complete, or the model predicts what is not a number.
    """
    settings = piece.settings
    card = model.card
    others = baselines(card.dt_s, card.horizon_steps)
    tally, left_out = Tally(), 0
    for batch in selection.batches(settings.batch):
        left_out += batch.left_out
        if len(batch.windows):
            members = membership(
                speed_bands(batch.windows, card.dt_s), manoeuvres(batch.windows)
            )  # of the windows as recorded, so that turning them moves none to another row
            windows = turned(batch.windows, settings.rotate_deg)
            tally.add(members, _errors(model, others, windows))
    evaluated = int(tally.counts[0])
    if not evaluated:
        raise EqrtError(
            f"{piece.data}: none of {left_out} chosen windows (targets {selection.targets}, split "
            f"{settings.choice.split}) has a whole history and future; nothing to evaluate"
        )
    data = DataCard(
        path=str(piece.data),
        recordings=selection.recordings,
        targets=selection.targets,
        evaluated=evaluated,
        left_out=left_out,
        trained_on=selection.seen_by(model.trained_on),
        source=selection.store.source,
    )
    return Measured(model=card, data=data, tally=tally)


def _errors(
    model: Model, others: Mapping[str, Forecast], windows: Windows
) -> dict[str, dict[str, Float64]]:
    """Predictor -> error -> (W,): of the model, of what the car would publish, of the others."""
    card, truth = model.card, windows.future.astype(np.float64)
    predicted = model.predict(windows)
    modes, probabilities = predicted.trajectories, predicted.probabilities
    parts = [modes, probabilities, predicted.end_covariances]
    if not all(np.isfinite(part).all() for part in parts if part is not None):
        raise EqrtError(f"{card.path}: predicts what is not a number; it cannot be evaluated")
    history, valid = windows.history[:, 0].astype(np.float64), windows.history_valid[:, 0]
    guarded = guard(modes, probabilities, history, valid, card.dt_s)
    published = Predicted(guarded.trajectories, guarded.probabilities)
    errors = {
        MODEL: errors_of(predicted, truth, card.dt_s),
        PUBLISHED: errors_of(published, truth, card.dt_s)
        | {REFUSED: (~guarded.accepted).astype(np.float64)},
    }
    for name, predict in others.items():
        errors[name] = errors_of(predict(windows), truth, card.dt_s)
    direction = heading_at_end(windows)
    errors[MODEL] |= end_errors(predicted, truth, direction)
    return errors
