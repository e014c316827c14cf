"""`eqrt plot`: draw predictions, the worst of a dataset and a random sample of it.

One file per target, and a sheet of each kind (`worst.png`, `sample.png`) with the first of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from eqrt.core.errors import EqrtError
from eqrt.core.metrics import displacement, min_ade, min_fde
from eqrt.export.evaluation.command import add_shared_arguments, settings_of
from eqrt.export.evaluation.picture import Case, Outcome, cases, draw_one, draw_sheet
from eqrt.export.evaluation.predictors import Model, baselines, load_model
from eqrt.export.evaluation.selection import Selection, select
from eqrt.export.evaluation.tally import COMMON_MODES
from eqrt.training.dataset.windows import Windows

Float64 = NDArray[np.float64]
Rows = NDArray[np.intp]

DPI = 120
SHEET_DPI = 100


@dataclass(frozen=True, slots=True)
class Ranking:
    """Every evaluated target of a dataset and how far off its prediction ends."""

    rows: Rows
    """(W,) in the store."""
    fde: Float64
    """(W,) metres, of the best of the COMMON_MODES most probable modes."""

    def worst(self, count: int) -> Rows:
        """The rows with the largest errors, the worst first."""
        return self.rows[np.argsort(-self.fde, kind="stable")[:count]]

    def sample(self, count: int, seed: int) -> Rows:
        """Rows drawn at random, none twice, in the order of the store."""
        generator = np.random.default_rng(seed)
        drawn = generator.choice(len(self.rows), min(count, len(self.rows)), replace=False)
        return self.rows[np.sort(drawn)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt plot`."""
    add_shared_arguments(parser)
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        metavar="PATH",
        help="a prepared folder (`eqrt prepare`) or a raw dataset",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument(
        "--worst", type=_count, default=12, metavar="N", help="how many of the worst (default 12)"
    )
    parser.add_argument(
        "--sample", type=_count, default=12, metavar="N", help="how many at random (default 12)"
    )
    parser.add_argument("--seed", type=_count, default=0, help="of the sample (default 0)")
    parser.add_argument("--format", choices=("png", "svg"), default="png", help="default png")


def run(args: argparse.Namespace) -> int:
    """Rank, choose, draw."""
    settings = settings_of(args)
    model = load_model(args.model, settings.threads)
    selection = select(args.data, model.contract, settings.choice)
    ranking = rank(model, selection, settings.batch)
    if not len(ranking.rows):
        raise EqrtError(
            f"{args.data}: no chosen window (targets {selection.targets}, split {args.split}) has "
            "a whole history and future; nothing to draw"
        )
    chosen = {
        "worst": ranking.worst(args.worst),
        "sample": ranking.sample(args.sample, args.seed),
    }
    for kind, rows in chosen.items():
        if len(rows):
            shown = cases_of(model, selection, rows)
            write_pictures(args.out, kind, shown, _title(kind, args, model, ranking), args.format)
            print(f"{kind:<8}{len(rows)} of {len(ranking.rows):,} targets: {args.out / kind}-*")
    return 0


def rank(model: Model, selection: Selection, batch_size: int) -> Ranking:
    """The errors of all targets that can be evaluated."""
    rows, errors = [np.zeros(0, np.intp)], [np.zeros(0)]
    for batch in selection.batches(batch_size):
        if len(batch.windows):
            trajectories = model.predict(batch.windows).trajectories
            truth = batch.windows.future.astype(np.float64)
            errors.append(min_fde(displacement(trajectories[:, :COMMON_MODES], truth[:, None])))
            rows.append(batch.rows)
    return Ranking(np.concatenate(rows), np.concatenate(errors))


def cases_of(model: Model, selection: Selection, rows: Rows) -> list[Case]:
    """The targets `rows` of the store, ready to be drawn."""
    windows = selection.store.gather(rows)
    predicted = model.predict(windows)
    card = model.card
    velocity = baselines(card.dt_s, card.horizon_steps)["constant velocity"](windows)
    outcome = Outcome(
        modes=predicted.trajectories,
        probabilities=predicted.probabilities,
        velocity=velocity.trajectories[:, 0],
    )
    names = [
        f"{selection.store.recordings[recording][0]}, step {step}, agent {agent}"
        for recording, step, agent in zip(
            windows.recording.tolist(), windows.step.tolist(), windows.agent.tolist(), strict=True
        )
    ]
    return list(cases(windows, outcome, names, _errors(windows, outcome), card.dt_s))


def write_pictures(folder: Path, kind: str, shown: Sequence[Case], title: str, suffix: str) -> None:
    """`KIND-01.png` and so on, and the first of them on `KIND.png`.

    Raises EqrtError if that fails.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number, case in enumerate(shown, start=1):
            _save(draw_one(case), folder / f"{kind}-{number:02d}.{suffix}", DPI)
        _save(draw_sheet(shown, title), folder / f"{kind}.{suffix}", SHEET_DPI)
    except OSError as error:
        raise EqrtError(f"{folder}: cannot be written ({error.strerror})") from error


def _save(figure: Figure, path: Path, dpi: int) -> None:
    """Without a date or random names in it: the same picture is the same file."""
    nothing = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    with matplotlib.rc_context({"svg.hashsalt": path.name}):
        figure.savefig(path, dpi=dpi, metadata=nothing)


def _errors(windows: Windows, outcome: Outcome) -> list[str]:
    truth = windows.future.astype(np.float64)
    distance = displacement(outcome.modes, truth[:, None])  # (W, K, H)
    velocity = displacement(outcome.velocity, truth)[:, -1]
    likeliest = distance[:, :COMMON_MODES]
    modes = likeliest.shape[1]
    said = []
    for row, course in enumerate(distance[:, 0]):
        text = f"ADE {course.mean():.2f}, FDE {course[-1]:.2f} m"
        text += f"; const. velocity FDE {velocity[row]:.2f} m"
        if modes > 1:
            best = likeliest[row : row + 1]
            text += f"\nbest of {modes}: ADE {min_ade(best)[0]:.2f}, FDE {min_fde(best)[0]:.2f} m"
        said.append(text)
    return said


def _title(kind: str, args: argparse.Namespace, model: Model, ranking: Ranking) -> str:
    name = f"{model.card.name} {model.card.version}".rstrip()
    modes = min(COMMON_MODES, model.card.modes)
    error = "FDE" if modes == 1 else f"minFDE of {modes} modes"
    which = f"worst by {error}" if kind == "worst" else f"random sample, seed {args.seed}"
    return f"{name} on {args.data.name}: {which}, of {len(ranking.rows):,} targets"


def _count(text: str) -> int:
    number = int(text) if text.isdecimal() else -1
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 0 or more")
    return number
