"""Look at a map tile, or build one.

`eqrt tile info FILE` runs anywhere; `eqrt tile build SOURCE --out FILE` needs the workstation's
parts, and the `lanelet2` package for Lanelet2 maps.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

from eqrt.core.errors import UsageError
from eqrt.core.lane_lines import LaneLines
from eqrt.core.tile import TileInfo
from eqrt.runtime.prediction.tiles import Tile, load_tile, save_tile

_MOST_NAMED = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`info FILE` and `build SOURCE --out FILE`."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="COMMAND")
    info = actions.add_parser("info", help="say what a tile holds", allow_abbrev=False)
    info.add_argument("tile", type=Path, metavar="FILE")
    build = actions.add_parser("build", help="build a tile from a map", allow_abbrev=False)
    build.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="Lanelet2 map (.osm) or CommonRoad scenario (.xml), also gzipped (.gz)",
    )
    build.add_argument("--out", type=Path, required=True, metavar="FILE")
    build.add_argument(
        "--origin",
        type=_origin,
        metavar="LAT,LON",
        help="degrees, where x = y = 0 (default: the middle of a Lanelet2 map; not known for a "
        "CommonRoad scenario); write --origin=-33.8,151.2 when it begins with a minus",
    )
    build.add_argument(
        "--credit", metavar="TEXT", help="whose data it is, and its licence; kept in the tile"
    )


def run(args: argparse.Namespace) -> int:
    """Print what the tile holds, after building it if asked to."""
    path: Path = args.tile if args.action == "info" else args.out
    if args.action == "build":
        if path.resolve() == args.source.resolve():
            raise UsageError(f"--out {path} is the map itself; choose another file for the tile")
        data, skipped = _workshop().build_tile(args.source, args.origin, args.credit)
        if skipped:
            _note(skipped)
        save_tile(path, data)
    print(_describe(load_tile(path)))
    return 0


def _note(skipped: list[str]) -> None:
    """What the map has and the tile has not, the first of it by name."""
    lines = [f"note: {len(skipped)} parts of the map were left out:", *skipped[:_MOST_NAMED]]
    if len(skipped) > _MOST_NAMED:
        lines.append(f"and {len(skipped) - _MOST_NAMED} more")
    print("\n  ".join(lines), file=sys.stderr)


def _workshop() -> ModuleType:
    try:
        return importlib.import_module("eqrt.export.tile_build")
    except ModuleNotFoundError as error:
        raise UsageError(
            f"eqrt tile build needs {error.name!r}, which is not installed here; "
            "build the tile on a workstation with the whole package"
        ) from error


def _origin(text: str) -> tuple[float, float]:
    """(latitude, longitude) in degrees; argparse turns the error into a usage message."""
    try:
        latitude_deg, longitude_deg = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not LAT,LON in degrees") from None
    if not (abs(latitude_deg) < 90.0 and abs(longitude_deg) <= 180.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not on Earth: LAT,LON in degrees")
    return latitude_deg, longitude_deg


def _describe(tile: Tile) -> str:
    lane_map, info = tile.lane_map, tile.info
    length_km = LaneLines(lane_map).length_m.sum() / 1e3
    low, high = lane_map.points.min(axis=0), lane_map.points.max(axis=0)
    (west, south), (east, north) = low.tolist(), high.tolist()
    rows = {
        "tile": f"{info.name} (id {info.tile_id})",
        "lanes": f"{lane_map.num_lanes}, {length_km:.2f} km, {len(lane_map.points)} points, "
        f"{len(lane_map.successor)} connections",
        "extent": f"x {west:.1f} to {east:.1f} m, y {south:.1f} to {north:.1f} m",
        "origin": _origin_text(info),
        "speed limit": f"known for {np.isfinite(lane_map.speed_limit_mps).mean():.0%} of lanes",
        "source": info.source,
        "credit": info.credit or "not stated",
    }
    return "\n".join(f"{name:<11}  {text}" for name, text in rows.items())


def _origin_text(info: TileInfo) -> str:
    if math.isnan(info.origin_latitude_deg):
        return "not known: poses must come in the map's own x and y"
    return f"latitude {info.origin_latitude_deg:.7f}, longitude {info.origin_longitude_deg:.7f}"
