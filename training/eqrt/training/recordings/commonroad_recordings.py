"""CommonRoad scenarios as recordings: one file each, with the lanelets under it.

Scenarios that were cut from one stretch of time show the same vehicles under different names. Those
of one map number stay in one group, and so do the numbers of NGSIM's US-101 that are known to
overlap: found by comparing the recorded speeds of all vehicles, 15 steps at a time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eqrt.core.errors import LogError
from eqrt.training.recordings.commonroad import Scenario, lane_map, read_scenario
from eqrt.training.recordings.recording import Part, Recording, Source, TrackGrid

NGSIM = Source(
    name="NGSIM",
    credits="NGSIM trajectories (U.S. DOT FHWA, CC BY-SA), CommonRoad scenarios (TUM, "
    "BSD-3-Clause), lanelets (c) OpenStreetMap contributors (ODbL)",
    license="CC-BY-SA-4.0",
    non_commercial=False,
)
PATTERNS = ("*.xml", "*.xml.gz")
VEHICLES = ("car", "truck", "bus", "motorcycle", "taxi", "priorityVehicle")
MAX_STEPS = 100_000
"""Nearly three hours at 10 Hz; a scenario that says it is longer has a wrong time in it."""
_US101 = "USA_US101"
_US101_OVERLAPS = ((1, 13, 14, 23, 24), (4, 18, 27), (5, 15), (9, 20, 25, 28), (21, 22))


@dataclass(frozen=True, slots=True)
class CommonRoadReader:
    """Reads a folder of scenarios, or one; `source` says whose they are."""

    source: Source = NGSIM

    def parts(self, path: Path) -> Sequence[Part]:
        """The scenario files in the folder `path`, by name, or the one file `path`."""
        if path.is_file():
            return [Part(str(path))]
        files = sorted(file for pattern in PATTERNS for file in path.glob(pattern))
        if not files:
            raise LogError(f"{path}: no CommonRoad scenario ({', '.join(PATTERNS)}) here")
        return [Part(str(file)) for file in files]

    def read(self, part: Part) -> Iterator[Recording]:
        """The one recording of `part`.

        Raises LogError if the file cannot be read, TileError if its lanelets cannot be used.
        """
        scenario = read_scenario(Path(part.path))
        name = scenario_name(Path(part.path))
        kinds = [track.object_type for track in scenario.tracks]
        yield Recording(
            name=name,
            group=group_of(name),
            dt_s=scenario.dt_s,
            tracks=track_grid(scenario, part.path),
            track_ids=tuple(str(track.track_id) for track in scenario.tracks),
            may_be_target=np.array([kind in VEHICLES for kind in kinds], np.bool_),
            focal=np.zeros(len(kinds), np.bool_),
            now_steps=None,
            lanes=lane_map(scenario),
        )


def scenario_name(path: Path) -> str:
    """The name a scenario file goes by: its suffixes dropped."""
    return path.name.removesuffix(".gz").removesuffix(".xml")


def group_of(name: str) -> str:
    """Which scenarios share vehicles with the one called `name` (COUNTRY_MAP-NUMBER_...)."""
    match = re.match(r"(.+)-(\d+)_\d+_[A-Z]-\d+$", name)
    if match is None:
        return name
    road, number = match[1], int(match[2])
    if road == _US101:
        number = next((same[0] for same in _US101_OVERLAPS if number in same), number)
    return f"{road}-{number}"


def track_grid(scenario: Scenario, where: str) -> TrackGrid:
    """Every track spread over the scenario's steps."""
    steps = 1 + max((int(track.step[-1]) for track in scenario.tracks), default=-1)
    if steps > MAX_STEPS or any(track.step[0] < 0 for track in scenario.tracks):
        raise LogError(f"{where}: a time step is not within 0 to {MAX_STEPS}; repair the scenario")
    grid = TrackGrid.empty(len(scenario.tracks), steps)
    for row, track in enumerate(scenario.tracks):
        grid.positions[row, track.step] = track.position
        grid.heading_rad[row, track.step] = track.heading_rad
        grid.valid[row, track.step] = True
    return grid
