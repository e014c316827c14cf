"""`eqrt compare`: trainings side by side, as a table and as a curve of errors over data.

Everything comes from the cards in the checkpoints, so whoever has the runs gets the same table.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eqrt.core.errors import EqrtError, UsageError
from eqrt.training.checkpoint import Card, load_checkpoint
from eqrt.training.plots import FORMATS, end_errors, save_figure, spoken
from eqrt.training.recorder import MODEL_FILE

_SIZE_INCHES = (9.0, 4.0)
_CONSTANT_VELOCITY = "constant velocity"


@dataclass(frozen=True, slots=True)
class Run:
    """A finished or running training."""

    name: str
    """Of its folder."""
    card: Card


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt compare`."""
    parser.epilog = "example: eqrt compare runs/paper-* ; docs/training.md"
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="folder that `eqrt train` wrote to"
    )
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="draw errors over the number of recordings trained on, one line per configuration; "
        + " or ".join(f".{kind}" for kind in FORMATS),
    )


def run(args: argparse.Namespace) -> int:
    """Print the table, draw the curve."""
    if args.plot and args.plot.suffix.removeprefix(".") not in FORMATS:
        raise UsageError(f"--plot {args.plot}: expected a name that ends in .png or .svg")
    runs = [Run(path.name, load_checkpoint(path / MODEL_FILE).card) for path in args.runs]
    print("\n".join(table(runs)))
    if args.plot:
        save_figure(curve(runs), args.plot)
    return 0


def table(runs: Sequence[Run]) -> list[str]:
    """Lines of a Markdown table: a row per run, and constant velocity for each held-out set."""
    names = list(dict.fromkeys(name for each in runs for name in each.card.metrics))
    heads = ["run", "parameters", "recordings", "samples", *map(spoken, names)]
    rows = [heads, ["---"] * len(heads)]
    for each in runs:
        card = each.card
        size = [f"{card.parameters:,}", f"{card.recordings:,}", f"{card.samples:,}"]
        rows.append([each.name, *size, *_values(card.metrics, names)])
    for baseline in _baselines(runs):
        rows.append([_CONSTANT_VELOCITY, "", "", "", *_values(baseline, names)])
    return [f"| {' | '.join(row)} |" for row in rows]


def curve(runs: Sequence[Run]) -> Figure:
    """Errors over recordings trained on; trainings of one configuration make one line.

    Raises EqrtError if the runs were measured on different targets, as constant velocity shows, or
    do not say on how much they were trained.
    """
    first = runs[0]
    for each in runs:
        if each.card.baseline != first.card.baseline:
            raise EqrtError(
                f"{each.name} and {first.name} were measured on different targets (constant "
                "velocity has other errors), so one curve cannot show both"
            )
        if not each.card.recordings:
            raise EqrtError(
                f"{each.name}: its checkpoint does not say on how many recordings it was trained; "
                "train it again with this version of eqrt"
            )
    figure = Figure(_SIZE_INCHES, layout="constrained")
    drawn = end_errors(first.card.baseline)
    for axes, metric in zip(figure.subplots(1, len(drawn)), drawn, strict=True):
        _draw(axes, runs, metric)
    figure.axes[0].legend(fontsize="small")
    return figure


def _draw(axes: Axes, runs: Sequence[Run], metric: str) -> None:
    for name in dict.fromkeys(each.card.name for each in runs):
        points = sorted(
            (each.card.recordings, each.card.metrics[metric])
            for each in runs
            if each.card.name == name
        )
        axes.plot(*zip(*points, strict=True), marker="o", label=name)
    level = runs[0].card.baseline[metric]
    axes.axhline(level, color="0.5", linestyle="--", label=_CONSTANT_VELOCITY)
    axes.set_xscale("log")
    ticks = sorted({each.card.recordings for each in runs})
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("recordings trained on")
    axes.set_ylabel(f"{spoken(metric)}, metres, held-out targets")
    axes.grid(visible=True, linewidth=0.3)


def _baselines(runs: Sequence[Run]) -> list[dict[str, float]]:
    """What constant velocity scores, once for each set of targets.

    Cards of one set agree in all metrics that both have; a model of several modes has more of them.
    """
    found: list[dict[str, float]] = []
    for card in (each.card for each in runs):
        same = (b for b in found if all(card.baseline.get(k, v) == v for k, v in b.items()))
        if (known := next(same, None)) is not None:
            known |= card.baseline
        else:
            found.append(dict(card.baseline))
    return found


def _values(metrics: dict[str, float], names: Sequence[str]) -> list[str]:
    return [f"{metrics[name]:.3f}" if name in metrics else "" for name in names]
