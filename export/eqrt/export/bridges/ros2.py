"""A recording as a ROS 2 bag with Autoware's `PredictedObjects`, without ROS.

The field definitions are those that Autoware publishes (deploy/examples/ros2.md has our fields
beside theirs). One message per cycle, stamped with its newest measurement; an object measured
earlier has its path moved on to that time by interpolation. What we do not know is 0
beside a variance of UNKNOWN_VARIANCE (docs/recording.md); existence and class are given as certain.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from eqrt.export.bridges.moments import HEIGHT_M, Moment, moments, sizes, world_frame
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.recording.reader import Recording
from eqrt.runtime.view.updates import course_rad

TOPIC = "/perception/object_recognition/objects"
"""Where Autoware's planning listens."""
PREDICTED_OBJECTS = "autoware_perception_msgs/msg/PredictedObjects"
_PACKAGE = "autoware_perception_msgs/msg/"
_DEFINITIONS = {
    "ObjectClassification": "uint8 label\nfloat32 probability",
    "Shape": "uint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions",
    "PredictedPath": (
        "geometry_msgs/Pose[] path\nbuiltin_interfaces/Duration time_step\nfloat32 confidence"
    ),
    "PredictedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance initial_pose_with_covariance\n"
        "geometry_msgs/TwistWithCovariance initial_twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance\n"
        "PredictedPath[] predicted_paths"
    ),
    "PredictedObject": (
        "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
        "ObjectClassification[] classification\nPredictedObjectKinematics kinematics\nShape shape"
    ),
    "PredictedObjects": "std_msgs/Header header\nPredictedObject[] objects",
}
_LABELS: dict[int, int] = {  # Autoware's numbers
    ObjectClass.UNKNOWN: 0,
    ObjectClass.CAR: 1,
    ObjectClass.TRUCK: 2,
    ObjectClass.MOTORCYCLE: 5,
    ObjectClass.BICYCLE: 6,
    ObjectClass.PEDESTRIAN: 7,
    ObjectClass.ANIMAL: 8,
    ObjectClass.STATIC: 0,
}
UNKNOWN_VARIANCE = 10_000.0
"""What Autoware's own drivers put beside a number that they did not measure. All zeros mean that
the covariance is not known (sensor_msgs/Imu), and so the number beside it is."""
_UNKNOWN = (UNKNOWN_VARIANCE * np.eye(6)).ravel()
_YAW = 35  # of the 6 x 6 of a pose: x, y, z, roll, pitch, yaw
_BOUNDING_BOX = 0
_STANDS_M = 0.05  # between two steps, less tells no direction


def autoware_types() -> Typestore:
    """ROS 2's own messages, and Autoware's."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, _PACKAGE + name))
    return store


def write_rosbag2(recordings: Iterable[Recording], folder: Path) -> int:
    """Write them all into one bag, a new folder; returns how many messages there are."""
    store = autoware_types()
    objects = _Objects(store)
    count = 0
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(TOPIC, PREDICTED_OBJECTS, typestore=store)
        for recording in recordings:
            for moment in moments(recording):
                if isinstance(moment.entry, ForecastSet):
                    message = objects.message(moment, moment.entry, recording.identity.run)
                    content = store.serialize_cdr(message, PREDICTED_OBJECTS)
                    writer.write(connection, moment.log_ns, content)
                    count += 1
    return count


class _Objects:
    """Builds messages of the types of one store."""

    def __init__(self, store: Typestore) -> None:
        self._types = store.types

    def _new(self, name: str, *values: Any) -> Any:
        package, _, kind = name.rpartition("/")
        return self._types[f"{package or _PACKAGE.removesuffix('/msg/')}/msg/{kind}"](*values)

    def message(self, moment: Moment, forecasts: ForecastSet, run: str) -> Any:
        """One cycle."""
        wall_ns = moment.wall_ns(forecasts.moment_s)
        stamp = self._new("builtin_interfaces/Time", wall_ns // 10**9, wall_ns % 10**9)
        facing, size = course_rad(forecasts), sizes(forecasts)
        return self._new(
            "PredictedObjects",
            self._new("std_msgs/Header", stamp, world_frame(forecasts)),
            [
                self._object(forecasts, row, float(facing[row]), size[row].tolist(), run)
                for row in range(forecasts.num_targets)
            ],
        )

    def _object(
        self, forecasts: ForecastSet, row: int, course_rad: float, size: list[float], run: str
    ) -> Any:
        label = _LABELS.get(int(forecasts.object_class[row]), 0)  # of a newer eqrt: not known
        uuid = bytes.fromhex(run) + bytes(4) + int(forecasts.track_id[row]).to_bytes(8, "big")
        dimensions = self._new("geometry_msgs/Vector3", *size, HEIGHT_M)
        footprint = self._new("geometry_msgs/Polygon", [])
        return self._new(
            "PredictedObject",
            self._new("unique_identifier_msgs/UUID", np.frombuffer(uuid, np.uint8)),
            1.0,
            [self._new("ObjectClassification", label, 1.0)],
            self._kinematics(forecasts, row, course_rad),
            self._new("Shape", _BOUNDING_BOX, footprint, dimensions),
        )

    def _kinematics(self, forecasts: ForecastSet, row: int, course_rad: float) -> Any:
        """`course_rad`: NaN = not known."""
        paths = [moved_on(forecasts, row, mode) for mode in range(forecasts.trajectories.shape[1])]
        yaw_rad = 0.0 if math.isnan(course_rad) else course_rad
        pose_variance = np.zeros(36)
        pose_variance[_YAW] = UNKNOWN_VARIANCE if math.isnan(course_rad) else 0.0
        step = round(forecasts.dt_s * 1e9)
        pose, zero = self._pose(paths[0][0], yaw_rad), self._vector(0.0, 0.0)
        accel = self._new("geometry_msgs/Accel", zero, zero)
        return self._new(
            "PredictedObjectKinematics",
            self._new("geometry_msgs/PoseWithCovariance", pose, pose_variance),
            self._twist(forecasts.velocity[row], yaw_rad),
            self._new("geometry_msgs/AccelWithCovariance", accel, _UNKNOWN.copy()),
            [
                self._new(
                    "PredictedPath",
                    self._poses(path, course_rad),
                    self._new("builtin_interfaces/Duration", step // 10**9, step % 10**9),
                    float(probability),
                )
                for path, probability in zip(paths, forecasts.probabilities[row], strict=True)
            ],
        )

    def _twist(self, velocity: NDArray[np.float64], yaw_rad: float) -> Any:
        """In the object's own frame; `velocity` is in the map's, NaN = not known."""
        known = bool(np.isfinite(velocity).all())
        vx, vy = velocity.tolist() if known else (0.0, 0.0)
        ahead = vx * math.cos(yaw_rad) + vy * math.sin(yaw_rad)
        left = vy * math.cos(yaw_rad) - vx * math.sin(yaw_rad)
        linear, angular = self._vector(ahead, left), self._vector(0.0, 0.0)
        twist = self._new("geometry_msgs/Twist", linear, angular)
        variance = np.zeros(36) if known else _UNKNOWN.copy()
        return self._new("geometry_msgs/TwistWithCovariance", twist, variance)

    def _poses(self, path: NDArray[np.float64], course_rad: float) -> list[Any]:
        """Each looks where it came along, or back there if it reverses; standing, as before.

        It reverses if it looks (`course_rad`, NaN = not known) away from where it first moves.
        """
        yaw_rad, back_rad = 0.0 if math.isnan(course_rad) else course_rad, math.nan
        poses = []
        for step, point in enumerate(path):
            way = point - path[max(step - 1, 0)]
            if np.hypot(*way) > _STANDS_M:
                along_rad = math.atan2(way[1], way[0])
                if math.isnan(back_rad):
                    back_rad = math.pi if math.cos(along_rad - course_rad) < 0.0 else 0.0
                yaw_rad = along_rad + back_rad
            poses.append(self._pose(point, yaw_rad))
        return poses

    def _pose(self, point: NDArray[np.float64], yaw_rad: float) -> Any:
        x, y = point.tolist()
        position = self._new("geometry_msgs/Point", x, y, 0.0)
        half = yaw_rad / 2.0
        turned = self._new("geometry_msgs/Quaternion", 0.0, 0.0, math.sin(half), math.cos(half))
        return self._new("geometry_msgs/Pose", position, turned)

    def _vector(self, x: float, y: float) -> Any:
        return self._new("geometry_msgs/Vector3", x, y, 0.0)


def moved_on(forecasts: ForecastSet, row: int, mode: int) -> NDArray[np.float64]:
    """(1 + steps, 2) the path of one mode from the cycle's newest measurement on, first the
    position then; as many steps as the horizon still has.
    """
    path = np.concatenate([forecasts.position[row][None], forecasts.trajectories[row, mode]])
    late = max(float(forecasts.timestamp_s - forecasts.anchor_s[row]) / forecasts.dt_s, 0.0)
    at = np.arange(len(path)) + late
    at = at[at <= len(path) - 1]
    steps = np.arange(len(path))
    return np.stack([np.interp(at, steps, path[:, axis]) for axis in range(2)], axis=-1)
