"""One run of a scenario, cut into recordings.

The observer is a car of the traffic itself, so that what is recorded has the make-up of what the
predictor will see: tracks that begin and end at the rim of sight, oncoming cars that pass in
seconds, followers that stay, cars hidden in queues. A fixed place would show whole manoeuvres but
always the same ones. Cars that drive and turn are preferred: what a standing one sees mostly stands
too, and most of what is hard to predict happens where one turns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from eqrt.core.lanes import LaneMap
from eqrt.training.recordings.recording import Recording, Source, TrackGrid
from eqrt.training.recordings.recording_file import SUFFIX, save_recording
from eqrt.training.simulation.drivers import STEP_S
from eqrt.training.simulation.scenario import Scenario
from eqrt.training.simulation.sensor import Sensor, Sightings, observe
from eqrt.training.simulation.sumo_lanes import read_sumo_lanes
from eqrt.training.simulation.traffic import Demand, Traffic, drive

OBSERVERS = 3
"""At the same time in one network, far enough apart to see nothing in common."""
_SHORTEST_STEPS = 10  # a track seen for less than a second teaches nothing
_DRIVEN_M = 5.0  # an observer that drives less stands
_STRAIGHT = 0.3  # rad, added to what observers turn: going straight is worth seeing too
_STANDING_MPS = 0.5
_TURNING_RAD_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Everything that one run needs. Plain data: it crosses processes."""

    name: str
    """The recordings' group, and the beginning of their names."""
    scenario: Scenario
    demand: Demand
    recordings: int
    steps: int
    """Of each recording."""
    sensor: Sensor
    source: Source
    folder: str
    """Where the recordings go."""


@dataclass(frozen=True, slots=True)
class Tally:
    """What was recorded, in numbers that add up."""

    recordings: int = 0
    tracks: int = 0
    sightings: int = 0
    """Vehicles seen, summed over steps; the numbers below are among or over them."""
    standing: int = 0
    turning: int = 0
    """Faster than standing, and than 6 degrees per second."""
    driven_m: float = 0.0

    def __add__(self, other: Self) -> Tally:
        return Tally(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def simulate(run: Run) -> Tally:
    """Drive, and write the recordings of one run.

    There are fewer than asked for where no car drives through a whole recording. Raises LogError
    if SUMO fails or a file cannot be written, TileError if the network cannot be used.
    """
    lanes = read_sumo_lanes(run.scenario.net)
    windows = -(-run.recordings // OBSERVERS)
    traffic = drive(run.scenario, run.demand, windows * run.steps)
    rng = np.random.default_rng(run.demand.seed)
    tally = Tally()
    for observer, steps in _views(traffic, run, rng):
        sightings = observe(traffic, observer, steps, run.sensor, rng)
        name = f"{run.name}-{tally.recordings:02d}"
        recording = _recording(name, run.name, traffic, sightings, lanes)
        save_recording(Path(run.folder, name + SUFFIX), recording, run.source)
        tally += _count(traffic, sightings, steps)
    return tally


def _views(traffic: Traffic, run: Run, rng: np.random.Generator) -> Iterator[tuple[int, slice]]:
    """Who looks, and when."""
    views = (
        (observer, slice(start, start + run.steps))
        for start in range(0, traffic.present.shape[1], run.steps)
        for observer in _observers(
            traffic, slice(start, start + run.steps), run.sensor.radius_m, rng
        )
    )
    for _, view in zip(range(run.recordings), views, strict=False):
        yield view


def _observers(
    traffic: Traffic, steps: slice, radius_m: float, rng: np.random.Generator
) -> Iterator[int]:
    """Up to `OBSERVERS` cars present throughout, by chance.

    A car's weight is how far it drives, times how much it turns and a little.
    """
    path = traffic.centers[:, steps]
    usable = traffic.present[:, steps].all(axis=1) & traffic.is_car
    driven_m = np.abs(np.diff(path, axis=1)).sum(axis=1) * usable
    turned_rad = np.abs(np.diff(traffic.heading_rad[:, steps], axis=1)).sum(axis=1)
    weight = np.where(driven_m > _DRIVEN_M, driven_m * (_STRAIGHT + turned_rad), 0.0)
    middle = path[:, path.shape[1] // 2]
    for _ in range(OBSERVERS):
        if not weight.any():
            return
        chosen = int(rng.choice(len(weight), p=weight / weight.sum()))
        yield chosen
        weight = weight * (np.abs(middle - middle[chosen]) > 2.0 * radius_m)


def _recording(
    name: str, group: str, traffic: Traffic, sightings: Sightings, lanes: LaneMap
) -> Recording:
    kept = np.flatnonzero(sightings.seen.sum(axis=1) >= _SHORTEST_STEPS)
    centers = sightings.centers[kept]
    return Recording(
        name=name,
        group=group,
        dt_s=STEP_S,
        tracks=TrackGrid(
            positions=np.stack([centers.real, centers.imag], axis=-1),
            heading_rad=_wrapped(sightings.heading_rad[kept]),
            valid=sightings.seen[kept],
        ),
        track_ids=tuple(traffic.names[row] for row in sightings.rows[kept]),
        may_be_target=np.ones(len(kept), np.bool_),
        focal=np.zeros(len(kept), np.bool_),
        now_steps=None,
        lanes=lanes,
    )


def _wrapped(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    wrapped: NDArray[np.float64] = np.angle(np.exp(1j * angle_rad))
    return wrapped


def _count(traffic: Traffic, sightings: Sightings, steps: slice) -> Tally:
    """By the true motion, and like `_recording` without the shortest tracks."""
    kept = sightings.seen.sum(axis=1) >= _SHORTEST_STEPS
    seen = sightings.seen[kept][:, 1:]
    rows = sightings.rows[kept]
    moved_m = np.abs(np.diff(traffic.centers[rows, steps], axis=1))
    turned_rad = np.abs(np.diff(traffic.heading_rad[rows, steps], axis=1))
    moving = moved_m > _STANDING_MPS * STEP_S
    return Tally(
        recordings=1,
        tracks=int(kept.sum()),
        sightings=int(seen.sum()),
        standing=int((seen & ~moving).sum()),
        turning=int((seen & moving & (turned_rad > _TURNING_RAD_S * STEP_S)).sum()),
        driven_m=float(moved_m[seen].sum()),
    )
