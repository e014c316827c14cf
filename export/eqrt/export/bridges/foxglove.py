"""A recording as Foxglove's own messages: an MCAP that its 3D, Plot and Log panels show at once.

Schemas are those that Foxglove publishes, as protobuf; numbers to plot and the service's status are
JSON, which PlotJuggler reads as well. Frames: `map` (`odom` while no map pose is known), and `ego`
in it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import IO, Any

import msgspec
import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.duration_pb2 import Duration
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer
from numpy.typing import NDArray

from eqrt.core.lanes import LaneMap
from eqrt.core.tile import decode
from eqrt.export.bridges.moments import EGO, HEIGHT_M, MAP, Moment, moments, sizes, world_frame
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.recording.json_schemas import json_schema
from eqrt.runtime.recording.reader import Recording
from eqrt.runtime.recording.topics import TILE_FILE
from eqrt.runtime.status_book import status_line
from eqrt.runtime.view.updates import course_rad, ego_pose

_SHOWN_S = 0.5  # where cycles stop coming, what they said disappears
_PROTOBUF: dict[str, Any] = {
    "/scene": SceneUpdate,
    "/lanes": SceneUpdate,
    "/tf": FrameTransform,
    "/log": Log,
}
Rgb = tuple[float, float, float]
_GREY, _BLUE, _ORANGE = (0.55, 0.55, 0.55), (0.20, 0.55, 0.95), (0.95, 0.55, 0.10)
_USUAL = (Mode.RUN, Mode.NO_MAP, Mode.PARTIAL)


class Cycle(msgspec.Struct, frozen=True, kw_only=True):
    """The numbers of one cycle, flat, on `/cycle`."""

    mode: int
    objects: int
    fallbacks: int
    compute_ms: float
    oldest_ms: float
    """The age of the oldest target."""
    ego_x: float | None
    """None = not known, here and below."""
    ego_y: float | None
    ego_yaw: float | None
    ego_speed: float | None


def write_foxglove(recordings: Iterable[Recording], out: IO[bytes]) -> int:
    """Write them all into one file; returns how many cycles there were."""
    writer = Writer(out)
    writer.start("", "eqrt")
    channels = {topic: _protobuf_channel(writer, topic) for topic in _PROTOBUF}
    channels["/cycle"] = _json_channel(writer, "/cycle", "eqrt.Cycle", Cycle)
    channels["/status"] = _json_channel(writer, "/status", "eqrt.Status", ServiceStatus)
    cycles, attached = 0, None
    for recording in recordings:
        for moment in moments(recording):

            def put(topic: str, content: bytes, moment: Moment = moment) -> None:
                writer.add_message(channels[topic], moment.log_ns, content, moment.log_ns)

            if moment.attached is not attached:
                attached = moment.attached
                put("/lanes", _lanes(moment).SerializeToString())
            if isinstance(moment.entry, ForecastSet):
                cycles += 1
                _put_cycle(put, moment, moment.entry)
            else:
                put("/status", msgspec.json.encode(moment.entry))
                put("/log", _log(moment, moment.entry).SerializeToString())
    writer.finish()
    return cycles


def _put_cycle(put: Any, moment: Moment, forecasts: ForecastSet) -> None:
    measured = _timestamp(moment.wall_ns(forecasts.moment_s))
    put("/cycle", msgspec.json.encode(_cycle(forecasts)))
    pose = ego_pose(forecasts)
    if pose is not None:
        x_m, y_m, yaw_rad = pose
        transform = FrameTransform(
            timestamp=measured,
            parent_frame_id=world_frame(forecasts),
            child_frame_id=EGO,
            translation=Vector3(x=x_m, y=y_m),
            rotation=_turned(yaw_rad),
        )
        put("/tf", transform.SerializeToString())
    put("/scene", _scene(measured, forecasts).SerializeToString())


def _cycle(forecasts: ForecastSet) -> Cycle:
    x_m, y_m, yaw_rad = ego_pose(forecasts) or (None, None, None)
    return Cycle(
        mode=int(forecasts.mode),
        objects=forecasts.num_targets,
        fallbacks=int(np.count_nonzero(forecasts.agent_mode == Mode.FALLBACK)),
        compute_ms=1e3 * forecasts.compute_s,
        oldest_ms=1e3 * float(forecasts.age_s.max(initial=0.0)),
        ego_x=x_m,
        ego_y=y_m,
        ego_yaw=yaw_rad,
        ego_speed=forecasts.ego_speed_mps if math.isfinite(forecasts.ego_speed_mps) else None,
    )


def _scene(measured: Timestamp, forecasts: ForecastSet) -> SceneUpdate:
    """Everybody who is predicted now, and nobody who was before."""
    heading, size = course_rad(forecasts), sizes(forecasts)
    return SceneUpdate(
        deletions=[SceneEntityDeletion(timestamp=measured, type=SceneEntityDeletion.ALL)],
        entities=[
            _entity(measured, forecasts, row, float(heading[row]), size[row])
            for row in range(forecasts.num_targets)
        ],
    )


def _entity(
    measured: Timestamp,
    forecasts: ForecastSet,
    row: int,
    heading_rad: float,
    size: NDArray[np.float64],
) -> SceneEntity:
    """One target: a box, its past, every mode as strong as it is probable, its numbers; a cylinder
    where `heading_rad` is NaN.
    """
    x, y = forecasts.position[row].tolist()
    colour = _ORANGE if forecasts.agent_mode[row] == Mode.FALLBACK else _BLUE
    seen = forecasts.history[row][forecasts.history_valid[row]]
    modes = zip(forecasts.trajectories[row], forecasts.probabilities[row].tolist(), strict=True)
    start = forecasts.position[row][None]
    boxes, cylinders = _body(Vector3(x=x, y=y, z=HEIGHT_M / 2), heading_rad, size, colour)
    label = TextPrimitive(
        pose=Pose(position=Vector3(x=x, y=y, z=HEIGHT_M + 1.0)),
        billboard=True,
        font_size=12.0,
        scale_invariant=True,
        color=_color((1.0, 1.0, 1.0), 1.0),
        text=f"{forecasts.track_id[row]}",
    )
    paths = [
        _line(np.concatenate([start, steps]), _color(colour, 0.15 + 0.85 * probability), 0.3)
        for steps, probability in modes
    ]
    return SceneEntity(
        timestamp=measured,
        frame_id=world_frame(forecasts),
        id=f"track {forecasts.track_id[row]}",
        lifetime=Duration(nanos=round(_SHOWN_S * 1e9)),
        cubes=boxes,
        cylinders=cylinders,
        lines=[_line(seen, _color(_GREY, 0.8), 0.15), *paths],
        texts=[label],
    )


def _body(
    place: Vector3, heading_rad: float, size: NDArray[np.float64], colour: Rgb
) -> tuple[list[CubePrimitive], list[CylinderPrimitive]]:
    """A box that is turned, or a cylinder as wide as it where no heading is known (NaN)."""
    length_m, width_m = size.tolist()
    color = _color(colour, 0.6)
    if math.isnan(heading_rad):
        pose = Pose(position=place, orientation=_turned(0.0))
        extent = Vector3(x=width_m, y=width_m, z=HEIGHT_M)
        upright = CylinderPrimitive(
            pose=pose, size=extent, bottom_scale=1.0, top_scale=1.0, color=color
        )
        return [], [upright]
    pose = Pose(position=place, orientation=_turned(heading_rad))
    extent = Vector3(x=length_m, y=width_m, z=HEIGHT_M)
    return [CubePrimitive(pose=pose, size=extent, color=color)], []


def _lanes(moment: Moment) -> SceneUpdate:
    """Those of the tile that predicts from now on, and none of another one."""
    now = _timestamp(moment.log_ns)
    update = SceneUpdate(
        deletions=[SceneEntityDeletion(timestamp=now, type=SceneEntityDeletion.ALL)]
    )
    content = moment.attached.get(TILE_FILE)
    if content is None:
        return update
    lane_map: LaneMap = decode(content, TILE_FILE)[0]
    lines = [
        _line(lane_map.lane_points(lane).astype(np.float64), _color(_GREY, 0.5), 0.1)
        for lane in range(lane_map.num_lanes)
    ]
    update.entities.append(SceneEntity(timestamp=now, frame_id=MAP, id="lanes", lines=lines))
    return update


def _line(points: NDArray[np.float64], color: Color, width_m: float) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        thickness=width_m,
        points=[Point3(x=x, y=y) for x, y in points.tolist()],
        color=color,
    )


def _log(moment: Moment, status: ServiceStatus) -> Log:
    level = Log.INFO if status.mode in _USUAL else Log.WARNING
    return Log(
        timestamp=_timestamp(moment.log_ns), level=level, message=status_line(status), name="eqrt"
    )


def _color(rgb: Rgb, alpha: float) -> Color:
    return Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def _turned(yaw_rad: float) -> Quaternion:
    """About the vertical."""
    return Quaternion(z=math.sin(yaw_rad / 2.0), w=math.cos(yaw_rad / 2.0))


def _timestamp(wall_ns: int) -> Timestamp:
    return Timestamp(seconds=wall_ns // 10**9, nanos=wall_ns % 10**9)


def _protobuf_channel(writer: Writer, topic: str) -> int:
    descriptor = _PROTOBUF[topic].DESCRIPTOR
    files = FileDescriptorSet()
    _add_file(files, descriptor.file, set())
    schema = writer.register_schema(descriptor.full_name, "protobuf", files.SerializeToString())
    return writer.register_channel(topic, "protobuf", schema)


def _add_file(files: FileDescriptorSet, file: FileDescriptor, known: set[str]) -> None:
    """A file after all that it imports, as readers want them."""
    if file.name in known:
        return
    known.add(file.name)
    for imported in file.dependencies:
        _add_file(files, imported, known)
    file.CopyToProto(files.file.add())


def _json_channel(writer: Writer, topic: str, name: str, kind: type) -> int:
    schema = writer.register_schema(name, "jsonschema", json_schema(kind))
    return writer.register_channel(topic, "json", schema)
