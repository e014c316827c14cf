"""Traffic of as many objects as wanted: the demo's recorded drive, filled up with copies.

The recorded cars nearest to the ego car come first; what is missing are copies of them, some metres
aside. So lanes, speeds and gaps are real, and every cycle has the same number of objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import can
import numpy as np

from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.detections import Detections, EgoMotion, EgoPose
from eqrt.runtime.decoding.generic_objects import MAX_OBJECT_ID, encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.demo.command import PARTS

DRIVE = PARTS[0]
PROFILE = "generic"
MESSAGE_S = 0.00025
"""A classic message of eight bytes on a bus of 500 kbit/s."""
_ASIDE_M = 4.0  # between a recorded car and its copy

Cycle = list[can.Message]
"""The messages of one object list and of the ego car's motion and pose, stamped from 0 on."""


def crowded_cycles(objects: int, message_s: float = MESSAGE_S) -> Iterator[Cycle]:
    """The cycles of the drive, ten a second, with so many objects in each (1 to 255)."""
    decoder, ids = Decoder(load_profile(PROFILE)), _Ids()
    motion, pose, counter = None, None, 0
    for message in read_log(DRIVE.log):
        for event in decoder.feed(message, message.timestamp):
            if isinstance(event, EgoMotion):
                motion = event
            elif isinstance(event, EgoPose):
                pose = event
            elif motion and pose and len(event.object_id):
                counter += 1
                yield encode_cycle(
                    _crowded(event, objects, ids),
                    timestamp_s=0.0,
                    counter=counter,
                    speed_mps=motion.speed_mps,
                    yaw_rate_rad_s=motion.yaw_rate_rad_s,
                    map_from_ego=pose.map_from_ego,
                    message_s=message_s,
                )


class _Ids:
    """Numbers for (object id, copy), kept as long as both are there."""

    def __init__(self) -> None:
        self._numbers: dict[tuple[int, int], int] = {}

    def assign(self, keys: list[tuple[int, int]]) -> tuple[list[int], list[bool]]:
        """The numbers, and whether each is new."""
        before = self._numbers
        self._numbers = {key: before[key] for key in keys if key in before}
        used = set(before.values())
        free = (number for number in range(MAX_OBJECT_ID + 1) if number not in used)
        for key in keys:
            if key not in self._numbers:
                self._numbers[key] = next(free)
        return [self._numbers[key] for key in keys], [key not in before for key in keys]


def _crowded(seen: Detections, objects: int, ids: _Ids) -> Detections:
    """Exactly so many objects."""
    near = np.argsort(np.linalg.norm(seen.position, axis=1), kind="stable")
    rows = np.resize(near, objects)
    copy = np.arange(objects) // len(near)
    keys = list(zip(seen.object_id[rows].tolist(), copy.tolist(), strict=True))
    numbers, is_new = ids.assign(keys)
    aside = np.stack([np.zeros(objects), _ASIDE_M * copy], axis=-1)
    return replace(
        seen,
        object_id=np.array(numbers),
        is_new=np.array(is_new),
        position=seen.position[rows] + aside,
        velocity=seen.velocity[rows],
        heading_rad=seen.heading_rad[rows],
        length_m=seen.length_m[rows],
        width_m=seen.width_m[rows],
        object_class=seen.object_class[rows],
        existence=seen.existence[rows],
    )
