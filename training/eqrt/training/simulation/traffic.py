"""One run of SUMO, in this process, and everything that drove in it.

Only one simulation can run in a process. SUMO and its libraries print as they like, so a run is
best made in a process of its own with the standard streams put away (`simulation.run`).
"""

from __future__ import annotations

import os
import tempfile
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import LogError
from eqrt.training.simulation.bends import bend_speeds
from eqrt.training.simulation.drivers import STEP_S, driver_of
from eqrt.training.simulation.motion import Complex, Float64, plausible_motion
from eqrt.training.simulation.scenario import Scenario

LATERAL_RESOLUTION_M = 0.4
"""SUMO's sublanes: vehicles move sideways in these parts, and pass each other within a lane."""
BEND_MPS2 = 2.8
"""Sideways in bends for a driver who keeps to the limits; speed factors spread it."""
_DEPART_SPREAD_S = 60.0
_RIM_STEPS = 10
"""At both ends of what SUMO says of a vehicle smoothing has to guess; that much is left out."""
_JUMP_M = 2.0
"""More than speed explains: SUMO has moved (teleported) a stuck vehicle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """What differs from run to run."""

    seed: int
    begin_s: float
    """Time of day in the scenario when the run starts."""
    warmup_s: float
    """Until the network has filled and recording begins."""
    scale: float
    """Of the scenario's demand."""
    speed_factor: float
    """Of the speed limits, the drivers' average."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """Everything that drove. Axes: A stretches of vehicles without a gap, S steps of `STEP_S`."""

    names: tuple[str, ...]
    """(A,) SUMO's vehicle ids, with `#2` and so on where a vehicle comes back after a gap."""
    centers: Complex
    """(A, S) of the vehicles, metres, network frame."""
    heading_rad: Float64
    """(A, S)"""
    present: NDArray[np.bool_]
    """(A, S)"""
    length_m: Float64
    """(A,)"""
    width_m: Float64
    """(A,)"""
    is_car: NDArray[np.bool_]
    """(A,) not a bus, truck, or something lighter than a car."""


def drive(scenario: Scenario, demand: Demand, num_steps: int) -> Traffic:
    """Run `scenario` and return `num_steps` steps of it after the warm-up.

    Raises LogError with SUMO's own words if it refuses the scenario or fails, ModuleNotFoundError
    if `libsumo` is not installed.
    """
    os.environ.setdefault("LIBSUMO_AS_TRACI", "quiet")  # it warns of pyarrow, which it never uses
    import libsumo  # noqa: PLC0415  # takes half a second and touches the environment

    with tempfile.TemporaryDirectory(prefix="eqrt-sumo-") as scratch:
        said = Path(scratch, "errors.txt")
        try:
            libsumo.start(_command_line(scenario.write_quiet(Path(scratch)), demand, said))
            _slow_down_for_bends(libsumo, scenario.net)
            return _record(libsumo, demand, num_steps)
        except libsumo.TraCIException as error:
            raise LogError(f"{scenario.name}: SUMO stopped: {_reason(said, error)}") from error
        finally:
            libsumo.close()


def _command_line(config: Path, demand: Demand, errors: Path) -> list[str]:
    options: dict[str, Any] = {
        "--configuration-file": config,
        "--step-length": STEP_S,
        "--lateral-resolution": LATERAL_RESOLUTION_M,
        "--seed": demand.seed,
        "--begin": demand.begin_s,
        "--scale": demand.scale,
        "--random-depart-offset": _DEPART_SPREAD_S,
        "--default.departspeed": "desired",  # at the map's rim they come driving, not from standing
        "--error-log": errors,
        "--no-warnings": "true",
        "--no-step-log": "true",
        "--duration-log.disable": "true",
    }
    return ["sumo", *(str(part) for option in options.items() for part in option)]


def _reason(errors: Path, error: Exception) -> str:
    """SUMO's first error in one line."""
    text = errors.read_text(errors="replace") if errors.exists() else ""
    lines = [line.removeprefix("Error: ").strip() for line in text.splitlines()]
    return next((line for line in lines if line), " ".join(str(error).split()))


def _slow_down_for_bends(libsumo: Any, net: Path) -> None:
    for lane, speed_mps in bend_speeds(net, BEND_MPS2).items():
        libsumo.lane.setMaxSpeed(lane, speed_mps)


def _record(libsumo: Any, demand: Demand, num_steps: int) -> Traffic:
    log = _Log()
    all_steps = num_steps + 2 * _RIM_STEPS
    for step in range(-round(demand.warmup_s / STEP_S), all_steps):
        libsumo.simulationStep()
        for name in libsumo.simulation.getDepartedIDList():
            driver = driver_of(libsumo.vehicle, name, demand.seed, demand.speed_factor)
            driver.take_seat(libsumo.vehicle, name)
        if step >= 0:
            log.append(libsumo.vehicle, step)
    return _traffic(log, all_steps)


class _Log:
    """What SUMO says of every vehicle at every step, as flat columns."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self.sizes: list[tuple[float, float, bool]] = []
        """Length, width, is a car: by a vehicle's number."""
        self._who, self._step = array("l"), array("l")
        self._place = array("d")

    def append(self, vehicles: Any, step: int) -> None:
        """All vehicles on the road now."""
        for name in vehicles.getIDList():
            number = self._numbers.setdefault(name, len(self._numbers))
            if number == len(self.sizes):
                is_car = vehicles.getVehicleClass(name) not in _NOT_CARS
                self.sizes.append((vehicles.getLength(name), vehicles.getWidth(name), is_car))
            self._who.append(number)
            self._step.append(step)
            x, y = vehicles.getPosition(name)
            self._place.extend((x, y, vehicles.getAngle(name), vehicles.getSpeed(name)))

    @property
    def names(self) -> list[str]:
        """SUMO's ids by a vehicle's number."""
        return list(self._numbers)

    def rows(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Float64]:
        """Vehicle after vehicle in time: number (R,), step (R,), x, y, degrees, m/s (R, 4)."""
        order = np.lexsort((self._step, self._who))
        who, step = np.array(self._who, np.intp)[order], np.array(self._step, np.intp)[order]
        return who, step, np.array(self._place, np.float64).reshape(-1, 4)[order]


def _traffic(log: _Log, all_steps: int) -> Traffic:
    """The stretches of driving without a gap or jump, less their rims."""
    who, step, place = log.rows()
    front = place[:, 0] + 1j * place[:, 1]
    far = np.abs(np.diff(front)) > place[1:, 3] * STEP_S + _JUMP_M
    apart = np.flatnonzero((np.diff(who) != 0) | (np.diff(step) != 1) | far)
    starts, ends = np.concatenate([[0], 1 + apart]), np.concatenate([1 + apart, [len(who)]])
    long_enough = ends - starts > 2 * _RIM_STEPS
    starts, ends = starts[long_enough], ends[long_enough]
    lives = np.stack([step[starts], step[ends - 1] + 1], axis=-1)  # (A, 2)
    fronts = np.zeros((len(starts), all_steps), np.complex128)
    for row, (start, end) in enumerate(zip(starts, ends, strict=True)):
        fronts[row, slice(*lives[row])] = front[start:end]
    sizes = np.array(log.sizes, np.float64).reshape(-1, 3)[who[starts]]
    first_heading = np.radians(90.0 - place[starts, 2])  # from north clockwise to from east
    centers, heading = plausible_motion(fronts, first_heading, sizes[:, 0], lives)
    steps = np.arange(all_steps)
    present = (steps >= lives[:, :1] + _RIM_STEPS) & (steps < lives[:, 1:] - _RIM_STEPS)
    inner = slice(_RIM_STEPS, all_steps - _RIM_STEPS)
    names = log.names
    return Traffic(
        names=_unique([names[number] for number in who[starts]]),
        centers=centers[:, inner],
        heading_rad=heading[:, inner],
        present=present[:, inner],
        length_m=sizes[:, 0],
        width_m=sizes[:, 1],
        is_car=sizes[:, 2] > 0.0,
    )


_NOT_CARS = {"bus", "coach", "truck", "trailer", "bicycle", "moped", "motorcycle", "pedestrian"}


def _unique(names: list[str]) -> tuple[str, ...]:
    """The names, with a number where one comes again."""
    count: dict[str, int] = {}
    unique = []
    for name in names:
        count[name] = count.get(name, 0) + 1
        unique.append(name if count[name] == 1 else f"{name}#{count[name]}")
    return tuple(unique)
