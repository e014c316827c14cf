"""Panels of dots and lines as one SVG file that needs nothing else and follows a dark theme.

Colours are of the Okabe-Ito palette, which colour-blind readers can tell apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.drawing.axes import Axis, shown

Float64 = NDArray[np.float64]

_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 16, 56, 46
_TITLE = 34
_LEAST_SHARE = 1e-6  # of the values themselves: an axis shorter than that has no numbers on it
_STYLE = """
svg { color-scheme: light dark; --paper: #ffffff; --ink: #1c1f24; --faint: #5d6570;
  --line: #d6dae0; --blue: #0072b2; --orange: #d55e00; --green: #00805c; --grey: #8a929c; }
@media (prefers-color-scheme: dark) { svg { --paper: #14171b; --ink: #e8eaed; --faint: #a3abb6;
  --line: #3a414b; --blue: #56b4e9; --orange: #f0a35e; --green: #4fc79f; --grey: #848d98; } }
text { font: 12px system-ui, sans-serif; fill: var(--ink); } .faint { fill: var(--faint); }
.title { font-size: 16px; } .grid { stroke: var(--line); } .zero { stroke: var(--faint); }
.dots { fill: none; stroke-linecap: round; stroke-opacity: 0.7; }
.lines { fill: none; stroke-width: 1.3; stroke-linejoin: round; }
.dashed { stroke-dasharray: 6 4; }
.blue { stroke: var(--blue); } .orange { stroke: var(--orange); }
.green { stroke: var(--green); } .grey { stroke: var(--grey); } .ink { stroke: var(--ink); }
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Marks:
    """Points of one colour, (n, 2) each; drawn as dots or joined."""

    lines: Sequence[Float64]
    color: str
    label: str = ""
    joined: bool = False
    dashed: bool = False
    size: int = 3
    """Of a dot, pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """One pair of axes."""

    title: str
    x_label: str
    y_label: str
    marks: Sequence[Marks]
    width: int = 420
    height: int = 380
    equal: bool = False
    """Whether a metre is as long on both axes."""
    x_reversed: bool = False
    """Larger values to the left, as y of a sensor that is looked at from above."""
    flat: float = 1.0
    """The least length of the y axis: noise on a constant is not to look like a signal."""


def figure(title: str, rows: Sequence[Sequence[Panel]]) -> str:
    """The SVG text: rows of panels."""
    width = max(sum(panel.width for panel in row) for row in rows)
    height = _TITLE + sum(max(panel.height for panel in row) for row in rows)
    parts = [f'<text class="title" x="16" y="26">{escape(title)}</text>']
    top = _TITLE
    for row in rows:
        left = 0
        for panel in row:
            drawn = "".join(_panel(panel, f"clip{len(parts)}"))
            parts.append(f'<g transform="translate({left},{top})">{drawn}</g>')
            left += panel.width
        top += max(panel.height for panel in row)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title)}">\n'
        f"<style>{_STYLE}</style>\n"
        f'<rect width="100%" height="100%" style="fill: var(--paper)"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _panel(panel: Panel, clip: str) -> Iterator[str]:
    points = [line for marks in panel.marks for line in marks.lines if len(line)]
    yield _text(_LEFT, 18, panel.title)
    if not points:
        yield _text(_LEFT, 60, "nothing to draw", style="faint")
        return
    x, y = _axes(panel, np.concatenate(points))
    yield from _grid(panel, x, y)
    yield (
        f'<clipPath id="{clip}"><rect x="{_LEFT}" y="{_TOP}" '
        f'width="{panel.width - _LEFT - _RIGHT}" height="{panel.height - _TOP - _BOTTOM}"/>'
        f'</clipPath><g clip-path="url(#{clip})">'
    )
    for marks in panel.marks:
        yield _marks(marks, x, y)
    yield "</g>"
    yield from _legend(panel)


def _axes(panel: Panel, points: Float64) -> tuple[Axis, Axis]:
    """Axes that hold nearly all points: a few wild ones are cut off, not given the whole paper."""
    finite = points[np.isfinite(points).all(axis=1)]
    low, high = np.quantile(finite, 0.002, axis=0), np.quantile(finite, 0.998, axis=0)
    middle = (low + high) / 2.0
    room = np.maximum(high - low, [1e-3, panel.flat])
    room = np.maximum(room, _LEAST_SHARE * np.abs(middle))
    low, high = middle - 0.54 * room, middle + 0.54 * room
    x = Axis(float(low[0]), float(high[0]), _LEFT, panel.width - _RIGHT)
    y = Axis(float(low[1]), float(high[1]), panel.height - _BOTTOM, _TOP)
    if panel.equal:
        x, y = _equal(x, y)
    return (replace(x, start=x.end, end=x.start) if panel.x_reversed else x), y


def _equal(x: Axis, y: Axis) -> tuple[Axis, Axis]:
    """The same length for a metre on both: the one with room to spare shows more."""
    metres_per_px = max(abs((a.high - a.low) / (a.end - a.start)) for a in (x, y))
    wider = []
    for axis in (x, y):
        middle, half = (axis.low + axis.high) / 2.0, metres_per_px * abs(axis.end - axis.start) / 2
        wider.append(replace(axis, low=middle - half, high=middle + half))
    return wider[0], wider[1]


def _grid(panel: Panel, x: Axis, y: Axis) -> Iterator[str]:
    right, bottom = panel.width - _RIGHT, panel.height - _BOTTOM
    for tick in y.ticks():
        at, style = y.at(tick), "zero" if abs(tick) < 1e-9 else "grid"
        yield f'<line class="{style}" x1="{_LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>'
        yield _text(_LEFT - 6, at + 4, shown(tick), "end", "faint")
    for tick in x.ticks():
        at, style = x.at(tick), "zero" if abs(tick) < 1e-9 else "grid"
        yield f'<line class="{style}" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP}" y2="{bottom}"/>'
        yield _text(at, bottom + 16, shown(tick), "middle", "faint")
    yield _text((_LEFT + right) / 2, bottom + 36, panel.x_label, "middle")
    yield (
        f'<text transform="translate(14,{(_TOP + bottom) / 2:.0f}) rotate(-90)" '
        f'text-anchor="middle">{escape(panel.y_label)}</text>'
    )


def _marks(marks: Marks, x: Axis, y: Axis) -> str:
    joined = "lines" if marks.joined else "dots"
    style = f"{joined} {marks.color}{' dashed' if marks.dashed else ''}"
    path = "".join(_path(line, x, y, joined=marks.joined) for line in marks.lines)
    width = "" if marks.joined else f' style="stroke-width: {marks.size}"'
    return f'<path class="{style}"{width} d="{path}"/>' if path else ""


def _path(line: Float64, x: Axis, y: Axis, *, joined: bool) -> str:
    px = _pixels(line[:, 0], x)
    py = _pixels(line[:, 1], y)
    known = np.isfinite(px + py)
    places = [f"{a:.1f},{b:.1f}" for a, b in zip(px[known], py[known], strict=True)]
    if joined:
        return "M" + "L".join(places) if len(places) > 1 else ""
    return "".join(f"M{place}h0" for place in places)


def _pixels(values: Float64, axis: Axis) -> Float64:
    """As `Axis.at`, but beyond the axis too: the clip takes care of that."""
    share = (values - axis.low) / (axis.high - axis.low)
    return axis.start + np.clip(share, -2.0, 3.0) * (axis.end - axis.start)


def _legend(panel: Panel) -> Iterator[str]:
    left = float(_LEFT)
    for marks in panel.marks:
        if not marks.label or not any(len(line) for line in marks.lines):
            continue
        style = f"{'lines' if marks.joined else 'dots'} {marks.color}"
        style += " dashed" if marks.dashed else ""
        sample = f"M{left:.0f},36h18" if marks.joined else f"M{left + 9:.0f},36h0"
        width = "" if marks.joined else ' style="stroke-width: 8"'
        yield f'<path class="{style}"{width} d="{sample}"/>'
        yield _text(left + 24, 40, marks.label, style="faint")
        left += 40 + 6.6 * len(marks.label)


def _text(x: float, y: float, text: str, anchor: str = "start", style: str = "") -> str:
    kind = f' class="{style}"' if style else ""
    return f'<text{kind} x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
