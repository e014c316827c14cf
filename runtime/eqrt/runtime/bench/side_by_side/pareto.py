"""Error over latency as an SVG file of its own: which models are beaten by none in both?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.report import counted
from eqrt.runtime.bench.side_by_side.report import SideBySide, middle_ns
from eqrt.runtime.drawing.axes import Axis, log_ticks, round_ticks, shown
from eqrt.runtime.drawing.names import Box, place_names

_WIDTH, _HEIGHT = 640, 420
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 24, 36, 48
_ROOM = 1.25  # beyond the fastest and the slowest, where names find room
_STYLE = """
svg { color-scheme: light dark; --paper: #ffffff; --ink: #1c1f24; --faint: #5d6570;
  --line: #d6dae0; --dot: #0072b2; --front: #b34700; }
@media (prefers-color-scheme: dark) { svg { --paper: #14171b; --ink: #e8eaed; --faint: #a3abb6;
  --line: #3a414b; --dot: #56b4e9; --front: #f0a35e; } }
text { font: 12px system-ui, sans-serif; fill: var(--ink); } .faint { fill: var(--faint); }
.paper { fill: var(--paper); } .grid { stroke: var(--line); } .model { fill: var(--dot); }
.leader { stroke: var(--faint); stroke-width: 0.8; }
.physics { fill: var(--paper); stroke: var(--dot); stroke-width: 2; }
.front { fill: none; stroke: var(--front); stroke-width: 1.5; stroke-dasharray: 4 3; }
"""


@dataclass(frozen=True, slots=True)
class Point:
    """One predictor."""

    name: str
    latency_ms: float
    error_m: float
    is_model: bool


def points_of(report: SideBySide) -> list[Point]:
    """Of all whose errors are known: median latency of the last case, ADE.

    Raises EqrtError if that is none of the models.
    """
    workloads, count = report.cases[-1].workloads, len(report.models)
    known = [model.accuracy for model in report.models]
    if not any(known):
        raise EqrtError(
            "--plot: no model's errors are known, neither from its card nor from --accuracy; "
            "give reports of eqrt eval --json"
        )
    known += [report.physics.get(workload.name) for workload in workloads[count:]]
    return [
        Point(workload.name, middle_ns(workload) / 1e6, accuracy.ade_m, place < count)
        for place, (workload, accuracy) in enumerate(zip(workloads, known, strict=True))
        if accuracy is not None
    ]


def front(points: Sequence[Point]) -> list[Point]:
    """Those that no other one beats in latency without losing in error, fastest first."""
    best: list[Point] = []
    for point in sorted(points, key=lambda one: (one.latency_ms, one.error_m)):
        if not best or point.error_m < best[-1].error_m:
            best.append(point)
    return best


def draw(report: SideBySide) -> str:
    """The text of the file."""
    return picture(points_of(report), counted(report.cases[-1].targets))


def picture(points: Sequence[Point], of_what: str) -> str:
    """The same for at least one point; `of_what` is what their times are of, as in `1 target`."""
    latencies, errors = [p.latency_ms for p in points], [p.error_m for p in points]
    x = Axis(min(latencies) / _ROOM, max(latencies) * _ROOM, _LEFT, _WIDTH - _RIGHT, log=True)
    y = _errors_axis(min(errors), max(errors))
    title = f"mean displacement over the time of {of_what}"
    best = _corners(x, y, front(points))
    parts = [*_grid(x, y), _polyline(best), *_dots(x, y, points, best)]
    below = _HEIGHT - 10
    parts.append(_text(_WIDTH - _RIGHT, below, f"ms, {of_what}, p50", "end", "faint"))
    parts.append(_text(8, 14, "ADE, m", "start", "faint"))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(title)}">\n<style>{_STYLE}</style>\n'
        f'<rect class="paper" width="{_WIDTH}" height="{_HEIGHT}"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _errors_axis(low: float, high: float) -> Axis:
    """With a quarter more below and above; not below 0."""
    room = max((high - low) / 4, 0.05 * high, 0.01)
    return Axis(max(0.0, low - room), high + room, _HEIGHT - _BOTTOM, _TOP)


def _grid(x: Axis, y: Axis) -> Iterator[str]:
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    for tick in round_ticks(y.low, y.high):
        yield _line((_LEFT, y.at(tick)), (right, y.at(tick)))
        yield _text(_LEFT - 6, y.at(tick) + 4, shown(tick), "end", "faint")
    for tick in log_ticks(x.low, x.high):
        yield _line((x.at(tick), _TOP), (x.at(tick), bottom))
        yield _text(x.at(tick), bottom + 18, shown(tick), "middle", "faint")


def _line(start: tuple[float, float], end: tuple[float, float], style: str = "grid") -> str:
    (x1, y1), (x2, y2) = start, end
    return f'<line class="{style}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _corners(x: Axis, y: Axis, best: Sequence[Point]) -> list[tuple[float, float]]:
    """From each of the front straight on to the time of the next, then down to its error."""
    corners = [(x.at(best[0].latency_ms), y.at(best[0].error_m))]
    for point in best[1:]:
        at = x.at(point.latency_ms)
        corners += [(at, corners[-1][1]), (at, y.at(point.error_m))]
    return [*corners, (x.end, corners[-1][1])]


def _polyline(corners: Sequence[tuple[float, float]]) -> str:
    return f'<polyline class="front" points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in corners)}"/>'


def _dots(
    x: Axis, y: Axis, points: Sequence[Point], best: Sequence[tuple[float, float]]
) -> Iterator[str]:
    """Each with its name, which a thin line leads to if it does not stand right beside it."""
    dots = [(x.at(point.latency_ms), y.at(point.error_m)) for point in points]
    inside = Box(_LEFT + 2, _TOP, _WIDTH - 2, _HEIGHT - _BOTTOM - 2)
    lines = [
        Box(a, b - 1, c + 1, d + 1) for (a, b), (c, d) in pairwise(best)
    ]  # to the right, or down
    places = place_names(dots, [point.name for point in points], inside, lines)
    for (across, down), place in zip(dots, places, strict=True):
        if place.leader is not None:
            yield _line((across, down), place.leader, "leader")
    for point, (across, down), place in zip(points, dots, places, strict=True):
        kind = "model" if point.is_model else "physics"
        yield f'<circle class="{kind}" cx="{across:.1f}" cy="{down:.1f}" r="5"/>'
        side = "start" if place.box.left > across else "end"
        edge = place.box.left if side == "start" else place.box.right
        yield _text(edge, place.box.bottom - 3, point.name, side, "ink")


def _text(x: float, y: float, text: str, anchor: str, style: str) -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{style}" {place}>{escape(text)}</text>'
