"""A picture of one moment, as SVG: lanes, where everybody came from, predictions and the truth.

It is turned so that the traffic goes to the right: a road fills a wide picture, and seldom points
east. Colours are of the Okabe-Ito palette, which colour-blind readers can tell apart; lines differ
in width and dash as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from html import escape

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

WIDTH_PX = 1200
MARGIN_PX = 24
LEGEND_PX = 64
_LANE, _LANE_EDGE = "#c9c9c9", "#efefef"
_STYLES = {  # what -> colour, width in px, dash, label
    "history": ("#777777", 2.0, "", "history, 2 s"),
    "truth": ("#56b4e9", 8.0, "", "what happened, 3 s"),
    "constant velocity": ("#333333", 1.8, "2 4", "constant velocity, 3 s"),
    "predicted": ("#d55e00", 2.5, "", "eqrt's prediction, 3 s"),
}
_ENDS_PX = {"constant velocity": 2.5, "predicted": 4.0}
"""Radius of the dot at the end of a line: how far it is from the end of the truth is the error."""


@dataclass(slots=True)
class Moment:
    """What is drawn. Map frame, metres; every line is (n, 2)."""

    title: str
    lanes: list[Float64] = field(default_factory=list)
    lines: dict[str, list[Float64]] = field(default_factory=lambda: {name: [] for name in _STYLES})
    """By the names of `_STYLES`, drawn in that order."""
    agents: list[Float64] = field(default_factory=list)
    """(2,) positions now."""
    ego: Float64 | None = None
    """(2,)"""
    is_north_known: bool = True
    """False = y is not north, but whatever it was where the dead reckoning began."""

    def drawn(self) -> list[Float64]:
        """Everything but the lanes, each (n, 2) or (2,)."""
        lines = [line for lines in self.lines.values() for line in lines]
        return [*self.agents, *lines, *([] if self.ego is None else [self.ego])]


def render(moment: Moment) -> str:
    """The SVG text. Raises ValueError if there is nothing to draw."""
    if not moment.agents and not any(moment.lines.values()):
        raise ValueError("nothing to draw: no agent and no line")
    view = _View.around(moment)
    body = [_lane(view, lane) for lane in moment.lanes]
    for name, (color, width, dash, _) in _STYLES.items():
        lines = moment.lines.get(name, [])
        body += [_polyline(view, line, color, width, dash) for line in lines]
        if name in _ENDS_PX:
            body += [_dot(view, line[-1], color, _ENDS_PX[name]) for line in lines]
    body += [_dot(view, position, "#333333", 4.0) for position in moment.agents]
    if moment.ego is not None:
        body.append(_dot(view, moment.ego, "#009e73", 7.0))
    return "\n".join([_head(view), *body, *_legend(view, moment), "</svg>"]) + "\n"


@dataclass(frozen=True, slots=True)
class _View:
    """Metres to pixels: turned, then y up."""

    right: Float64
    """(2,) unit vector in the map that points to the right of the picture."""
    left_m: float
    top_m: float
    """Of the picture's corner, turned."""
    px_per_m: float
    height_px: float

    @classmethod
    def around(cls, moment: Moment) -> _View:
        points = np.concatenate([np.atleast_2d(line) for line in moment.drawn()])
        right = _way_of_the_traffic(moment.lines.get("truth", []), points)
        turned = points @ _turn(right)
        low, high = turned.min(axis=0), turned.max(axis=0)
        size = np.maximum(high - low, 20.0)
        size[1] = max(size[1], 0.14 * size[0])  # a straight road still gets a readable strip
        scale = (WIDTH_PX - 2 * MARGIN_PX) / size.max()
        center = (low + high) / 2
        height = size[1] * scale + 2 * MARGIN_PX + LEGEND_PX
        left = center[0] - WIDTH_PX / 2 / scale
        top = center[1] + (size[1] / 2 + (MARGIN_PX + LEGEND_PX) / scale)
        return cls(right, float(left), float(top), float(scale), float(height))

    def pixels(self, points: Float64) -> Float64:
        turned = points @ _turn(self.right)
        return self.px_per_m * np.stack(
            [turned[..., 0] - self.left_m, self.top_m - turned[..., 1]], axis=-1
        )


def _way_of_the_traffic(truth: list[Float64], points: Float64) -> Float64:
    """(2,) unit vector along the longer side of what is drawn, as most of the traffic goes."""
    offsets = points - points.mean(axis=0)
    along: Float64 = np.linalg.svd(offsets, full_matrices=False)[2][0]
    if np.abs(offsets @ along).max() < 10.0:
        return np.array([1.0, 0.0])  # all at one place
    moved = sum((line[-1] - line[0] for line in truth), start=np.zeros(2))
    backwards = moved @ along < 0.0 or (moved @ along == 0.0 and along[0] < 0.0)
    return -along if backwards else along


def _turn(right: Float64) -> Float64:
    """(2, 2) that row vectors are multiplied with."""
    return np.array([[right[0], -right[1]], [right[1], right[0]]])


def _head(view: _View) -> str:
    size = f'width="{WIDTH_PX}" height="{view.height_px:.0f}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} '
        f'viewBox="0 0 {WIDTH_PX} {view.height_px:.0f}" font-family="sans-serif">\n'
        f'<rect width="100%" height="100%" fill="#ffffff"/>'
    )


def _lane(view: _View, lane: Float64) -> str:
    wide = _polyline(view, lane, _LANE_EDGE, 3.2 * view.px_per_m, "")
    return wide + _polyline(view, lane, _LANE, 1.0, "")


def _polyline(view: _View, line: Float64, color: str, width: float, dash: str) -> str:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in view.pixels(line))
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="{width:.1f}" '
        f'stroke-linejoin="round"{dashes}/>'
    )


def _dot(view: _View, position: Float64, color: str, radius: float) -> str:
    x, y = view.pixels(position)
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{color}"/>'


def _legend(view: _View, moment: Moment) -> list[str]:
    """Title, key and scale bar on a strip above the picture."""
    parts = [
        f'<rect width="100%" height="{LEGEND_PX}" fill="#ffffff"/>',
        f'<text x="{MARGIN_PX}" y="24" font-size="17">{escape(moment.title)}</text>',
    ]
    x = float(MARGIN_PX)
    for name, (color, width, dash, label) in _STYLES.items():
        if not moment.lines.get(name):
            continue
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        parts.append(
            f'<line x1="{x:.0f}" y1="46" x2="{x + 34:.0f}" y2="46" stroke="{color}" '
            f'stroke-width="{width}"{dashes}/>'
            f'<text x="{x + 42:.0f}" y="51" font-size="14">{label}</text>'
        )
        x += 62 + 7.4 * len(label)
    if moment.ego is not None:
        parts.append(
            f'<circle cx="{x + 8:.0f}" cy="46" r="7" fill="#009e73"/>'
            f'<text x="{x + 22:.0f}" y="51" font-size="14">ego</text>'
        )
    north = _north(view) if moment.is_north_known else []
    return [*parts, *north, *_scale_bar(view)]


def _north(view: _View) -> list[str]:
    """An arrow, above the scale bar's left end."""
    x, y = WIDTH_PX - MARGIN_PX - 20.0 * view.px_per_m - 44.0, 38.0
    east, north = float(view.right[1]), float(view.right[0])  # of north, turned
    tip, tail = (x + 14 * east, y - 14 * north), (x - 14 * east, y + 14 * north)
    side = (5 * north, 5 * east)
    corners = " ".join(
        f"{a:.1f},{b:.1f}" for a, b in (tip, (x - side[0], y - side[1]), (x + side[0], y + side[1]))
    )
    return [
        f'<line x1="{tail[0]:.1f}" y1="{tail[1]:.1f}" x2="{x:.1f}" y2="{y:.1f}" stroke="#333333"/>',
        f'<polygon points="{corners}" fill="#333333"/>',
        f'<text x="{x - 28:.1f}" y="{y + 5:.1f}" font-size="14">N</text>',
    ]


def _scale_bar(view: _View) -> list[str]:
    end = WIDTH_PX - MARGIN_PX
    start = end - 20.0 * view.px_per_m
    return [
        f'<path d="M{start:.1f},40 v8 H{end:.1f} v-8" fill="none" stroke="#333333"/>',
        f'<text x="{(start + end) / 2:.1f}" y="36" font-size="14" text-anchor="middle">20 m</text>',
    ]
