"""By what factor two quantities differ that should be one, and which slip makes that factor."""

from __future__ import annotations

from eqrt.runtime.can_check.report import Fit

MIN_PAIRS = 50
"""Below that a fit says nothing."""
MIN_SPREAD = 0.25
"""Where velocities (m/s; yaw rates in deg/s) hardly differ, neither does it."""

FACTORS = {  # a quantity is so many times too large -> what makes it so
    3.6: "km/h taken for m/s",
    1 / 3.6: "m/s taken for km/h",
    2.237: "mph taken for m/s",
    1 / 2.237: "m/s taken for mph",
    1.609: "km/h taken for mph",
    1 / 1.609: "mph taken for km/h",
    57.3: "degrees taken for radians",
    1 / 57.3: "radians taken for degrees",
    100.0: "cm taken for m",
    0.01: "m taken for cm",
    1000.0: "mm taken for m",
    0.001: "m taken for mm",
}


def tells(one: Fit) -> bool:
    """Whether there was movement enough for the fit to say anything."""
    return one.pairs >= MIN_PAIRS and one.spread >= MIN_SPREAD and one.correlation is not None


def wrong_factor(one: Fit) -> float | None:
    """The factor between the two, if it is not 1.

    With noise in both, the true factor lies between the two regressions: `slope` (all noise in
    what changed) and slope / correlation^2 (all noise in what was said).
    """
    assert one.slope is not None
    assert one.correlation is not None
    low, high = one.slope, one.slope / one.correlation**2
    if 0.8 * low <= 1.0 <= 1.25 * high:
        return None
    return one.slope / abs(one.correlation)


def unit_hint(factor: float, one: Fit) -> str:
    """What is said is `factor` times what it should be (or the other too small by it)."""
    sure = one.correlation is not None and one.correlation > 0.9
    for known, reason in FACTORS.items():
        if sure and abs(factor / known - 1.0) < 0.12:
            return f": {reason}? Look at its unit, and at that of the position"
    return ": scale or unit of one of them is wrong"
