"""CommonRoad scenarios (2018b and 2020a): recorded tracks and the lanelets under them.

Positions are metres in the scenario's own frame (x east, y north), which becomes the map frame;
angles are radians, counter-clockwise positive; steps are whole ticks of `dt_s`.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import LogError
from eqrt.core.lanes import Lane, LaneMap, LaneType, build_lane_map, middle_line

Float64 = NDArray[np.float64]

VERSIONS = ("2018b", "2020a")


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One moving object over time; gaps are possible, `step` says where."""

    track_id: int
    object_type: str
    """CommonRoad's word: car, truck, bus, motorcycle, bicycle, pedestrian ..."""
    length_m: float
    """NaN if the shape is neither a rectangle nor a circle."""
    width_m: float
    """Likewise."""
    step: NDArray[np.int32]
    """(n,) strictly rising."""
    position: Float64
    """(n, 2) metres, of the object's centre."""
    heading_rad: Float64
    """(n,)"""
    speed_mps: Float64
    """(n,)"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Adjacent:
    """A lanelet side by side with another."""

    lanelet_id: int
    same_direction: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Lanelet:
    """A piece of lane between two bounds, both in driving direction."""

    lanelet_id: int
    left: Float64
    """(n, 2) metres."""
    right: Float64
    """(n, 2) metres."""
    successors: tuple[int, ...]
    predecessors: tuple[int, ...]
    adjacent_left: Adjacent | None
    adjacent_right: Adjacent | None
    speed_limit_mps: float
    """NaN = not known."""
    lanelet_types: tuple[str, ...]
    """CommonRoad's words (urban, highway, intersection, ...), none in 2018b."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One recorded stretch of driving."""

    path: Path
    """The file that it was read from."""
    name: str
    """The benchmark id."""
    source: str
    """Where the file says that its data came from."""
    dt_s: float
    tracks: tuple[Track, ...]
    lanelets: tuple[Lanelet, ...]


def read_scenario(path: Path) -> Scenario:
    """Read a `.xml` or gzipped scenario; static obstacles and planning problems are left out.

    Raises LogError, naming the file, if it cannot be read or anything needed is missing.
    """
    root = _parse(path)
    try:
        limits = _sign_limits(root)
        scenario = Scenario(
            path=path,
            name=root.get("benchmarkID", path.name.partition(".")[0]),
            source=root.get("source", ""),
            dt_s=_number(root.get("timeStepSize"), "timeStepSize"),
            tracks=tuple(_track(element) for element in _dynamic_obstacles(root)),
            lanelets=tuple(_lanelet(element, limits) for element in root.findall("lanelet")),
        )
    except _MalformedError as error:
        raise LogError(f"{path}: {error}; the scenario is incomplete") from error
    if not scenario.lanelets:
        raise LogError(f"{path}: no lanelets; choose a scenario with a road network")
    if scenario.dt_s <= 0.0:
        raise LogError(f"{path}: timeStepSize is {scenario.dt_s}, expected above 0 s")
    return scenario


def lane_map(scenario: Scenario) -> LaneMap:
    """The scenario's lanelets for vehicles as centerlines in its own frame.

    A successor that only the other lanelet states (as its predecessor) is added. Raises TileError,
    naming the file, if a lanelet cannot be used.
    """
    follows: dict[int, list[int]] = {lanelet.lanelet_id: [] for lanelet in scenario.lanelets}
    for lanelet in scenario.lanelets:
        follows[lanelet.lanelet_id] += lanelet.successors
        for before in lanelet.predecessors:
            follows.setdefault(before, []).append(lanelet.lanelet_id)
    lanes = (
        Lane(
            lane_id=lanelet.lanelet_id,
            centerline=middle_line(lanelet.left, lanelet.right),
            successors=follows[lanelet.lanelet_id],
            left=_same_way(lanelet.adjacent_left),
            right=_same_way(lanelet.adjacent_right),
            lane_type=lane_type,
            speed_limit_mps=lanelet.speed_limit_mps,
        )
        for lanelet in scenario.lanelets
        if (lane_type := _lane_type(lanelet)) not in _NOT_FOR_VEHICLES
    )
    return build_lane_map(lanes, str(scenario.path))


_LANE_TYPES = {
    "urban": LaneType.URBAN,
    "country": LaneType.URBAN,
    "interstate": LaneType.HIGHWAY,
    "highway": LaneType.HIGHWAY,
    "mainCarriageWay": LaneType.HIGHWAY,
    "accessRamp": LaneType.RAMP,
    "exitRamp": LaneType.RAMP,
    "bicycleLane": LaneType.BICYCLE,
    "sidewalk": LaneType.PEDESTRIAN,
    "crosswalk": LaneType.PEDESTRIAN,
    "busLane": LaneType.BUS,
}
_LAST_STEP = np.iinfo(np.int32).max
_NOT_FOR_VEHICLES = {LaneType.BICYCLE, LaneType.PEDESTRIAN}
_SPEED_SIGNS = {"R2-1", "274", "274.1"}  # maximum speed in the USA and in Germany; value in m/s


class _MalformedError(Exception):
    """Something needed is missing; `read_scenario` adds the file."""


def _parse(path: Path) -> ElementTree.Element:
    try:
        data = path.read_bytes()
        if data.startswith(b"\x1f\x8b"):
            data = gzip.decompress(data)
        root = ElementTree.fromstring(data)
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such scenario file") from error
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"{path}: cannot be read ({error}); fetch or unpack it again") from error
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # or an unknown encoding
        raise LogError(f"{path}: not XML ({error}); expected a CommonRoad scenario") from error
    if root.tag != "commonRoad":
        raise LogError(f"{path}: the root is <{root.tag}>, expected a CommonRoad scenario")
    version = root.get("commonRoadVersion")
    if version not in VERSIONS:
        raise LogError(f"{path}: CommonRoad {version} is not supported, only {VERSIONS}")
    return root


def _dynamic_obstacles(root: ElementTree.Element) -> Iterator[ElementTree.Element]:
    yield from root.iterfind("dynamicObstacle")  # 2020a
    for obstacle in root.iterfind("obstacle"):  # 2018b
        if obstacle.findtext("role") == "dynamic":
            yield obstacle


def _track(element: ElementTree.Element) -> Track:
    what = f"obstacle {element.get('id')}"
    states = [*element.findall("initialState"), *element.findall("trajectory/state")]
    step = np.array([_exact(state, "time", what) for state in states])
    if not len(step) or (np.diff(step) <= 0).any() or (step % 1 != 0).any():
        raise _MalformedError(f"{what} has no states, or their times do not rise in whole steps")
    if np.abs(step).max() > _LAST_STEP:
        raise _MalformedError(f"{what}: a time is beyond {_LAST_STEP} steps")
    length_m, width_m = _size(element, what)
    return Track(
        track_id=_identity(element.get("id"), what),
        object_type=element.findtext("type", "unknown"),
        length_m=length_m,
        width_m=width_m,
        step=step.astype(np.int32),
        position=np.array([_point(state.find("position/point"), what) for state in states]),
        heading_rad=np.array([_exact(state, "orientation", what) for state in states]),
        speed_mps=np.array([_exact(state, "velocity", what) for state in states]),
    )


def _size(element: ElementTree.Element, what: str) -> tuple[float, float]:
    if (box := element.find("shape/rectangle")) is not None:
        return _number(box.findtext("length"), what), _number(box.findtext("width"), what)
    if (radius := element.findtext("shape/circle/radius")) is not None:
        diameter_m = 2.0 * _number(radius, what)
        return diameter_m, diameter_m
    return math.nan, math.nan


def _lanelet(element: ElementTree.Element, limits: dict[str, float]) -> Lanelet:
    what = f"lanelet {element.get('id')}"
    return Lanelet(
        lanelet_id=_identity(element.get("id"), what),
        left=_bound(element, "leftBound", what),
        right=_bound(element, "rightBound", what),
        successors=_references(element, "successor", what),
        predecessors=_references(element, "predecessor", what),
        adjacent_left=_adjacent(element.find("adjacentLeft"), what),
        adjacent_right=_adjacent(element.find("adjacentRight"), what),
        speed_limit_mps=_speed_limit(element, limits, what),
        lanelet_types=tuple(kind.text or "" for kind in element.iterfind("laneletType")),
    )


def _bound(element: ElementTree.Element, side: str, what: str) -> Float64:
    points = [_point(point, f"{what} {side}") for point in element.iterfind(f"{side}/point")]
    if len(points) < 2:
        raise _MalformedError(f"{what}: {side} has {len(points)} points, expected 2 or more")
    return np.array(points)


def _references(element: ElementTree.Element, tag: str, what: str) -> tuple[int, ...]:
    return tuple(_identity(other.get("ref"), f"{what} {tag}") for other in element.iterfind(tag))


def _adjacent(element: ElementTree.Element | None, what: str) -> Adjacent | None:
    if element is None:
        return None
    return Adjacent(
        lanelet_id=_identity(element.get("ref"), f"{what} {element.tag}"),
        same_direction=element.get("drivingDir") == "same",
    )


def _lane_type(lanelet: Lanelet) -> LaneType:
    """The first type that is for vehicles, else the first that is known."""
    types = [_LANE_TYPES[word] for word in lanelet.lanelet_types if word in _LANE_TYPES]
    types.sort(key=lambda lane_type: lane_type in _NOT_FOR_VEHICLES)
    return types[0] if types else LaneType.UNKNOWN


def _same_way(adjacent: Adjacent | None) -> int | None:
    return adjacent.lanelet_id if adjacent is not None and adjacent.same_direction else None


def _speed_limit(element: ElementTree.Element, limits: dict[str, float], what: str) -> float:
    if (text := element.findtext("speedLimit")) is not None:  # 2018b
        return _number(text, f"{what} speedLimit")
    signs = (limits.get(sign.get("ref", "")) for sign in element.iterfind("trafficSignRef"))
    return next((limit for limit in signs if limit is not None), math.nan)


def _sign_limits(root: ElementTree.Element) -> dict[str, float]:
    """Traffic sign id -> the speed limit it shows, m/s (2020a)."""
    return {
        sign.get("id", ""): _number(value, f"traffic sign {sign.get('id')}")
        for sign in root.iterfind("trafficSign")
        for shown in sign.iterfind("trafficSignElement")
        if shown.findtext("trafficSignID") in _SPEED_SIGNS
        and (value := shown.findtext("additionalValue")) is not None
    }


def _point(element: ElementTree.Element | None, what: str) -> tuple[float, float]:
    if element is None:
        raise _MalformedError(f"{what} has no exact position")
    return _number(element.findtext("x"), what), _number(element.findtext("y"), what)


def _exact(state: ElementTree.Element, name: str, what: str) -> float:
    return _number(state.findtext(f"{name}/exact"), f"{what}: {name}")


def _number(text: str | None, what: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _MalformedError(f"{what}: expected a number, found {text!r}")
    return value


def _identity(text: str | None, what: str) -> int:
    try:
        return int(text or "")
    except ValueError:
        raise _MalformedError(f"{what}: expected a whole number, found {text!r}") from None
