"""Forecasts as the bytes of CAN messages, laid out in `dbc/eqrt.dbc` and told in docs/output.md.

CAN FD: a status of 32 bytes, then 64 bytes per object and mode. Classic CAN: the same in 8-byte
messages, with fewer points and only the most probable mode. Everything is little endian and in the
ego frame at `ForecastSet.timestamp_s`; what is not known has a raw value of its own.
"""

from __future__ import annotations

import math
import zlib
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eqrt.core.frames import Pose2, wrap_angle
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.protection.e2e import crc_p2_rows, crc_p5_rows, data_id_of, data_ids_of

FORMAT_VERSION = 2
MAX_OBJECTS = 255
"""More targets than this are not sent: the first ones are."""
FD_POINTS = 10
CLASSIC_TIMES_S = (1.0, 2.0, 3.0)

_POSITION_M, _VELOCITY_MPS, _YAW_RAD, _EGO_M = 0.02, 0.01, 1e-4, 0.01  # resolutions
_AGE_S, _COMPUTE_S, _PROBABILITY = 1e-3, 1e-4, 0.005
_AGE_CLASSIC_S, _COMPUTE_CLASSIC_S = 1e-2, 1e-3


class Offset(IntEnum):
    """Which message: its id is this much above the base id."""

    STATUS = 0
    TRAJECTORY = 1
    STATUS_CLASSIC = 2
    IDENTITY_CLASSIC = 3
    OBJECT_CLASSIC = 4
    POINT_CLASSIC = 5


# The fields of a message in their order on the wire, without gaps. `alive` and `crc` are for
# `protect`, last of all; in the classic messages `alive` is the low half of its byte, and the high
# half is used as well.
STATUS = np.dtype(
    [
        ("crc", "<u2"),
        ("alive", "u1"),
        ("mode", "u1"),
        ("version", "u1"),
        ("num_objects", "u1"),
        ("num_modes", "u1"),
        ("cycle", "u1"),
        ("input_age", "<u2"),
        ("compute_time", "<u2"),
        ("point_step", "<u2"),
        ("ego_yaw", "<i2"),
        ("model_id", "<u4"),
        ("tile_id", "<u4"),
        ("ego_position", "<i4", 2),
    ]
)
TRAJECTORY = np.dtype(
    [
        ("crc", "<u2"),
        ("alive", "u1"),
        ("cycle", "u1"),
        ("object_index", "u1"),
        ("mode_index", "u1"),
        ("agent_mode", "u1"),
        ("probability", "u1"),
        ("track_id", "<u2"),
        ("object_id", "<u2"),
        ("age", "<u2"),
        ("position", "<i2", 2),
        ("velocity", "<i2", 2),
        ("point_step", "<u2"),
        ("points", "<i2", (FD_POINTS, 2)),
    ]
)
STATUS_CLASSIC = np.dtype(
    [
        ("crc", "u1"),
        ("alive", "u1"),  # high half: mode
        ("cycle", "u1"),
        ("num_objects", "u1"),
        ("input_age", "<u2"),
        ("compute_time", "u1"),
        ("version", "u1"),
    ]
)
IDENTITY_CLASSIC = np.dtype(
    [("crc", "u1"), ("alive", "u1"), ("model_id", "u1", 3), ("tile_id", "u1", 3)]
)
OBJECT_CLASSIC = np.dtype(
    [
        ("crc", "u1"),
        ("alive", "u1"),  # high half: agent mode
        ("object_index", "u1"),
        ("age", "u1"),
        ("track_id", "<u2"),
        ("object_id", "<u2"),
    ]
)
POINT_CLASSIC = np.dtype(
    [
        ("crc", "u1"),
        ("alive", "u1"),  # high half: which point, from 1
        ("object_index", "u1"),
        ("probability", "u1"),
        ("point", "<i2", 2),
    ]
)

Rows = NDArray[np.void]
"""One element per message, of one of the layouts above."""


def encode_fd(forecasts: ForecastSet, num_modes: int) -> list[tuple[Offset, Rows]]:
    """A cycle's messages for CAN FD: the status, then `num_modes` per object, best first."""
    num_modes = min(num_modes, forecasts.probabilities.shape[1])
    stride = max(1, math.ceil(forecasts.trajectories.shape[2] / FD_POINTS))
    return [
        (Offset.STATUS, _status(forecasts, num_modes, stride)),
        (Offset.TRAJECTORY, _trajectories(forecasts, num_modes, stride)),
    ]


def encode_classic(forecasts: ForecastSet) -> list[tuple[Offset, Rows]]:
    """A cycle's messages for classic CAN: status, identity, objects, then each object's points."""
    return [
        (Offset.STATUS_CLASSIC, _status_classic(forecasts)),
        (Offset.IDENTITY_CLASSIC, _identity_classic(forecasts)),
        (Offset.OBJECT_CLASSIC, _objects_classic(forecasts)),
        (Offset.POINT_CLASSIC, _points_classic(forecasts)),
    ]


def protect(rows: Rows, arbitration_id: int, first_counter: int) -> None:
    """Count the messages of one id on from `first_counter` and write their checks, last of all.

    By AUTOSAR E2E: CAN FD messages with profile 5, classic ones with profile 2, and the data ids
    that go with the arbitration id.
    """
    counters = first_counter + np.arange(len(rows))
    as_bytes = rows.view(np.uint8).reshape(len(rows), rows.itemsize)
    if rows.dtype["crc"].itemsize == 2:
        rows["alive"] = counters & 0xFF
        rows["crc"] = crc_p5_rows(as_bytes, data_id_of(arbitration_id))
    else:
        rows["alive"] = rows["alive"] & 0xF0 | (counters & 0x0F).astype(np.uint8)
        rows["crc"] = crc_p2_rows(as_bytes, data_ids_of(arbitration_id))


def _status(forecasts: ForecastSet, num_modes: int, stride: int) -> Rows:
    pose = _map_from_ego(forecasts)
    row = np.zeros(1, STATUS)
    row["mode"] = forecasts.mode
    row["version"] = FORMAT_VERSION
    row["num_objects"] = _num_objects(forecasts)
    row["num_modes"] = num_modes
    row["cycle"] = forecasts.cycle & 0xFF
    row["input_age"] = _unsigned(forecasts.made_s - forecasts.timestamp_s, _AGE_S, 16)
    row["compute_time"] = _unsigned(forecasts.compute_s, _COMPUTE_S, 16)
    row["point_step"] = _unsigned(stride * forecasts.dt_s, _AGE_S, 16)
    row["ego_yaw"] = _signed(wrap_angle(pose.yaw_rad), _YAW_RAD, 16)
    row["ego_position"] = _signed((pose.x_m, pose.y_m), _EGO_M, 32)
    row["model_id"] = short_id(forecasts.model_id)
    row["tile_id"] = short_id(forecasts.tile_id)
    return row


def _trajectories(forecasts: ForecastSet, num_modes: int, stride: int) -> Rows:
    ego_from_map = _map_from_ego(forecasts).inverse()
    objects = slice(_num_objects(forecasts))
    points = forecasts.trajectories[objects, :num_modes, stride - 1 :: stride]
    rows = np.zeros(points.shape[:2], TRAJECTORY)  # (A, modes)
    rows["cycle"] = forecasts.cycle & 0xFF
    rows["object_index"] = np.arange(len(rows))[:, None]
    rows["mode_index"] = np.arange(num_modes)
    rows["agent_mode"] = forecasts.agent_mode[objects, None]
    probabilities = forecasts.probabilities[objects, :num_modes]
    rows["probability"] = _unsigned(probabilities, _PROBABILITY, 8)
    rows["track_id"] = _low_16_bits(forecasts.track_id[objects, None])
    rows["object_id"] = _or_not_available(forecasts.object_id[objects, None])
    rows["age"] = _unsigned(forecasts.age_s[objects, None], _AGE_S, 16)
    position = ego_from_map.apply(forecasts.position[objects, None])
    rows["position"] = _signed(position, _POSITION_M, 16)
    velocity = ego_from_map.rotate(forecasts.velocity[objects, None])
    rows["velocity"] = _signed(velocity, _VELOCITY_MPS, 16)
    rows["point_step"] = _unsigned(stride * forecasts.dt_s, _AGE_S, 16)
    rows["points"] = _signed(math.nan, _POSITION_M, 16)  # those beyond the horizon stay so
    rows["points"][:, :, : points.shape[2]] = _signed(_in_ego(points, forecasts), _POSITION_M, 16)
    return rows.ravel()


def _status_classic(forecasts: ForecastSet) -> Rows:
    row = np.zeros(1, STATUS_CLASSIC)
    row["alive"] = forecasts.mode << 4
    row["cycle"] = forecasts.cycle & 0xFF
    row["num_objects"] = _num_objects(forecasts)
    row["input_age"] = _unsigned(forecasts.made_s - forecasts.timestamp_s, _AGE_S, 16)
    row["compute_time"] = _unsigned(forecasts.compute_s, _COMPUTE_CLASSIC_S, 8)
    row["version"] = FORMAT_VERSION
    return row


def _identity_classic(forecasts: ForecastSet) -> Rows:
    row = np.zeros(1, IDENTITY_CLASSIC)
    for field, text in (("model_id", forecasts.model_id), ("tile_id", forecasts.tile_id)):
        row[field] = list((short_id(text) >> 8).to_bytes(3, "little"))  # its first six digits
    return row


def _objects_classic(forecasts: ForecastSet) -> Rows:
    objects = slice(_num_objects(forecasts))
    rows = np.zeros(_num_objects(forecasts), OBJECT_CLASSIC)
    rows["alive"] = forecasts.agent_mode[objects] << 4
    rows["object_index"] = np.arange(len(rows))
    rows["age"] = _unsigned(forecasts.age_s[objects], _AGE_CLASSIC_S, 8)
    rows["track_id"] = _low_16_bits(forecasts.track_id[objects])
    rows["object_id"] = _or_not_available(forecasts.object_id[objects])
    return rows


def _points_classic(forecasts: ForecastSet) -> Rows:
    objects = slice(_num_objects(forecasts))
    steps = np.rint(np.array(CLASSIC_TIMES_S) / forecasts.dt_s).astype(np.int64) - 1
    horizon = forecasts.trajectories.shape[2]
    rows = np.zeros((_num_objects(forecasts), len(steps)), POINT_CLASSIC)
    rows["alive"] = np.arange(1, len(steps) + 1) << 4
    rows["object_index"] = np.arange(len(rows))[:, None]
    rows["probability"] = _unsigned(forecasts.probabilities[objects, :1], _PROBABILITY, 8)
    rows["point"] = _signed(math.nan, _POSITION_M, 16)
    known = (steps >= 0) & (steps < horizon)
    points = forecasts.trajectories[objects, 0][:, steps[known]]
    rows["point"][:, known] = _signed(_in_ego(points, forecasts), _POSITION_M, 16)
    return rows.ravel()


def _map_from_ego(forecasts: ForecastSet) -> Pose2:
    """NaN if it is not known, and so is all that it is applied to."""
    return forecasts.map_from_ego or Pose2(math.nan, math.nan, math.nan)


def _in_ego(points: NDArray[np.float64], forecasts: ForecastSet) -> NDArray[np.float64]:
    """Points (A, ..., 2) of the first A trajectories, map frame, as seen from the ego vehicle; NaN
    where these say nothing.
    """
    moved = _map_from_ego(forecasts).inverse().apply(points)
    moved[forecasts.is_standstill_assumed[: len(points)]] = np.nan
    return moved


def short_id(text: str) -> int:
    """The first 32 bits of a hexadecimal id, the CRC-32 of any other text, 0 of none."""
    try:
        return int(text[:8].ljust(8, "0"), 16) if text else 0
    except ValueError:
        return zlib.crc32(text.encode())


def _num_objects(forecasts: ForecastSet) -> int:
    return min(forecasts.num_targets, MAX_OBJECTS)


def _low_16_bits(ids: NDArray[np.int64]) -> NDArray[np.int64]:
    return ids & 0xFFFF


def _or_not_available(ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Ids that fit, the highest value in place of the others."""
    return np.where((ids >= 0) & (ids < 0xFFFF), ids, 0xFFFF)


def _signed(values: ArrayLike, resolution: float, bits: int) -> NDArray[np.float64]:
    """Raw values; the lowest one = not available, for NaN and what is out of range."""
    raw = np.rint(np.asarray(values, np.float64) / resolution)
    lowest = -(2.0 ** (bits - 1))
    return np.where(np.abs(raw) < -lowest, raw, lowest)


def _unsigned(values: ArrayLike, resolution: float, bits: int) -> NDArray[np.float64]:
    """Raw values, cut off at the ends of the range; the highest one = not available, for NaN."""
    raw = np.rint(np.asarray(values, np.float64) / resolution)
    highest = 2.0**bits - 1.0
    return np.where(np.isnan(raw), highest, np.clip(raw, 0.0, highest - 1.0))
