"""`eqrt serve` on a real SocketCAN bus, on which a recorded radar is played, read by others."""

from __future__ import annotations

import gzip
from collections import defaultdict
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import can
import numpy as np
import pytest
from cantools.database.can import Database

from eqrt.runtime.output.forecasts import Mode
from socketcan.machine import Completed
from socketcan.vcan import Launcher, program
from source_tree import ROOT

LOG = ROOT / "tests/data/can/ars408/candump.log.gz"
DBC = ROOT / "runtime/eqrt/runtime/output/eqrt.dbc"
NUM_CYCLES = 80
"""Of the recording, 5.8 s: the parked car's radar sees one object first, then up to four."""
RESOLUTION_M = 0.02  # of positions in eqrt.dbc
RADAR_HEADER, RADAR_OBJECT = 0x60A, 0x60B

Fields = dict[str, float]


@dataclass
class Cycle:
    """What candump heard of one prediction cycle, decoded with the DBC that is published."""

    status: Fields
    trajectories: list[Fields]
    measured: dict[int, list[tuple[float, float]]]
    """Object id -> where the radar had seen it by then, metres ahead and to the left of itself."""


@pytest.fixture(scope="module")
def service(launcher: Launcher, tmp_path_factory: pytest.TempPathFactory) -> tuple[Completed, Path]:
    """What the service said, and the log of all that was on the bus."""
    work = tmp_path_factory.mktemp("serve")
    (work / "part.log").write_text("".join(first_cycles(NUM_CYCLES)))
    done = launcher(program("serve_and_play.py", "part.log", 1, "heard.log"), work, 120.0)
    assert done.status == 0, done.stderr
    return done, work / "heard.log"


@pytest.fixture(scope="module")
def cycles(service: tuple[Completed, Path]) -> list[Cycle]:
    """What was on the bus, cycle by cycle."""
    database = Database()
    database.add_dbc_file(str(DBC))
    names = {message.frame_id: message.name for message in database.messages}
    measured: dict[int, list[tuple[float, float]]] = defaultdict(list)
    heard: list[Cycle] = []
    for message in can.LogReader(service[1]):
        number, data = message.arbitration_id, bytes(message.data)
        if number == RADAR_OBJECT:
            measured[data[0]].append(radar_position(data))
        elif number in names:
            decoded = database.decode_message(number, data, decode_choices=False)
            assert isinstance(decoded, dict)
            fields = {name: float(str(value)) for name, value in decoded.items()}
            if names[number] == "EQRT_Status":
                heard.append(Cycle(fields, [], deepcopy(measured)))
            else:
                heard[-1].trajectories.append(fields)
    return heard


def first_cycles(count: int) -> list[str]:
    """The lines of the recording before the header of cycle `count`."""
    lines: list[str] = []
    with gzip.open(LOG, "rt") as log:
        for line in log:
            count -= f" {RADAR_HEADER:X}#" in line
            if count < 0:
                break
            lines.append(line)
    return lines


def radar_position(data: bytes) -> tuple[float, float]:
    """ARS408, 0x60B: after the id 13 bits ahead, then 11 bits to the left, in steps of 0.2 m."""
    bits = int.from_bytes(data[1:4], "big")
    return 0.2 * (bits >> 11) - 500.0, 0.2 * (bits & 0x7FF) - 204.6


def test_every_cycle_of_the_radar_is_predicted_on_the_bus(cycles: list[Cycle]) -> None:
    """Then the radar falls silent, and three periods later the service says so."""
    modes = [Mode(int(cycle.status["Mode"])) for cycle in cycles]
    assert modes[-1] is Mode.SILENT
    # Cycles that a busy machine brings closer together than 60 ms share one prediction.
    assert NUM_CYCLES / 2 <= sum(mode is not Mode.SILENT for mode in modes) <= NUM_CYCLES
    assert Mode.RUN not in modes  # there is no map here


def test_every_object_has_its_trajectories(cycles: list[Cycle]) -> None:
    """As many as its cycle's status announces, and no message is lost."""
    for cycle in cycles:
        announced = cycle.status["NumObjects"] * cycle.status["NumModes"]
        assert len(cycle.trajectories) == announced
        assert {fields["Cycle"] for fields in cycle.trajectories} <= {cycle.status["Cycle"]}
    assert max(cycle.status["NumObjects"] for cycle in cycles) >= 3
    for before, after in pairwise(cycles):
        for counter in ("AliveCounter", "Cycle"):
            assert after.status[counter] == (before.status[counter] + 1) % 256


def test_predictions_start_where_the_radar_has_seen_the_objects(cycles: list[Cycle]) -> None:
    """By its own ids and bytes; the profile puts the radar at the parked car's reference point."""
    trajectories = 0
    for cycle in cycles:
        for fields in cycle.trajectories:
            seen = np.array(cycle.measured[int(fields["ObjectId"])])
            start = np.array([fields["PositionX"], fields["PositionY"]])
            assert np.abs(seen - start).max(axis=1).min() <= RESOLUTION_M
            trajectories += 1
    assert trajectories > NUM_CYCLES


def test_points_are_known_for_the_whole_horizon(cycles: list[Cycle]) -> None:
    """Ten points, each possible: below 60 m/s from the one before."""
    for cycle in cycles:
        for fields in cycle.trajectories:
            xs, ys = ([fields[f"{axis}{i}"] for i in range(1, 11)] for axis in "XY")
            steps = np.hypot(np.diff(xs), np.diff(ys))
            assert np.all(steps < 60.0 * 1e-3 * cycle.status["PointStep"])


def test_the_service_ends_cleanly_and_has_counted(service: tuple[Completed, Path]) -> None:
    done, _ = service
    assert f" {NUM_CYCLES} cycles, " in done.stdout.strip().splitlines()[-1]
    assert done.stderr == ""
