"""Names beside the dots of a chart, none on top of another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import hypot

LETTER, LINE = 6.6, 14
"""Pixels: the width of an average letter, and the height of a line, of text of 12 pixels."""
_DOT = 7  # pixels around a dot's middle that belong to it
_STEPS = 12  # lines up and down, and as many steps aside, that are tried
_BESIDE = 9  # pixels from the middle of a dot to its name
_NEAR = 11  # pixels up to which a name is seen to belong to its dot


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle, pixels; y points down."""

    left: float
    top: float
    right: float
    bottom: float

    def meets(self, other: Box) -> bool:
        """Whether they overlap."""
        return (
            self.left < other.right
            and other.left < self.right
            and self.top < other.bottom
            and other.top < self.bottom
        )

    def holds(self, other: Box) -> bool:
        """Whether the other lies inside."""
        return (
            self.left <= other.left
            and other.right <= self.right
            and self.top <= other.top
            and other.bottom <= self.bottom
        )

    def nearest(self, x: float, y: float) -> tuple[float, float]:
        """Its point that is nearest to another one."""
        return min(max(x, self.left), self.right), min(max(y, self.top), self.bottom)


@dataclass(frozen=True, slots=True)
class Named:
    """Where a name stands."""

    box: Box
    leader: tuple[float, float] | None
    """Where a line from the dot to it ends; None where the name stands right beside its dot."""


def place_names(
    dots: Sequence[tuple[float, float]],
    names: Sequence[str],
    inside: Box,
    obstacles: Sequence[Box] = (),
) -> list[Named]:
    """A place for each, as near to its dot as there is room; right beside it if there is none.

    Names cover neither each other nor dots, leaders or `obstacles`. Those in a crowd choose first.
    """
    taken = [*obstacles, *(_around(x, y) for x, y in dots)]
    found: dict[int, Named] = {}
    for index in sorted(range(len(dots)), key=lambda i: (-_neighbours(dots, i), dots[i])):
        x, y = dots[index]
        named = [one.box for one in found.values()]
        candidates = sorted(_candidates(x, y, names[index]), key=lambda box: _away(box, x, y))
        free = (
            box
            for box in candidates
            if inside.holds(box)
            and not any(box.meets(other) for other in taken)
            and not any(part.meets(other) for part in _leader(box, x, y) for other in named)
        )
        box = next(free, candidates[0])
        far = _away(box, x, y) > _NEAR
        found[index] = Named(box, box.nearest(x, y) if far else None)
        taken += [box, *(_leader(box, x, y) if far else ())]
    return [found[index] for index in range(len(dots))]


def _candidates(x: float, y: float, name: str) -> Iterator[Box]:
    """To the right, to the left, and in the middle, at every height."""
    width = LETTER * len(name)
    for across, down in product(range(_STEPS), range(-2 * _STEPS, 2 * _STEPS + 1)):
        top = y - LINE / 2 + down * LINE / 2
        for left in (
            x + _BESIDE + across * LINE,
            x - _BESIDE - across * LINE - width,
        ):
            yield Box(left, top, left + width, top + LINE)


def _leader(box: Box, x: float, y: float) -> list[Box]:
    """The line from a dot to a name, as small boxes."""
    (to_x, to_y), parts = box.nearest(x, y), 8
    steps = ((x + (to_x - x) * i / parts, y + (to_y - y) * i / parts) for i in range(1, parts))
    return [Box(a - 2, b - 2, a + 2, b + 2) for a, b in steps]


def _away(box: Box, x: float, y: float) -> float:
    at_x, at_y = box.nearest(x, y)
    return hypot(at_x - x, at_y - y)


def _around(x: float, y: float) -> Box:
    return Box(x - _DOT, y - _DOT, x + _DOT, y + _DOT)


def _neighbours(dots: Sequence[tuple[float, float]], index: int) -> int:
    """How many dots are so near that their names want the same room."""
    x, y = dots[index]
    return sum(abs(x - a) < 8 * LINE and abs(y - b) < 2 * LINE for a, b in dots)
