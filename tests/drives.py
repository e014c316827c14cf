"""Input for the whole pipeline: the recordings cut to some seconds, and traffic made by hand."""

from __future__ import annotations

import gzip
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import can
import numpy as np

from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.detections import Detections, ObjectClass, VelocityKind
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from source_tree import ROOT

DEMO = ROOT / "runtime/eqrt/runtime/demo/data"
TILE = DEMO / "ngsim.tile"


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """A recording, and how `eqrt` is told to read it."""

    log: Path
    profile: str
    tile: Path | None = None
    roles: dict[str, str]
    """Bus of the profile -> channel in the log."""

    @property
    def options(self) -> list[str]:
        """Of `eqrt serve` and `eqrt replay`."""
        tile = ["--tile", str(self.tile)] if self.tile else []
        return ["--profile", self.profile, *tile]


DRIVES = {
    "ars408": Drive(
        log=ROOT / "tests/data/can/ars408/candump.log.gz",
        profile="ars408",
        roles={"radar": "can0"},
    ),
    "ngsim": Drive(log=DEMO / "ngsim.log.gz", profile="generic", tile=TILE, roles={"car": "can0"}),
    "rav4": Drive(
        log=ROOT / "tests/data/can/rav4/candump.log.gz",
        profile="toyota-rav4",
        roles={"radar": "can1", "car": "can0"},
    ),
}


def first_seconds(log: Path, seconds: float) -> str:
    """The lines of a gzip'd candump log before its first stamp plus `seconds`."""
    lines: list[str] = []
    with gzip.open(log, "rt") as stream:
        for line in stream:
            lines.append(line)
            if _stamp_s(line) >= _stamp_s(lines[0]) + seconds:
                break
    return "".join(lines[:-1])


def _stamp_s(line: str) -> float:
    return float(line[1 : line.index(")")])


@cache
def shipped_predictor() -> Predictor:
    """The model that comes with eqrt."""
    return Predictor.load(DEFAULT_ARTIFACT)


@dataclass(frozen=True, slots=True, kw_only=True)
class Car:
    """Drives straight on at constant speed; the ego vehicle stands at the map's origin."""

    object_id: int
    x_m: float
    """At time 0."""
    y_m: float
    speed_mps: float = 10.0
    """Along x."""


def object_list(cars: Sequence[Car], time_s: float) -> Detections:
    """What a sensor at the origin sees of them."""
    count = len(cars)
    return Detections(
        sensor="generic",
        timestamp_s=time_s,
        received_s=time_s,
        complete=True,
        object_id=np.array([car.object_id for car in cars], np.int64),
        is_new=np.zeros(count, np.bool_),
        position=np.array([(car.x_m + car.speed_mps * time_s, car.y_m) for car in cars]).reshape(
            -1, 2
        ),
        velocity=np.array([(car.speed_mps, 0.0) for car in cars]).reshape(-1, 2),
        velocity_kind=VelocityKind.ABSOLUTE,
        heading_rad=np.zeros(count),
        length_m=np.full(count, 4.5),
        width_m=np.full(count, 1.8),
        object_class=np.full(count, ObjectClass.CAR, np.uint8),
        existence=np.ones(count),
    )


def cycle(
    cars: Sequence[Car], time_s: float, *, start_s: float = 0.0, pose: Pose2 | None = None
) -> list[can.Message]:
    """The generic object list at `time_s`, stamped that long after `start_s`."""
    return encode_cycle(
        object_list(cars, time_s),
        timestamp_s=start_s + time_s,
        counter=round(10 * time_s),
        speed_mps=0.0,
        yaw_rate_rad_s=0.0,
        map_from_ego=pose,
    )


def traffic(
    cars: Sequence[Car], seconds: float, *, start_s: float = 0.0, pose: Pose2 | None = None
) -> Iterator[can.Message]:
    """Their object lists, ten a second, the one at the end included."""
    for step in range(round(10 * seconds) + 1):
        yield from cycle(cars, step / 10, start_s=start_s, pose=pose)
