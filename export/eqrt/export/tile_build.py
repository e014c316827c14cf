"""Maps of other formats, turned into tiles.

Lanelet2 maps are projected to the plane that touches the Earth at the origin (east, north). Local
ones keep their own plane: those whose nodes say `local_x` and `local_y`, and those drawn around
latitude and longitude zero. CommonRoad scenarios are planar already. OpenDRIVE and Argoverse maps
are not read.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import TileError, UsageError
from eqrt.core.lanes import (
    SHORTEST_M,
    Lane,
    LaneMap,
    LaneType,
    arclength,
    build_lane_map,
    middle_line,
)
from eqrt.core.tile import TileInfo, decode, encode
from eqrt.export.osm import keep_lanelets, read_osm, tag_value
from eqrt.training.recordings.commonroad import lane_map as commonroad_lane_map
from eqrt.training.recordings.commonroad import read_scenario

Origin = tuple[float, float]
"""Latitude and longitude in degrees, WGS 84."""
Place = tuple[float, float]
"""x and y in metres, map frame."""

_SAME_PLACE_M = 1.0


def build_tile(source: Path, origin: Origin | None, credit: str | None) -> tuple[bytes, list[str]]:
    """The tile file's bytes for a map file, and what of the map had to be left out.

    Without `origin`, that of a Lanelet2 map is the middle of its nodes, and that of a planar map is
    not known. Raises TileError or LogError naming the file if it cannot be used, UsageError if
    `lanelet2` is not installed.
    """
    name, kind = _name_and_kind(source)
    if kind == ".osm":
        built = _from_lanelet2(source, origin)
    elif kind == ".xml":
        built = _from_commonroad(source, origin)
    else:
        raise TileError(
            f"{source}: cannot tell the map's format by its name; supported are Lanelet2 (.osm) "
            "and CommonRoad (.xml), also gzipped"
        )
    latitude_deg, longitude_deg = built.origin or (math.nan, math.nan)
    info = TileInfo(
        name=name,
        source=source.name,
        credit=built.credit if credit is None else credit,
        origin_latitude_deg=latitude_deg,
        origin_longitude_deg=longitude_deg,
    )
    data = encode(built.lane_map, info)
    decode(data, str(source))  # a file that has not been read back is not finished
    return data, built.skipped


def _name_and_kind(source: Path) -> tuple[str, str]:
    """`maps/Town.OSM.gz` -> `Town`, `.osm`."""
    plain = Path(source.name[:-3] if source.name.lower().endswith(".gz") else source.name)
    return plain.stem, plain.suffix.lower()


@dataclass(frozen=True, slots=True)
class _Built:
    lane_map: LaneMap
    origin: Origin | None
    credit: str
    skipped: list[str]


def _from_commonroad(source: Path, origin: Origin | None) -> _Built:
    scenario = read_scenario(source)
    return _Built(commonroad_lane_map(scenario), origin, scenario.source, [])


def _from_lanelet2(source: Path, origin: Origin | None) -> _Built:
    lanelet2 = _import_lanelet2()
    root = read_osm(source)
    skipped = keep_lanelets(root)
    _lay_flat(root)
    planar = _move_to_plane(root, source, origin, lanelet2) or _near_null_island(
        _middle(root, source)
    )
    projected_from = (0.0, 0.0) if planar else origin or _middle(root, source)
    projector = _projector(projected_from, lanelet2)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder, "map.osm")
        try:
            ElementTree.ElementTree(root).write(plain)
            lanelets, errors = lanelet2.io.loadRobust(str(plain), projector)
        except RuntimeError as error:
            raise TileError(f"{source}: not a Lanelet2 map ({error})") from error
    skipped += [str(error).strip("\t -") for error in errors][1:]  # the first is a heading
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    skipped += _drop_odd_limits(lanelets, rules)
    graph = lanelet2.routing.RoutingGraph(lanelets, rules)
    lanes = []
    for lane in _lanes(lanelets, graph, rules, source):
        if arclength(lane.centerline)[-1] < SHORTEST_M:
            skipped.append(f"lane {lane.lane_id} is shorter than a centimetre")
        else:
            lanes.append(lane)
    lane_map = build_lane_map(lanes, str(source))
    return _Built(lane_map, origin if planar else projected_from, "", skipped)


def _import_lanelet2() -> Any:
    try:
        import lanelet2  # noqa: PLC0415  # only this format needs it, and few install it
    except ModuleNotFoundError as error:
        raise UsageError(
            "reading Lanelet2 maps needs the package 'lanelet2', which is not installed; "
            "install it with: pip install 'eqrt[maps]'"
        ) from error
    return lanelet2


def _projector(origin: Origin, lanelet2: Any) -> Any:
    return lanelet2.projection.LocalCartesianProjector(lanelet2.io.Origin(*origin))


def _middle(root: ElementTree.Element, source: Path) -> Origin:
    """The middle of all nodes, to the seventh decimal (a centimetre)."""
    nodes = root.findall("node")
    places = np.array([_numbers((node.get("lat"), node.get("lon")), source) for node in nodes])
    if (farthest := np.abs(places[:, 0]).max()) > 90.0:
        raise TileError(
            f"{source}: a node's latitude is {farthest:g} degrees away from the equator, expected "
            "90 at most; are latitude and longitude swapped?"
        )
    # All around the first node, so that none lies beyond the antimeridian as seen from another.
    places[:, 1] -= 360.0 * np.round((places[:, 1] - places[0, 1]) / 360.0)
    latitude_deg, longitude_deg = ((places.min(axis=0) + places.max(axis=0)) / 2.0).tolist()
    return round(latitude_deg, 7), round(math.remainder(longitude_deg, 360.0), 7)


def _numbers(texts: tuple[str | None, str | None], source: Path) -> tuple[float, float]:
    try:
        numbers = float(texts[0] or ""), float(texts[1] or "")
    except ValueError:
        numbers = (math.nan, math.nan)
    if not all(map(math.isfinite, numbers)):
        raise TileError(
            f"{source}: a node's place is {texts}, expected two numbers: latitude and longitude, "
            "or local_x and local_y on every node"
        )
    return numbers


def _near_null_island(middle: Origin) -> bool:
    """Whether the map lies in the ocean at (0, 0): a local map, drawn where no roads are."""
    return max(map(abs, middle)) < 0.5  # degrees, 55 km


def _lay_flat(root: ElementTree.Element) -> None:
    """Forget heights: the tile's plane has none, and neither have the poses brought to it.

    The library would move what lies 1 km high outwards by 0.16 m per km from the origin.
    """
    for node in root.findall("node"):
        for tag in node.findall("tag[@k='ele']"):
            node.remove(tag)


def _move_to_plane(
    root: ElementTree.Element, source: Path, origin: Origin | None, lanelet2: Any
) -> bool:
    """Whether all nodes have `local_x` and `local_y`; if so, they become the nodes' places.

    The library projects latitude and longitude whatever the file says, so they are set to what it
    will turn back into the local values.
    """
    nodes = root.findall("node")
    texts = [(tag_value(node, "local_x"), tag_value(node, "local_y")) for node in nodes]
    if any(None in pair for pair in texts):
        return False
    places = [_numbers(pair, source) for pair in texts]
    if origin is not None:
        _check_origin(nodes, places, source, origin, lanelet2)
    projector = _projector((0.0, 0.0), lanelet2)
    for node, (x_m, y_m) in zip(nodes, places, strict=True):
        point = projector.reverse(lanelet2.core.BasicPoint3d(x_m, y_m, 0.0))
        node.attrib.update(lat=f"{point.lat:.12f}", lon=f"{point.lon:.12f}")
        ElementTree.SubElement(node, "tag", k="ele", v=f"{point.alt:.6f}")
    return True


def _check_origin(
    nodes: list[ElementTree.Element],
    places: list[Place],
    source: Path,
    origin: Origin,
    lanelet2: Any,
) -> None:
    """Raise TileError if nodes that also have latitude and longitude show another plane.

    A UTM or MGRS grid is turned against north, by up to 3 degrees.
    """
    projector = _projector(origin, lanelet2)
    for node, (x_m, y_m) in zip(nodes, places, strict=True):
        try:
            stated = float(node.get("lat", "")), float(node.get("lon", ""))
        except ValueError:
            continue
        if _near_null_island(stated):
            continue
        point = projector.forward(lanelet2.core.GPSPoint(*stated, 0.0))
        off_m = math.hypot(point.x - x_m, point.y - y_m)
        if off_m > _SAME_PLACE_M:
            raise TileError(
                f"{source}: local_x and local_y of node {node.get('id')} lie {off_m:.1f} m from "
                "its latitude and longitude as seen from that origin; choose the one where x = y "
                "= 0 and x leads east, or remove local_x and local_y from the map"
            )


def _drop_odd_limits(lanelets: Any, rules: Any) -> list[str]:
    """Forget the speed limits that are none, and name them.

    The library takes words for 0 km/h, and its routing graph fails on a sign that it does not know.
    """
    dropped = []
    for lanelet in _by_id(lanelets):
        stated = {k: v for k, v in lanelet.attributes.items() if k.startswith("speed_limit")}
        signs = list(lanelet.regulatoryElements)
        if (stated or signs) and not 0.0 < _stated_kmh(lanelet, rules) < 1000.0:
            said = ", ".join(stated.values()) or "what its sign says"
            dropped.append(f"speed limit of lanelet {lanelet.id}: {said} is not a known speed")
            for key in stated:
                del lanelet.attributes[key]
            for sign in signs:
                lanelet.removeRegulatoryElement(sign)
    return dropped


def _stated_kmh(lanelet: Any, rules: Any) -> float:
    try:
        return float(rules.speedLimit(lanelet).speedLimit)
    except RuntimeError:
        return math.nan


def _lanes(lanelets: Any, graph: Any, rules: Any, source: Path) -> Iterator[Lane]:
    """Lanes that vehicles may drive; a lanelet open both ways gives two, the second as -id."""
    ids = {int(lanelet.id) for lanelet in lanelets.laneletLayer}
    for lanelet in _by_id(lanelets):
        for way in (lanelet, lanelet.invert()):
            if rules.canPass(way):
                if way.inverted() and _lane_id(way) in ids:
                    raise TileError(
                        f"{source}: lanelet {way.id} is open both ways, and {_lane_id(way)}, the "
                        "id of its way back, is another lanelet's; renumber one of them"
                    )
                yield _lane(way, graph, rules)


def _by_id(lanelets: Any) -> list[Any]:
    return sorted(lanelets.laneletLayer, key=lambda lanelet: int(lanelet.id))


def _lane(way: Any, graph: Any, rules: Any) -> Lane:
    return Lane(
        lane_id=_lane_id(way),
        centerline=middle_line(_line(way.leftBound), _line(way.rightBound)),
        successors=[_lane_id(after) for after in graph.following(way)],
        left=_neighbour(graph.left(way), graph.adjacentLeft(way)),
        right=_neighbour(graph.right(way), graph.adjacentRight(way)),
        lane_type=_lane_type(dict(way.attributes)),
        speed_limit_mps=_speed_limit_mps(way, rules),
    )


def _lane_id(way: Any) -> int:
    return -int(way.id) if way.inverted() else int(way.id)


def _line(bound: Any) -> NDArray[np.float64]:
    return np.array([(point.x, point.y) for point in bound])


def _neighbour(reachable: Any, beside: Any) -> int | None:
    """The lane that one may change to, or else the one behind a solid line."""
    neighbour = reachable or beside
    return None if neighbour is None else _lane_id(neighbour)


def _lane_type(attributes: dict[str, str]) -> LaneType:
    subtypes = {"highway": LaneType.HIGHWAY, "exit": LaneType.RAMP, "bus_lane": LaneType.BUS}
    urban = LaneType.URBAN if attributes.get("location") == "urban" else LaneType.UNKNOWN
    return subtypes.get(attributes.get("subtype", ""), urban)


def _speed_limit_mps(way: Any, rules: Any) -> float:
    """As the map states it, or the law's for a German road; NaN otherwise.

    The library knows the law of Germany only, and would apply it everywhere.
    """
    attributes = dict(way.attributes)
    if "speed_limit" in attributes or way.speedLimits() or attributes.get("region") == "de":
        return float(rules.speedLimit(way).speedLimit) / 3.6
    return math.nan
