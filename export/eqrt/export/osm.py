"""Lanelet2 files as XML: what must hold before the library may see them.

The `lanelet2` package crashes the process on references to things that are not there. So only whole
lanelets are handed to it, with the speed limits that stand beside them; of the rest (traffic
lights, areas, right of way) a tile knows nothing.
"""

from __future__ import annotations

import gzip
import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

from eqrt.core.errors import TileError

Element = ElementTree.Element

_WHOLE = re.compile(r"0|-?[1-9]\d{0,18}")
_LARGEST_ID = 2**63 - 1


def read_osm(source: Path) -> Element:
    """The `<osm>` element of a plain or gzipped file. Raises TileError naming the file."""
    try:
        data = source.read_bytes()
        if data.startswith(b"\x1f\x8b"):
            data = gzip.decompress(data)
        root = ElementTree.fromstring(data)
    except FileNotFoundError as error:
        raise TileError(f"{source}: no such map file") from error
    except (OSError, EOFError, zlib.error) as error:
        raise TileError(f"{source}: cannot be read ({error}); fetch or unpack it again") from error
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # or an unknown encoding
        raise TileError(f"{source}: not XML ({error}); expected a Lanelet2 map") from error
    if root.tag != "osm" or root.find("node") is None:
        raise TileError(f"{source}: the root is <{root.tag}>, expected <osm> with nodes")
    return root


def keep_lanelets(root: Element) -> list[str]:
    """Remove all but whole lanelets and what they are made of; say which are not whole."""
    dropped = _keep_one_of_each(root)
    nodes = {node.get("id") for node in root.findall("node")}
    ways = {way.get("id") for way in root.findall("way") if _is_line(way, nodes)}
    limits = {
        relation.get("id") for relation in root.findall("relation") if _is_limit(relation, ways)
    }
    whole = {"node": nodes, "way": ways, "relation": limits}
    kept = []
    for child in root:
        if child.tag == "relation" and tag_value(child, "type") == "lanelet":
            if fault := _fault(child, ways):
                dropped.append(f"lanelet {child.get('id')} {fault}")
                continue
            _unlink(child, limits)
        elif child.get("id") not in whole[child.tag]:
            continue
        kept.append(child)
    root[:] = kept  # at once: to remove one by one takes minutes where there are many
    return dropped


def tag_value(element: Element, key: str) -> str | None:
    """What an element's tag says."""
    tag = element.find(f"tag[@k='{key}']")
    return None if tag is None else tag.get("v")


def _keep_one_of_each(root: Element) -> list[str]:
    """Remove what an editor marked as deleted, and what no id tells apart; name the latter."""
    kept: dict[tuple[str, str], Element] = {}
    dropped = []
    for child in root:
        number = child.get("id", "")
        if child.tag not in {"node", "way", "relation"} or child.get("action") == "delete":
            continue
        if not _WHOLE.fullmatch(number) or abs(int(number)) > _LARGEST_ID:
            dropped.append(f"{child.tag} {number!r}: its id is not a whole number of 64 bits")
        elif (child.tag, number) in kept:
            dropped.append(f"{child.tag} {number} comes again; the first one is taken")
        else:
            kept[child.tag, number] = child
    root[:] = kept.values()
    return dropped


def _is_line(way: Element, nodes: set[str | None]) -> bool:
    points = [point.get("ref") for point in way.findall("nd")]
    return len(points) >= 2 and nodes.issuperset(points)


def _is_limit(relation: Element, ways: set[str | None]) -> bool:
    """Whether a relation is a speed limit, written as a regulatory element, whole."""
    return (
        tag_value(relation, "type") == "regulatory_element"
        and tag_value(relation, "subtype") == "speed_limit"
        and all(
            member.get("type") == "way" and member.get("ref") in ways
            for member in relation.findall("member")
        )
    )


def _fault(lanelet: Element, ways: set[str | None]) -> str | None:
    """What keeps a lanelet from being whole."""
    for side in ("left", "right"):
        bounds = lanelet.findall(f"member[@role='{side}']")
        if len(bounds) != 1:
            return f"has {len(bounds)} {side} bounds, expected one"
        kind, reference = bounds[0].get("type"), bounds[0].get("ref")
        if kind != "way" or reference not in ways:
            return f"has a {side} bound that is not there or not whole ({kind} {reference})"
    return None


def _unlink(lanelet: Element, limits: set[str | None]) -> None:
    """Remove the members that are neither bounds nor among `limits`."""
    for member in lanelet.findall("member"):
        is_limit = member.get("type") == "relation" and member.get("ref") in limits
        if member.get("role") not in {"left", "right"} and not is_limit:
            lanelet.remove(member)
