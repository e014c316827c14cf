"""The demo's tile, another one like it, and cars where there are lanes: for exchanges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from drives import TILE, Car
from eqrt.core.frames import Pose2
from eqrt.core.tile import encode
from eqrt.runtime.prediction.tiles import load_tile, save_tile

CARS = [Car(object_id=1, x_m=0.0, y_m=0.0), Car(object_id=2, x_m=20.0, y_m=4.0)]
X_M, Y_M = load_tile(TILE).lane_map.points[0].tolist()
POSE = Pose2(X_M, Y_M, 0.0)
"""Where there are lanes."""


def other_tile(folder: Path, **info: object) -> Path:
    """The demo's tile under another name, so with another id."""
    tile = load_tile(TILE)
    path = folder / "other.tile"
    save_tile(path, encode(tile.lane_map, replace(tile.info, name="other", **info)))  # type: ignore[arg-type]  # its own fields
    return path
