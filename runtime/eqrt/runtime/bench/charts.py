"""Small charts as SVG text: a histogram, a course over time, bars of stages.

Colours are CSS variables of the page around them, so that they follow its light or dark theme.
Everything is drawn in a box 400 wide, which keeps its letters readable on a phone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape

from eqrt.runtime.bench.report import Course, Histogram, WorkloadResult
from eqrt.runtime.drawing.axes import Axis, shown

WIDTH, HEIGHT = 400, 200
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 8, 32, 30
_BAR = 22


def histogram_chart(histogram: Histogram, marks: dict[str, int]) -> str:
    """How often which latency (milliseconds, logarithmic) came; a line at each percentile.

    Heights are logarithmic: otherwise the rare slow ones, which matter most, could not be seen.
    """
    edges = [edge / 1e6 for edge in histogram.edges_ns]
    x = _axis_x(edges[0], edges[-1])
    y = Axis(0.7, max(2.0, *histogram.counts), HEIGHT - _BOTTOM, _TOP, log=True)
    parts = [*_grid(x, y, "ms", "samples")]
    for left, right, count in zip(edges, edges[1:], histogram.counts, strict=False):
        if count:
            width = max(x.at(right) - x.at(left) - 0.5, 0.5)
            parts.append(_box(x.at(left), y.at(count), width, y.start - y.at(count), "bar"))
    return _svg([*parts, *_marks(x, marks)], "histogram of latencies")


def course_chart(course: Course) -> str:
    """Median and slowest of each stretch, over the time of the run."""
    median = [value / 1e6 for value in course.median_ns]
    slowest = [value / 1e6 for value in course.max_ns]
    x = Axis(0.0, max(course.start_s[-1], 1e-3), _LEFT, WIDTH - _RIGHT)
    low, high = _apart(min(median), max(slowest))
    y = Axis(low, high, HEIGHT - _BOTTOM, _TOP, log=True)
    parts = [
        *_grid(x, y, "s", "ms"),
        _line(x, y, course.start_s, slowest, "slowest"),
        _line(x, y, course.start_s, median, "median"),
        _text(WIDTH - _RIGHT, 11, "slowest", "end", "slowest-text"),
        _text(WIDTH - _RIGHT - 56, 11, "median", "end", "median-text"),
    ]
    return _svg(parts, "latency over time")


def stages_chart(workload: WorkloadResult) -> str:
    """A bar for each stage, as long as its mean: means add up, percentiles do not."""
    stages = {name: part.mean_ns / 1e6 for name, part in workload.stages.items()}
    longest = max(*stages.values(), 1e-6)
    parts = []
    for row, (name, mean) in enumerate(stages.items()):
        top = 4 + row * (_BAR + 8)
        width = max(1.0, (WIDTH - 190) * mean / longest)
        parts.append(_text(96, top + 16, name, "end"))
        parts.append(_box(104, top, width, _BAR, "bar"))
        parts.append(_text(110 + width, top + 16, f"{mean:.3f} ms", "start"))
    return _svg(parts, "mean time of each stage", height=4 + len(stages) * (_BAR + 8))


def _axis_x(low: float, high: float) -> Axis:
    low, high = _apart(low, high)
    return Axis(low, high, _LEFT, WIDTH - _RIGHT, log=True)


def _apart(low: float, high: float) -> tuple[float, float]:
    """A range above 0 that has a width."""
    low = max(low, 1e-6)
    return low, max(high, 1.05 * low)


def _grid(x: Axis, y: Axis, x_unit: str, y_unit: str) -> Iterator[str]:
    for tick in y.ticks():
        at = y.at(tick)
        yield f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
        yield _text(_LEFT - 5, at + 4, shown(tick), "end")
    for tick in x.ticks():
        at = x.at(tick)
        anchor = "middle" if at < WIDTH - _RIGHT - 12 else "end"  # else it would be cut off
        yield _text(at, HEIGHT - _BOTTOM + 14, shown(tick), anchor)
    yield _text(WIDTH - _RIGHT, HEIGHT - 3, x_unit, "end", "unit")
    yield _text(4, 11, y_unit, "start", "unit")


def _marks(x: Axis, marks: dict[str, int]) -> Iterator[str]:
    """Lines with names; a name that would cover the one before it goes without."""
    covered = 0.0
    for name, value_ns in marks.items():
        at = x.at(value_ns / 1e6)
        yield (
            f'<line class="mark" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP}" y2="{HEIGHT - _BOTTOM}"/>'
        )
        if at - 16 >= covered:
            yield _text(min(at, WIDTH - 18), _TOP - 5, name, "middle", "mark-text")
            covered = at + 16


def _line(x: Axis, y: Axis, xs: Sequence[float], ys: Sequence[float], style: str) -> str:
    points = " ".join(f"{x.at(a):.1f},{y.at(b):.1f}" for a, b in zip(xs, ys, strict=True))
    return f'<polyline class="{style}" points="{points}"/>'


def _box(x: float, y: float, width: float, height: float, style: str) -> str:
    return (
        f'<rect class="{style}" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"/>'
    )


def _text(x: float, y: float, text: str, anchor: str, style: str = "label") -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{style}" {place}>{escape(text)}</text>'


def _svg(parts: Sequence[str], title: str, height: int = HEIGHT) -> str:
    return (
        f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(title)}">'
        f"{''.join(parts)}</svg>"
    )
