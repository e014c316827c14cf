"""The course of a training as pictures: `loss.png`, `loss.svg`, `errors.png`, `errors.svg`."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from eqrt.core.files import write_whole
from eqrt.training.files import writing
from eqrt.training.progress import Numbers, read_lines

FORMATS = ("png", "svg")
_BEST = ("min_ade", "min_fde")
_SIZE_INCHES = (7.0, 4.0)
_SPREAD = 20.0  # above this ratio of largest to smallest a logarithmic axis shows more


def plot_metrics(log: Path, folder: Path, baseline: Numbers) -> list[Path]:
    """Draw what `log` holds into `folder`; what there is nothing of yet is not drawn.

    `baseline` is what constant velocity scores, dashed. Returns the files written.
    """
    lines = read_lines(log)
    written = []
    if lines:
        written += _save(_figure(lines, ["loss"], {}, "loss"), folder / "loss")
    if evaluated := [line for line in lines if end_errors(line)]:
        names = [*end_errors(evaluated[0]), *(name for name in _BEST if name in evaluated[0])]
        figure = _figure(evaluated, names, baseline, "metres, held-out targets")
        written += _save(figure, folder / "errors")
    return written


def _figure(
    lines: Sequence[Numbers], names: Sequence[str], baseline: Numbers, label: str
) -> Figure:
    figure = Figure(_SIZE_INCHES, layout="constrained")
    axes = figure.add_subplot()
    steps = [line["step"] for line in lines]
    for name in names:
        values = [line[name] for line in lines]
        marker = "o" if len(values) < 50 else ""
        (drawn,) = axes.plot(steps, values, label=spoken(name), marker=marker, markersize=3)
        if name in baseline:
            axes.axhline(
                baseline[name],
                color=drawn.get_color(),
                linestyle="--",
                linewidth=0.8,
                label=f"{spoken(name)}, constant velocity",
            )
    everything = [line[name] for line in lines for name in names]
    if 0.0 < min(everything) < max(everything) / _SPREAD:
        axes.set_yscale("log")
    axes.set_xlabel("step")
    axes.set_ylabel(label)
    axes.grid(visible=True, linewidth=0.3)
    if len(names) > 1 or baseline:
        axes.legend(fontsize="small")
    return figure


def end_errors(table: Mapping[str, float]) -> list[str]:
    """ADE and FDE at the longest time of a table of errors: `ade_3s`, `fde_3s`; none in others."""
    times = [float(found[1]) for name in table if (found := re.fullmatch(r"ade_([\d.]+)s", name))]
    return [f"{kind}_{max(times):g}s" for kind in ("ade", "fde")] if times else []


def spoken(name: str) -> str:
    """A metric's name for people: `min_ade_3s` -> `min ADE 3 s`."""
    words = name.replace("_", " ").replace("ade", "ADE").replace("fde", "FDE")
    return words.removesuffix("s") + " s" if words[-2:-1].isdigit() and words[-1] == "s" else words


def save_figure(figure: Figure, path: Path) -> None:
    """Write a file of one of FORMATS; the same figure gives the same SVG, byte for byte.

    Raises EqrtError if the disk does not take it.
    """
    options = {"dpi": 120} if path.suffix == ".png" else {"metadata": {"Date": None}}
    drawn = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "eqrt"}):
        figure.savefig(drawn, format=path.suffix.removeprefix("."), **options)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, drawn.getvalue())


def _save(figure: Figure, path: Path) -> list[Path]:
    written = [path.with_suffix(f".{kind}") for kind in FORMATS]
    for file in written:
        save_figure(figure, file)
    return written
