"""Which lanes a model reads: its contract decides, in training and in the car alike."""

from __future__ import annotations

from eqrt.core.contract import ModelContract
from eqrt.core.lanes import LaneMap
from eqrt.core.nearest import NearestLanes
from eqrt.core.routes import RouteFinder
from eqrt.core.scene import CenterlineSource


def centerline_source(lane_map: LaneMap, contract: ModelContract) -> CenterlineSource:
    """What finds the centerlines that a model was trained with, on `lane_map`."""
    if contract.lane_choice == "nearest":
        return NearestLanes(lane_map)
    return RouteFinder(lane_map)
