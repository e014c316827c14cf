"""`eqrt encode`: turn recorded scenarios into a CAN log and the tile that belongs to it.

One recorded car plays the ego vehicle; what comes within its sensors' range is written with eqrt's
generic object list, as a stack on the road would send it. Several scenarios become one drive, one
after the other, each in its own corner of the map.
"""

from __future__ import annotations

import argparse
import gzip
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import EqrtError, UsageError
from eqrt.core.files import write_whole
from eqrt.core.frames import Pose2, wrap_angle
from eqrt.core.lanes import NO_LANE, LaneMap
from eqrt.core.tile import TileInfo, encode
from eqrt.runtime.decoding.detections import Detections, ObjectClass, VelocityKind
from eqrt.runtime.decoding.generic_objects import MAX_OBJECT_ID, MAX_OBJECTS, encode_cycle
from eqrt.runtime.prediction.tiles import save_tile
from eqrt.training.recordings.commonroad import Scenario, Track, lane_map, read_scenario

APART_M = 3000.0
"""Between the scenarios of one drive: no lane or car of one is near another."""
PAUSE_S = 0.5
"""Between the scenarios, in time."""
MAX_RANGE_M = 327.0
"""X and Y have 16 bits of 0.01 m; farther objects would be written nearer than they are."""
MESSAGE_S = 0.0003
"""A classic message of eight bytes on a bus of 500 kbit/s, and the pause after it."""
_START_S = 1.7e9  # any wall-clock time; the same for the same drive
_LANE_IDS = 10_000_000  # more than any scenario's ids
_CLASSES = {
    "car": ObjectClass.CAR,
    "truck": ObjectClass.TRUCK,
    "bus": ObjectClass.TRUCK,
    "motorcycle": ObjectClass.MOTORCYCLE,
    "bicycle": ObjectClass.BICYCLE,
    "pedestrian": ObjectClass.PEDESTRIAN,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt encode`."""
    parser.add_argument("scenario", type=Path, nargs="+", help="CommonRoad .xml or .xml.gz")
    parser.add_argument("--out", type=Path, required=True, help="candump log, .log or .log.gz")
    parser.add_argument("--tile", type=Path, required=True, help="the tile to write")
    parser.add_argument(
        "--range", type=float, default=120.0, metavar="M", help="of the sensors (default 120 m)"
    )


def run(args: argparse.Namespace) -> int:
    """Write both files and say what is in them."""
    if not args.out.name.endswith((".log", ".log.gz")):
        raise UsageError(f"--out {args.out}: a candump log's name ends in .log or .log.gz")
    if args.out.resolve() == args.tile.resolve():
        raise UsageError(f"--out and --tile are both {args.out}; give the tile a name of its own")
    if not 0.0 < args.range <= MAX_RANGE_M:
        raise UsageError(
            f"--range is {args.range:g}; give metres above 0 to {MAX_RANGE_M:g}, the farthest that "
            "the object list can say"
        )
    scenarios = [
        moved(read_scenario(path), APART_M * index) for index, path in enumerate(args.scenario)
    ]
    messages = list(drive_messages(scenarios, args.range))
    write_candump(args.out, messages)
    info = TileInfo(
        name=args.tile.stem,
        source=" ".join(path.name for path in args.scenario),
        credit="; ".join(dict.fromkeys(scenario.source for scenario in scenarios)),
    )
    save_tile(args.tile, encode(joined([lane_map(scenario) for scenario in scenarios]), info))
    seconds = messages[-1].timestamp - messages[0].timestamp
    print(f"log   {args.out}: {len(messages)} messages, {seconds:.1f} s")
    print(f"tile  {args.tile}: {info.source}")
    return 0


def moved(scenario: Scenario, east_m: float) -> Scenario:
    """The same scenario, `east_m` farther east."""
    shift = np.array([east_m, 0.0])
    return replace(
        scenario,
        tracks=tuple(replace(track, position=track.position + shift) for track in scenario.tracks),
        lanelets=tuple(
            replace(lane, left=lane.left + shift, right=lane.right + shift)
            for lane in scenario.lanelets
        ),
    )


def joined(maps: Sequence[LaneMap]) -> LaneMap:
    """Lane maps side by side as one; lane ids of the second and further ones are renumbered."""
    points = np.cumsum([0] + [len(m.points) for m in maps])
    lanes = np.cumsum([0] + [m.num_lanes for m in maps])
    links = np.cumsum([0] + [len(m.successor) for m in maps])

    def starts(name: str, offsets: NDArray[np.intp]) -> NDArray[np.int32]:
        parts = [getattr(m, name)[:-1] + offsets[i] for i, m in enumerate(maps)]
        return np.concatenate([*parts, offsets[-1:]]).astype(np.int32)

    def indices(name: str) -> NDArray[np.int32]:
        parts = [getattr(m, name) for m in maps]
        moved_parts = [np.where(p == NO_LANE, NO_LANE, p + lanes[i]) for i, p in enumerate(parts)]
        return np.concatenate(moved_parts).astype(np.int32)

    return LaneMap(
        points=np.concatenate([m.points for m in maps]),
        lane_start=starts("lane_start", points),
        lane_id=np.concatenate([m.lane_id + i * _LANE_IDS for i, m in enumerate(maps)]),
        successor_start=starts("successor_start", links),
        successor=indices("successor"),
        left=indices("left"),
        right=indices("right"),
        lane_type=np.concatenate([m.lane_type for m in maps]),
        speed_limit_mps=np.concatenate([m.speed_limit_mps for m in maps]),
    )


def drive_messages(scenarios: Sequence[Scenario], range_m: float) -> Iterator[can.Message]:
    """The messages of all scenarios, one after the other, in the order of the bus."""
    start_s, counter = _START_S, 0
    for scenario in scenarios:
        ego = choose_ego(scenario)
        ids = ObjectIds()
        for index, step in enumerate(ego.step.tolist()):
            time_s = start_s + index * scenario.dt_s
            cycle = encode_cycle(
                seen_from(ego, scenario.tracks, step, range_m, ids),
                timestamp_s=time_s,
                counter=counter,
                speed_mps=float(ego.speed_mps[index]),
                yaw_rate_rad_s=_yaw_rate(ego, index, scenario.dt_s),
                map_from_ego=_pose(ego, index),
                message_s=MESSAGE_S,
                channel="can0",
            )
            counter += 1
            yield from cycle
        start_s += len(ego.step) * scenario.dt_s + PAUSE_S


def choose_ego(scenario: Scenario) -> Track:
    """The car that is seen longest without a gap; of several, the one with the lowest id."""
    whole = [track for track in scenario.tracks if len(track.step) == np.ptp(track.step) + 1]
    if not whole:
        raise EqrtError(f"{scenario.name}: no vehicle without gaps that could play the ego")
    return max(whole, key=lambda track: (len(track.step), -track.track_id))


class ObjectIds:
    """Numbers objects as a sensor does: 0 to 255, the longest unused number first."""

    def __init__(self) -> None:
        self._of_track: dict[int, int] = {}
        self._free = list(range(MAX_OBJECT_ID + 1))

    def assign(self, track_ids: Sequence[int]) -> tuple[list[int], list[bool]]:
        """Object id of every track in this cycle, and whether it is new."""
        for gone in [track for track in self._of_track if track not in track_ids]:
            self._free.append(self._of_track.pop(gone))
        new = [track not in self._of_track for track in track_ids]
        for track, is_new in zip(track_ids, new, strict=True):
            if is_new:
                self._of_track[track] = self._free.pop(0)
        return [self._of_track[track] for track in track_ids], new


def seen_from(
    ego: Track, tracks: Sequence[Track], step: int, range_m: float, ids: ObjectIds
) -> Detections:
    """What the ego's sensors report at a step: everything within range, in the ego frame."""
    pose = _pose(ego, int(np.searchsorted(ego.step, step)))
    seen = [s for track in tracks if track is not ego and (s := _Seen.at(track, step)) is not None]
    seen = [s for s in seen if np.hypot(*(s.position - (pose.x_m, pose.y_m))) <= range_m]
    if len(seen) > MAX_OBJECTS:
        raise EqrtError(
            f"{len(seen)} objects are within {range_m:g} m of the ego, and the object list takes "
            f"{MAX_OBJECTS}; give a smaller --range"
        )
    object_id, is_new = ids.assign([s.track.track_id for s in seen])
    heading = np.array([s.heading_rad for s in seen])
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    speed = np.array([s.speed_mps for s in seen])
    ego_from_map = pose.inverse()
    return Detections(
        sensor="generic",
        timestamp_s=0.0,
        received_s=0.0,
        complete=True,
        object_id=np.array(object_id, np.int64),
        is_new=np.array(is_new, np.bool_),
        position=ego_from_map.apply(np.array([s.position for s in seen]).reshape(-1, 2)),
        velocity=ego_from_map.rotate(speed[:, None] * direction),
        velocity_kind=VelocityKind.ABSOLUTE,
        heading_rad=np.array([wrap_angle(angle - pose.yaw_rad) for angle in heading.tolist()]),
        length_m=np.array([s.track.length_m for s in seen]),
        width_m=np.array([s.track.width_m for s in seen]),
        object_class=np.array(
            [_CLASSES.get(s.track.object_type, ObjectClass.UNKNOWN) for s in seen], np.uint8
        ),
        existence=np.full(len(seen), np.nan),
    )


@dataclass(frozen=True, slots=True)
class _Seen:
    """One track at one step, map frame."""

    track: Track
    position: NDArray[np.float64]
    heading_rad: float
    speed_mps: float

    @classmethod
    def at(cls, track: Track, step: int) -> _Seen | None:
        row = int(np.searchsorted(track.step, step))
        if row == len(track.step) or track.step[row] != step:
            return None
        heading, speed = float(track.heading_rad[row]), float(track.speed_mps[row])
        return cls(track, track.position[row], heading, speed)


def _pose(track: Track, row: int) -> Pose2:
    x, y = track.position[row].tolist()
    return Pose2(x, y, wrap_angle(float(track.heading_rad[row])))


def _yaw_rate(track: Track, row: int, dt_s: float) -> float:
    """From the headings before and after."""
    before, after = max(row - 1, 0), min(row + 1, len(track.step) - 1)
    turned = wrap_angle(float(track.heading_rad[after] - track.heading_rad[before]))
    return turned / (dt_s * max(after - before, 1))


def write_candump(path: Path, messages: Sequence[can.Message]) -> None:
    """A candump log, gzip'd if its name says so; the same messages give the same bytes.

    Raises EqrtError if it cannot be written.
    """
    text = io.StringIO()
    with can.CanutilsLogWriter(text) as writer:
        for message in messages:
            writer.on_message_received(message)
        content = text.getvalue().encode("ascii")
    if path.suffix == ".gz":
        content = gzip.compress(content, mtime=0)
    try:
        write_whole(path, content)
    except OSError as error:
        raise EqrtError(
            f"cannot write {path} ({error.strerror}); give --out a file that can be written"
        ) from error
