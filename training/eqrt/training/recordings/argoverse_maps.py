"""Argoverse's maps, both kinds: lane segments that name their neighbours, made one `LaneMap`.

Argoverse 1 has one XML file per city: nodes with x and y, ways that are centerlines, and tags.
Argoverse 2 has one JSON file per scenario, with bounds as well. Both are metres in the city's own
frame (x east, y north), which becomes the map frame. A neighbour may run the other way.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import LogError
from eqrt.core.lanes import (
    MAX_COORDINATE_M,
    Lane,
    LaneMap,
    LaneType,
    arclength,
    build_lane_map,
    evenly_spaced,
    middle_line,
)

Float64 = NDArray[np.float64]

_SHORTEST_M = 0.01
"""A segment shorter than this has no direction and is left out."""
_LANE_TYPES = {"VEHICLE": LaneType.UNKNOWN, "BUS": LaneType.BUS}
"""Argoverse 2's words. BIKE is not among them: a tile holds no bicycle lanes either."""


def read_city_map(path: Path) -> LaneMap:
    """The lanes of an Argoverse 1 map, `pruned_argoverse_*_vector_map.xml`.

    Raises LogError, naming the file, if it cannot be read or is no such map.
    """
    nodes: dict[str | None, tuple[float, float]] = {}
    ways: list[_Way] = []
    try:
        for element in _top_elements(path):
            if element.tag == "node":
                nodes[element.get("id")] = _node(element)
            elif element.tag == "way":
                ways.append(_Way.of(element))
        segments = [way.segment(nodes) for way in ways]
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error}); fetch it again") from error
    except _MalformedError as error:
        raise LogError(f"{path}: {error}; expected an Argoverse 1 map") from error
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # or an unknown encoding
        raise LogError(f"{path}: not XML ({error}); expected an Argoverse 1 map") from error
    return _lane_map(segments, path)


def read_scenario_map(path: Path) -> LaneMap:
    """The lanes for cars and buses of an Argoverse 2 map, `log_map_archive_*.json`.

    Raises LogError, naming the file, if it cannot be read or is no such map.
    """
    try:
        stated = msgspec.json.decode(path.read_bytes(), type=_LogMap).lane_segments
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error}); fetch it again") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: {error}; expected an Argoverse 2 map, whole") from error
    drivable = [lane.segment() for lane in stated.values() if lane.lane_type in _LANE_TYPES]
    return _lane_map(drivable, path)


class _MalformedError(Exception):
    """Something needed is missing; the readers add the file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Segment:
    """A lane segment as its file states it."""

    lane_id: int
    centerline: Float64
    """(n, 2) metres, map frame, in driving direction."""
    successors: list[int]
    predecessors: list[int]
    left: int | None
    """The neighbour on the left, whichever way it runs."""
    right: int | None
    lane_type: LaneType = LaneType.UNKNOWN


@dataclass(frozen=True, slots=True)
class _Way:
    """A `<way>` before its nodes are looked up."""

    lane_id: int
    nodes: list[str | None] = field(default_factory=list)
    tags: dict[str | None, list[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, element: ElementTree.Element) -> _Way:
        way = cls(_identity(element.get("lane_id"), "lane_id of a way"))
        for child in element:
            if child.tag == "nd":
                way.nodes.append(child.get("ref"))
            else:
                way.tags.setdefault(child.get("k"), []).append(child.get("v", ""))
        return way

    def segment(self, nodes: Mapping[str | None, tuple[float, float]]) -> _Segment:
        missing = [node for node in self.nodes if node not in nodes]
        if missing:
            raise _MalformedError(f"lane {self.lane_id}: node {missing[0]} is missing")
        return _Segment(
            lane_id=self.lane_id,
            centerline=np.array([nodes[node] for node in self.nodes]).reshape(-1, 2),
            successors=self._lanes("successor"),
            predecessors=self._lanes("predecessor"),
            left=next(iter(self._lanes("l_neighbor_id")), None),
            right=next(iter(self._lanes("r_neighbor_id")), None),
        )

    def _lanes(self, key: str) -> list[int]:
        what = f"lane {self.lane_id}: {key}"
        return [_identity(text, what) for text in self.tags.get(key, []) if text != "None"]


class _Point(msgspec.Struct, gc=False):
    x: float
    y: float


class _LaneSegment(msgspec.Struct, kw_only=True):
    """One of the JSON file's lane segments, as far as it is read."""

    id: int
    lane_type: str
    centerline: list[_Point] | None = None
    left_lane_boundary: list[_Point]
    right_lane_boundary: list[_Point]
    left_neighbor_id: int | None
    right_neighbor_id: int | None
    successors: list[int]
    predecessors: list[int]

    def segment(self) -> _Segment:
        """With the centerline, or else the middle of the bounds."""
        if self.centerline:
            line = _line(self.centerline)
        else:
            line = _middle(_line(self.left_lane_boundary), _line(self.right_lane_boundary))
        return _Segment(
            lane_id=self.id,
            centerline=line,
            successors=self.successors,
            predecessors=self.predecessors,
            left=self.left_neighbor_id,
            right=self.right_neighbor_id,
            lane_type=_LANE_TYPES[self.lane_type],
        )


class _LogMap(msgspec.Struct):
    lane_segments: dict[str, _LaneSegment]


def _top_elements(path: Path) -> Iterator[ElementTree.Element]:
    """Every child of the root when it is complete; what was read before is let go."""
    with path.open("rb") as file:
        events = ElementTree.iterparse(file, events=("start", "end"))
        _, root = next(events)
        for event, element in events:
            if event == "end" and element.tag in ("node", "way"):
                yield element
                root.clear()


def _node(element: ElementTree.Element) -> tuple[float, float]:
    x, y = element.get("x", ""), element.get("y", "")
    try:
        place = float(x), float(y)
    except ValueError:
        place = (math.nan, math.nan)
    if not all(map(math.isfinite, place)):
        raise _MalformedError(f"node {element.get('id')}: expected numbers, found {x!r}, {y!r}")
    return place


def _identity(value: str | None, what: str) -> int:
    try:
        return int(value or "")
    except ValueError:
        raise _MalformedError(f"{what}: expected a whole number, found {value!r}") from None


def _line(points: Iterable[_Point]) -> Float64:
    """(n, 2)"""
    return np.array([(point.x, point.y) for point in points], np.float64).reshape(-1, 2)


def _middle(left: Float64, right: Float64) -> Float64:
    """The line halfway; no points if a bound has none."""
    return middle_line(left, right) if len(left) and len(right) else left[:0]


def _lane_map(segments: list[_Segment], path: Path) -> LaneMap:
    """The segments that have a length, all links stated by either side, neighbours checked."""
    lines = _lines(segments, path)
    follows: dict[int, list[int]] = {lane_id: [] for lane_id in lines}
    for segment in segments:
        follows.setdefault(segment.lane_id, []).extend(segment.successors)
        for before in segment.predecessors:
            follows.setdefault(before, []).append(segment.lane_id)
    lanes = (
        Lane(
            lane_id=segment.lane_id,
            centerline=lines[segment.lane_id],
            successors=follows[segment.lane_id],
            left=_same_way(segment.lane_id, segment.left, lines),
            right=_same_way(segment.lane_id, segment.right, lines),
            lane_type=segment.lane_type,
        )
        for segment in segments
        if segment.lane_id in lines
    )
    return build_lane_map(lanes, str(path))


def _lines(segments: list[_Segment], path: Path) -> dict[int, Float64]:
    """Lane id -> its centerline, evenly spaced, where it has a length."""
    lines: dict[int, Float64] = {}
    for segment in segments:
        if np.abs(segment.centerline).max(initial=0.0) > MAX_COORDINATE_M:
            raise LogError(
                f"{path}: lane {segment.lane_id} lies more than {MAX_COORDINATE_M / 1e3:.0f} km "
                "from the origin; the map is damaged"
            )
        if len(segment.centerline) > 1:
            line = evenly_spaced(segment.centerline)
            if arclength(line)[-1] >= _SHORTEST_M:
                lines[segment.lane_id] = line
    if not lines:
        raise LogError(f"{path}: no lanes for vehicles in it; expected an Argoverse map")
    return lines


def _same_way(lane: int, other: int | None, lines: Mapping[int, Float64]) -> int | None:
    """`other` if it is there and runs the same way: side by side, from end to end will tell."""
    if other is None or other not in lines:
        return None
    mine, its = (lines[i][-1] - lines[i][0] for i in (lane, other))
    return other if mine @ its > 0.0 else None
