"""Drivers that differ, and are imperfect: what every simulated vehicle gets when it sets off.

A scenario's own vehicle types are few and alike: everybody wants the speed limit exactly, brakes
at the same 4.5 m/s2 and sits in the middle of the lane. What a predictor must learn is the spread.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

STEP_S = 0.1
_BIG = {"bus", "coach", "truck", "trailer", "delivery"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Driver:
    """One driver and car."""

    speed_factor: float
    """Of the speed limit, when nothing is in the way."""
    imperfection: float
    """SUMO's sigma: how unsteadily a speed is held."""
    reaction_s: float
    """Between decisions, a multiple of `STEP_S`."""
    headway_s: float
    """Time gap to the car in front; never below the reaction."""
    accel_mps2: float
    decel_mps2: float
    """Braking when there is time."""
    min_gap_m: float
    """Kept when standing."""
    aside_m: float
    """Where in the lane: left of its middle."""
    wander_m: float
    """How unsteadily that is held (lcSigma)."""
    sideways_mps: float
    """The fastest sideways, at speed."""
    speed_gain: float
    """Eagerness to change lanes for speed."""
    assertive: float
    """Acceptance of small gaps when changing."""
    cooperative: float
    """Readiness to let others in."""
    keep_right: float
    length_scale: float
    """Of the vehicle type's length."""

    @classmethod
    def draw(cls, rng: np.random.Generator, speed_factor: float, *, big: bool) -> Self:
        """A driver among those who drive at `speed_factor` of the limit on average."""
        reaction_s = STEP_S * int(rng.integers(2, 9))
        return cls(
            speed_factor=float(np.clip(rng.normal(speed_factor, 0.13), 0.6, 1.6)),
            imperfection=float(rng.uniform(0.1, 0.7)),
            reaction_s=reaction_s,
            headway_s=max(reaction_s, float(np.clip(rng.normal(1.3, 0.3), 0.7, 2.2))),
            accel_mps2=float(np.clip(rng.normal(1.3 if big else 2.1, 0.4), 0.8, 3.2)),
            decel_mps2=float(np.clip(rng.normal(2.8, 0.6), 1.8, 4.5)),
            min_gap_m=float(np.clip(rng.normal(2.0, 0.6), 0.8, 4.0)),
            aside_m=float(np.clip(rng.normal(0.0, 0.05 if big else 0.2), -0.5, 0.5)),
            wander_m=float(rng.uniform(0.0, 0.25)),
            sideways_mps=float(rng.uniform(0.6, 1.5)),
            speed_gain=float(rng.lognormal(0.3, 0.7)),
            assertive=float(rng.uniform(1.0, 1.6)),
            cooperative=float(rng.uniform(0.4, 1.0)),
            keep_right=float(rng.uniform(0.0, 1.0)),
            length_scale=1.0 if big else float(np.clip(rng.normal(0.97, 0.08), 0.8, 1.15)),
        )

    def take_seat(self, vehicles: Any, name: str) -> None:
        """Give these habits to the vehicle `name` (`vehicles` is `libsumo.vehicle`)."""
        vehicles.setSpeedFactor(name, self.speed_factor)
        vehicles.setImperfection(name, self.imperfection)
        vehicles.setActionStepLength(name, self.reaction_s)
        vehicles.setTau(name, self.headway_s)
        vehicles.setAccel(name, self.accel_mps2)
        vehicles.setDecel(name, self.decel_mps2)
        vehicles.setMinGap(name, self.min_gap_m)
        vehicles.setLateralAlignment(name, f"{self.aside_m:.2f}")
        vehicles.setMaxSpeedLat(name, self.sideways_mps)
        vehicles.setLength(name, self.length_scale * vehicles.getLength(name))
        for parameter, value in (
            ("lcSigma", self.wander_m),
            ("lcSpeedGain", self.speed_gain),
            ("lcAssertive", self.assertive),
            ("lcCooperative", self.cooperative),
            ("lcKeepRight", self.keep_right),
            ("lcMaxSpeedLatStanding", 0.0),  # a standing car does not slide sideways
            ("lcMaxSpeedLatFactor", 0.15),  # about 9 degrees to the lane at most
        ):
            vehicles.setParameter(name, f"laneChangeModel.{parameter}", f"{value:.3f}")


def driver_of(vehicles: Any, name: str, seed: int, speed_factor: float) -> Driver:
    """The driver of the vehicle `name`: the same for a seed, whoever else is on the road."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return Driver.draw(rng, speed_factor, big=vehicles.getVehicleClass(name) in _BIG)
