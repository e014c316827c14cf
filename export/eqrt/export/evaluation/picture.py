"""A prediction as a picture: the target's frame, heading up, metres.

Colours are of the Okabe-Ito palette, which colour-blind readers can tell apart; what matters also
differs in width or dash, the thinner on top. Dots on a line stand a second apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from eqrt.export.evaluation.manoeuvres import heading_now
from eqrt.training.dataset.windows import Windows

Float64 = NDArray[np.float64]

LANE, NEIGHBOUR, HISTORY = "#c4c4c4", "#009e73", "#000000"
TRUTH, PREDICTED, VELOCITY = "#0072b2", "#d55e00", "#cc79a7"
MIN_VIEW_M = 30.0
"""A standing target still gets its surroundings."""
MAX_REACH_M = 200.0
"""What is farther from the target than a car can be in 3 s leaves the picture."""
SHEET_COLUMNS = 4
SHEET_CASES = 60
"""No more on a sheet: a picture of 600 would have more pixels than its format can count."""
_MARGIN = 0.08  # of the view, around what is shown


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """What one picture shows, all in the target's frame: x to the right, y ahead, metres."""

    name: str
    """Recording, step and agent."""
    errors: str
    """In one line."""
    lanes: list[Float64]
    """(n, 2) each."""
    neighbours: list[Float64]
    """Histories (n, 2), as far as seen."""
    history: Float64
    """(T, 2) of the target."""
    truth: Float64
    """(H, 2)"""
    modes: Float64
    """(K, H, 2) most probable first."""
    probabilities: Float64
    """(K,)"""
    velocity: Float64
    """(H, 2) constant velocity."""
    steps_per_s: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What was predicted for W windows, tile frame."""

    modes: Float64
    """(W, K, H, 2)"""
    probabilities: Float64
    """(W, K)"""
    velocity: Float64
    """(W, H, 2)"""


def cases(
    windows: Windows, outcome: Outcome, names: Sequence[str], errors: Sequence[str], dt_s: float
) -> Iterator[Case]:
    """One case per window, turned into its target's frame."""
    headings = heading_now(windows)
    for row, (heading, name, said) in enumerate(zip(headings, names, errors, strict=True)):
        frame = _Frame(windows.history[row, 0, -1].astype(np.float64), heading)
        seen = windows.history_valid[row, 1:]
        lines, exists = windows.centerlines[row], windows.centerlines_valid[row]
        yield Case(
            name=name,
            errors=said,
            lanes=[frame.of(line[ok]) for line, ok in zip(lines, exists, strict=True)],
            neighbours=[
                frame.of(track[ok])
                for track, ok in zip(windows.history[row, 1:], seen, strict=True)
                if ok.any()
            ],
            history=frame.of(windows.history[row, 0]),
            truth=frame.of(windows.future[row]),
            modes=frame.of(outcome.modes[row]),
            probabilities=outcome.probabilities[row],
            velocity=frame.of(outcome.velocity[row]),
            steps_per_s=max(round(1.0 / dt_s), 1),
        )


def draw_one(case: Case) -> Figure:
    """A picture of its own, 7 inches square, with axes and a key."""
    figure = Figure(figsize=(7.0, 7.8), layout="constrained")
    axes = figure.add_subplot()
    _draw(axes, case)
    axes.set_xlabel("metres to the right")
    axes.set_ylabel("metres ahead")
    axes.set_title(f"{case.name}\n{case.errors}", fontsize=10, parse_math=False)
    _add_key(figure, columns=4, modes=len(case.modes))
    return figure


def draw_sheet(shown: Sequence[Case], title: str) -> Figure:
    """Many small pictures on one sheet, each at a scale of its own: the first SHEET_CASES."""
    shown = shown[:SHEET_CASES]
    columns = min(SHEET_COLUMNS, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure = Figure(figsize=(4.0 * columns, 4.3 * rows + 1.0), layout="constrained")
    figure.suptitle(title, fontsize=14, parse_math=False)
    for index, case in enumerate(shown):
        axes = figure.add_subplot(rows, columns, index + 1)
        _draw(axes, case)
        axes.set_title(f"{case.name}\n{case.errors}", fontsize=8, parse_math=False)
        axes.tick_params(labelsize=7)
    _add_key(figure, columns=min(7, 2 * columns), modes=len(shown[0].modes))
    return figure


class _Frame:
    """The tile frame seen by a target at `position` (2,) that heads along `heading` (2,)."""

    def __init__(self, position: Float64, heading: Float64) -> None:
        ahead = heading if heading.any() else np.array([0.0, 1.0])
        self._position = position
        self._axes = np.array([[ahead[1], ahead[0]], [-ahead[0], ahead[1]]])  # right, ahead

    def of(self, points: NDArray[np.floating]) -> Float64:
        """Points (..., 2)."""
        return np.asarray((points.astype(np.float64) - self._position) @ self._axes)


def _draw(axes: Axes, case: Case) -> None:
    for lane in case.lanes:
        axes.plot(*lane.T, color=LANE, linewidth=1.2, zorder=1)
    for track in case.neighbours:
        axes.plot(*track.T, color=NEIGHBOUR, linewidth=1.4, zorder=2)
        axes.plot(*track[-1], color=NEIGHBOUR, marker="o", markersize=4, zorder=2)
    axes.plot(*case.history.T, color=HISTORY, linewidth=2.2, zorder=3)
    axes.plot(0.0, 0.0, color=HISTORY, marker="^", markersize=9, zorder=3)
    _draw_course(axes, case.truth, case.steps_per_s, color=TRUTH, linewidth=4.0, zorder=4)
    for mode, probability in reversed(list(zip(case.modes, case.probabilities, strict=True))):
        share = float(probability / case.probabilities.max())
        look = {"linewidth": 0.8 + 1.2 * share, "alpha": 0.35 + 0.65 * share}
        _draw_course(axes, mode, case.steps_per_s, color=PREDICTED, zorder=5, **look)
    axes.plot(*_from_now(case.velocity).T, color=VELOCITY, linewidth=1.2, dashes=(4, 2), zorder=6)
    _set_view(axes, case)


def _draw_course(
    axes: Axes, course: Float64, steps_per_s: int, *, linewidth: float, **look: Any
) -> None:
    """A future (H, 2) from where the target is now, with a dot every second."""
    axes.plot(
        *_from_now(course).T,
        linewidth=linewidth,
        marker="o",
        markersize=2.0 + 1.3 * linewidth,
        markeredgewidth=0.0,
        markevery=(steps_per_s, steps_per_s),
        **look,
    )


def _from_now(course: Float64) -> Float64:
    """A course (H, 2) with where the target is now in front."""
    return np.concatenate([np.zeros((1, 2)), course])


def _set_view(axes: Axes, case: Case) -> None:
    """A square around the target's past and every future of it, as far as MAX_REACH_M."""
    points = np.concatenate([case.history, case.truth, case.modes.reshape(-1, 2), case.velocity])
    points = points[np.linalg.norm(points, axis=1) <= MAX_REACH_M]
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(float((high - low).max()) * (0.5 + _MARGIN), MIN_VIEW_M / 2)
    center = (low + high) / 2
    axes.set_xlim(center[0] - half, center[0] + half)
    axes.set_ylim(center[1] - half, center[1] + half)
    axes.set_aspect("equal")
    axes.grid(visible=True, color="#eeeeee", linewidth=0.6)
    axes.set_axisbelow(True)


def _add_key(figure: Figure, columns: int, *, modes: int) -> None:
    dot = {"marker": "o", "markeredgewidth": 0.0}
    key = [
        _sample("target, its history", HISTORY, 2.2, marker="^"),
        _sample("truth", TRUTH, 4.0, markersize=7, **dot),
        _sample("predicted", PREDICTED, 2.0, markersize=4.5, **dot),
        _sample("less probable", PREDICTED, 1.0, alpha=0.5, markersize=3, **dot),
        _sample("constant velocity", VELOCITY, 1.2, dashes=(4, 2)),
        _sample("others", NEIGHBOUR, 1.4, markersize=4, **dot),
        _sample("lanes", LANE, 1.2),
    ]
    if modes == 1:
        del key[3]
    figure.legend(handles=key, loc="outside lower center", ncols=columns, fontsize=9, frameon=False)


def _sample(label: str, color: str, linewidth: float, **look: Any) -> Line2D:
    return Line2D([], [], label=label, color=color, linewidth=linewidth, **look)
