"""How fast bends can be driven in comfort: SUMO's drivers would take many at any speed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from eqrt.core.lanes import arclength
from eqrt.training.simulation.sumo_lanes import Float64, SumoNet, point_at, read_net

_ROUNDED_M = 3.0  # a car rounds the corners of a drawn lane over about this length (one sigma)
_REACH_M = 9  # three sigma
_BESIDE_M = 15.0  # of the lanes before and after
_SLOWEST_MPS = 3.0  # some lanes are drawn with a corner that nobody would drive


def bend_speeds(path: Path, lateral_mps2: float) -> dict[str, float]:
    """How fast the lanes with bends can be driven at a lateral acceleration: SUMO's id -> m/s.

    SUMO limits most turns inside junctions, but to 5.5 m/s2, and no bend of any other lane. Only
    the lanes where its limit is higher are named. A limit holds for a whole lane, so lanes outside
    junctions keep half of theirs. Raises LogError if `path` is not a network.
    """
    net = read_net(path)
    before = {after: name for name, follows in net.follows.items() for after in follows}
    speeds = {}
    for name, lane in net.lanes.items():
        in_junction = name.startswith(":")
        slowest_mps = _SLOWEST_MPS if in_junction else lane.getSpeed() / 2.0
        bend = _sharpest_bend(net, name, before.get(name)) if in_junction else _bend(net[name])
        speed_mps = max(slowest_mps, math.sqrt(lateral_mps2 / max(bend, 1e-6)))
        if speed_mps < lane.getSpeed():
            speeds[name] = speed_mps
    return speeds


def _sharpest_bend(net: SumoNet, name: str, before: str | None) -> float:
    """Of a lane in a junction, the corners where it meets other lanes included."""
    parts = [net[name]]
    if before is not None:
        parts.insert(0, _first_metres(net[before][::-1])[::-1])
    parts += [_first_metres(net[after]) for after in net.follows[name][:1]]
    return _bend(np.concatenate(parts))


def _bend(line: Float64) -> float:
    """The largest curvature, 1/m, of a polyline that is driven with its corners rounded."""
    line = line[np.concatenate([[True], np.hypot(*np.diff(line, axis=0).T) > 1e-3])]
    length_m = float(arclength(line)[-1])
    if length_m <= _REACH_M + 2.0:
        return 0.0
    dense = point_at(line, np.arange(0.0, length_m, 1.0))
    kernel = np.exp(-0.5 * (np.arange(-_REACH_M, _REACH_M + 1) / _ROUNDED_M) ** 2)
    beyond = ((_REACH_M, _REACH_M), (0, 0))
    extended = np.pad(dense, beyond, mode="reflect", reflect_type="odd")
    x, y = (np.convolve(axis, kernel / kernel.sum(), mode="valid") for axis in extended.T)
    step = np.diff(x) + 1j * np.diff(y)
    turn_rad = np.abs(np.angle(step[1:] * step[:-1].conj()))
    return float((turn_rad / np.maximum(np.abs(step[1:]), 0.1)).max())


def _first_metres(line: Float64) -> Float64:
    end_m = min(_BESIDE_M, float(arclength(line)[-1]))
    return point_at(line, np.linspace(0.0, end_m, max(2, round(end_m))))
