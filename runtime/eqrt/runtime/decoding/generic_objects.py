"""The writer of eqrt's generic object list, whose messages dbc/eqrt_objects.dbc defines.

Makes recordings, demonstrations and tests; a stack that feeds eqrt does the same on its side.
Every message is classic CAN of eight bytes, all signals little-endian; with end-to-end protection
it is CAN FD of twelve (dbc/eqrt_objects_e2e.dbc, profile `generic-e2e`).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import can
import numpy as np
from numpy.typing import ArrayLike, NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.dbc_files import DbcMessage, load_dbc
from eqrt.runtime.decoding.dbc_tables import Signal
from eqrt.runtime.decoding.detections import Detections, VelocityKind
from eqrt.runtime.protection.e2e import Profile5, Sender, data_id_of

INTERFACE_VERSION = 1
MAX_OBJECTS = 255
MAX_OBJECT_ID = 255
PROTECTED_ID_OFFSET = 8
"""From a message's id to that of the protected one: both lists may be on one bus."""

_DBC = Path(__file__).parent / "dbc" / "eqrt_objects.dbc"
_LENGTH = 8  # bytes of every message
_HEADER_BYTES = 4  # before them, in protected ones
_NOT_AVAILABLE = {  # signals that have such a value; see `_not_available` for which it is
    "EGO_MOTION": ("SPEED", "YAW_RATE"),
    "OBJECT_POSITION": ("EXISTENCE",),
    "OBJECT_MOTION": ("VX", "VY", "HEADING", "LENGTH", "WIDTH"),
}
_GOOD = 2  # of EGO_YAW.QUALITY


def encode_cycle(
    objects: Detections | None = None,
    *,
    timestamp_s: float,
    counter: int = 0,
    speed_mps: float | None = None,
    yaw_rate_rad_s: float | None = None,
    map_from_ego: Pose2 | None = None,
    age_s: float = 0.0,
    message_s: float = 0.0,
    channel: str | int | None = None,
    arbitration_id_offset: int = 0,
    protection: ListProtection | None = None,
) -> list[can.Message]:
    """The messages of one cycle, in the order in which they go on the bus.

    `objects` are in the ego frame with velocities over ground, their ids 0 to 255; what does not
    fit a signal's range takes its nearest value, and objects without a position are left out.
    `counter` counts cycles, modulo 256. All of it was measured `age_s` before the first message;
    each message goes `message_s` after the one before, as its stamp and its age say. None leaves a
    message out. `protection` counts from cycle to cycle; None = without it. Raises ValueError for
    more than 255 objects, another id or kind of velocity.
    """
    blocks: list[tuple[str, NDArray[np.uint8]]] = []

    def age_ms() -> float:
        """Of the next message, when it is sent."""
        return 1e3 * (age_s + message_s * sum(len(block) for _, block in blocks))

    def add(name: str, **values: ArrayLike) -> None:
        blocks.append((name, _pack(name, values)))

    if speed_mps is not None or yaw_rate_rad_s is not None:
        speed = np.nan if speed_mps is None else speed_mps
        yaw_rate = np.nan if yaw_rate_rad_s is None else yaw_rate_rad_s
        add("EGO_MOTION", SPEED=speed, YAW_RATE=yaw_rate, AGE=age_ms(), COUNTER=counter % 256)
    if map_from_ego is not None:
        add("EGO_POSITION", X=map_from_ego.x_m, Y=map_from_ego.y_m)
        yaw = map_from_ego.yaw_rad
        add("EGO_YAW", YAW=yaw, QUALITY=_GOOD, AGE=age_ms(), COUNTER=counter % 256)
    if objects is not None:
        blocks += _object_blocks(objects, counter % 256, age_ms())
    messages = [
        can.Message(
            arbitration_id=_messages()[name].arbitration_id + arbitration_id_offset,
            is_extended_id=False,
            channel=channel,
            data=data.tobytes(),
        )
        for name, block in blocks
        for data in block
    ]
    for place, message in enumerate(messages):
        message.timestamp = timestamp_s + place * message_s
    return messages if protection is None else [protection.protect(one) for one in messages]


class ListProtection:
    """Makes protected messages of the object list's plain ones, and counts them by id."""

    def __init__(self) -> None:
        self._senders: dict[int, Sender] = {}

    def protect(self, message: can.Message) -> can.Message:
        """The message as CAN FD: a header of E2E profile 5, a byte 0, the eight bytes it had."""
        arbitration_id = message.arbitration_id + PROTECTED_ID_OFFSET
        if arbitration_id not in self._senders:
            self._senders[arbitration_id] = Sender(Profile5(data_id=data_id_of(arbitration_id)))
        return can.Message(
            timestamp=message.timestamp,
            arbitration_id=arbitration_id,
            is_extended_id=message.is_extended_id,
            is_fd=True,
            bitrate_switch=True,
            channel=message.channel,
            data=self._senders[arbitration_id].protect(bytes(_HEADER_BYTES) + message.data),
        )


def _object_blocks(
    objects: Detections, counter: int, age_ms: float
) -> list[tuple[str, NDArray[np.uint8]]]:
    _check(objects)
    keep = np.flatnonzero(np.isfinite(objects.position).all(axis=1))
    ids, x, y = objects.object_id[keep], *objects.position[keep].T
    velocity = objects.velocity[keep].T
    header = {"COUNT": len(keep), "COUNTER": counter, "AGE": age_ms}
    position = {
        "OBJECT_ID": ids,
        "X": x,
        "Y": y,
        "CLASS": objects.object_class[keep],
        "NEW_TRACK": objects.is_new[keep],
        "EXISTENCE": 100.0 * np.clip(objects.existence[keep], 0.0, 1.0),
        "COUNTER": np.full(len(keep), counter),
    }
    motion = {
        "OBJECT_ID": ids,
        "VX": velocity[0],
        "VY": velocity[1],
        "HEADING": np.remainder(objects.heading_rad[keep] + np.pi, 2 * np.pi) - np.pi,
        "LENGTH": objects.length_m[keep],
        "WIDTH": objects.width_m[keep],
    }
    return [
        ("OBJECT_LIST", _pack("OBJECT_LIST", {**header, "INTERFACE_VERSION": INTERFACE_VERSION})),
        ("OBJECT_POSITION", _pack("OBJECT_POSITION", position)),
        ("OBJECT_MOTION", _pack("OBJECT_MOTION", motion)),
    ]


def _check(objects: Detections) -> None:
    kind, ids = objects.velocity_kind, objects.object_id
    if kind not in (VelocityKind.ABSOLUTE, VelocityKind.NONE):
        raise ValueError(f"velocities are {kind.name}, the object list takes ABSOLUTE ones or NONE")
    if len(ids) > MAX_OBJECTS:
        raise ValueError(f"{len(ids)} objects, the object list takes {MAX_OBJECTS}")
    if len(ids) and not 0 <= ids.min() <= ids.max() <= MAX_OBJECT_ID:
        raise ValueError(f"object ids {ids.min()} to {ids.max()}, expected 0 to {MAX_OBJECT_ID}")


def _pack(name: str, values: Mapping[str, ArrayLike]) -> NDArray[np.uint8]:
    """(M, 8) payloads of one kind of message from physical values, scalars or (M,); NaN = n/a."""
    words = np.zeros(1, np.uint64)
    for signal_name, value in values.items():
        signal = _messages()[name].signals[signal_name]
        has_not_available = signal_name in _NOT_AVAILABLE.get(name, ())
        raw = _raw(np.atleast_1d(np.asarray(value, np.float64)), signal, has_not_available)
        bits = raw.view(np.uint64) & np.uint64((1 << signal.length) - 1)
        words = words | (bits << np.uint64(8 * signal.first_byte + signal.shift))
    return words.astype("<u8").view(np.uint8).reshape(-1, _LENGTH)


def _raw(values: NDArray[np.float64], signal: Signal, has_not_available: bool) -> NDArray[np.int64]:
    lowest, highest = signal.raw_values[0], signal.raw_values[-1]
    not_available = lowest if signal.is_signed else highest
    if has_not_available:  # kept out of the range of values
        lowest, highest = (lowest + 1, highest) if signal.is_signed else (lowest, highest - 1)
    raw = np.clip(np.rint((values - signal.offset) / signal.scale), lowest, highest)
    return np.where(np.isnan(values), not_available if has_not_available else 0, raw).astype(
        np.int64
    )


@cache
def _messages() -> Mapping[str, DbcMessage]:
    return load_dbc(_DBC).messages
