"""Units as DBCs and profiles spell them, and what makes SI of them."""

from __future__ import annotations

import math

_DEGREE = math.pi / 180.0
_MILE = 1609.344

# What is measured -> unit as spelled -> factor to metres, seconds, radians or a plain ratio.
FACTORS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0},
    "speed": {
        "m/s": 1.0,
        "m.s-1": 1.0,
        "cm/s": 0.01,
        "mm/s": 0.001,
        "km/h": 1 / 3.6,
        "kph": 1 / 3.6,
        "kmh": 1 / 3.6,
        "mph": _MILE / 3600.0,
    },
    "angle": {"rad": 1.0, "deg": _DEGREE, "°": _DEGREE, "mrad": 0.001},
    "angular rate": {
        "rad/s": 1.0,
        "rad.s-1": 1.0,
        "deg/s": _DEGREE,
        "°/s": _DEGREE,
        "mrad/s": 0.001,
    },
    "time": {"s": 1.0, "ms": 0.001, "us": 1e-6},
    "ratio": {"": 1.0, "%": 0.01},
}
