"""SUMO road networks (`*.net.xml`) as lane maps, in the network's own metres.

Lanes that motor vehicles may use, and the lanes inside junctions, so that routes lead through them:
lane -> lane in the junction (two of them where a turn waits halfway) -> next lane.
"""

from __future__ import annotations

import xml.sax
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sumolib
from numpy.typing import NDArray

from eqrt.core.errors import LogError, TileError
from eqrt.core.lanes import Lane, LaneMap, LaneType, arclength, build_lane_map, evenly_spaced

Float64 = NDArray[np.float64]

_ROADS = {"", "normal", "internal"}  # not crossings or footpaths
_CARS = {"passenger", "private", "taxi", "delivery", "truck", "trailer", "motorcycle", "hov"}
_BUSES = {"bus", "coach"}
_NOT_READ = (
    OSError,
    EOFError,
    zlib.error,
    xml.sax.SAXException,
    ValueError,
    LookupError,  # also of an encoding that is not known
    TypeError,
)
_SHORTEST_M = 0.02  # a lane map's lane is longer than 1 cm; shorter ones are passed through


@dataclass(frozen=True, slots=True)
class SumoNet:
    """The drivable part of a network."""

    lanes: dict[str, Any]
    """sumolib's lanes by SUMO's id, in the file's order."""
    follows: dict[str, list[str]]
    """The lanes that come right after each of them, inside junctions too."""

    def __getitem__(self, name: str) -> Float64:
        """(n, 2) the line along the middle of a lane, as it is drawn."""
        return _shape(self.lanes[name])


def read_sumo_lanes(path: Path) -> LaneMap:
    """The lanes of a network file; `lane_id` counts them in the file's order.

    Raises LogError if the file is not a SUMO network, TileError if it has no lane for vehicles.
    """
    net = read_net(path)
    index = {name: number for number, name in enumerate(net.lanes)}
    lanes = (
        Lane(
            lane_id=index[name],
            centerline=evenly_spaced(_shape(lane)),
            successors=[index[after] for after in net.follows[name]],
            left=_beside(lane, index, left=True),
            right=_beside(lane, index, left=False),
            lane_type=_lane_type(lane),
            speed_limit_mps=lane.getSpeed(),
        )
        for name, lane in net.lanes.items()
    )
    return build_lane_map(lanes, str(path))


def read_net(path: Path) -> SumoNet:
    """Raises LogError if the file is not a SUMO network, TileError if it has no lane to drive."""
    if not path.is_file():
        raise LogError(f"{path}: no such network; give a *.net.xml file")
    try:
        net = sumolib.net.readNet(str(path), withInternal=True)
        drivable = {
            lane.getID(): lane
            for edge in net.getEdges(withInternal=True)
            for lane in edge.getLanes()
            if edge.getFunction() in _ROADS and _lane_type(lane) != LaneType.UNKNOWN
        }
        lanes = {name: lane for name, lane in drivable.items() if _length_m(lane) > _SHORTEST_M}
        follows = {name: list(_next(lane, drivable, lanes)) for name, lane in lanes.items()}
    except _NOT_READ as error:
        raise LogError(f"{path}: not a SUMO network ({error}); give a *.net.xml file") from error
    if not lanes:
        raise TileError(f"{path}: no lanes for vehicles; give a SUMO network (*.net.xml) of roads")
    return SumoNet(lanes, follows)


def point_at(line: Float64, along_m: Float64) -> Float64:
    """(k, 2) the points at arclengths (k,) of a polyline (n, 2)."""
    along = arclength(line)
    return np.stack([np.interp(along_m, along, axis) for axis in line.T], axis=-1)


def _next(lane: Any, drivable: dict[str, Any], lanes: dict[str, Any]) -> Iterator[str]:
    """The lanes right after `lane`; one that is too short to keep gives those after it."""
    for connection in lane.getOutgoing():
        name = connection.getViaLaneID() or connection.getToLane().getID()
        if name in lanes:
            yield name
        elif name in drivable:
            yield from _next(drivable[name], drivable, lanes)


def _beside(lane: Any, index: dict[str, int], *, left: bool) -> int | None:
    """The neighbour on one side. SUMO counts from the kerb, so the number alone does not tell."""
    lanes = lane.getEdge().getLanes()
    ahead = _shape(lane)[-1] - _shape(lane)[0]
    for number in (lane.getIndex() - 1, lane.getIndex() + 1):
        if 0 <= number < len(lanes):
            apart = _middle(lanes[number]) - _middle(lane)
            if (ahead[0] * apart[1] - ahead[1] * apart[0] > 0.0) == left:
                return index.get(lanes[number].getID())
    return None


def _middle(lane: Any) -> Float64:
    middle: Float64 = point_at(_shape(lane), np.array([_length_m(lane) / 2.0]))[0]
    return middle


def _length_m(lane: Any) -> float:
    return float(arclength(_shape(lane))[-1])


def _shape(lane: Any) -> Float64:
    return np.array(lane.getShape(), np.float64)[:, :2]


def _lane_type(lane: Any) -> LaneType:
    """UNKNOWN for lanes that are not for motor vehicles."""
    allowed = set(lane.getPermissions())
    if allowed & _CARS:
        return LaneType.URBAN
    return LaneType.BUS if allowed & _BUSES else LaneType.UNKNOWN
