"""Forecasts as UDP datagrams, for viewers and recorders on the same machine.

A datagram is one msgpack map (see `_Wire` and docs/output.md) with its arrays as little-endian
bytes. A cycle that is too large for one is sent in parts, each a complete record of some of its
objects. Nobody has to listen: sending to a closed port costs the same and fails nothing.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import UsageError
from eqrt.core.frames import Pose2
from eqrt.runtime.output.forecasts import ForecastSet, Mode

FORMAT_VERSION = 1
DEFAULT_ADDRESS = "127.0.0.1:47310"
MAX_BYTES = 60_000
"""A datagram's size at most; UDP allows 65,507."""
_HEADER_BYTES, _OBJECT_BYTES = 1_000, 41  # more than the map's keys take; per object, less its K, H
_SEND_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Datagram:
    """Some, or all, of the forecasts of one cycle."""

    part: int
    """From 0."""
    parts: int
    """Datagrams that this cycle has."""
    forecasts: ForecastSet


class DatagramPublisher:
    """Sends every cycle's forecasts to some addresses, without ever waiting."""

    def __init__(self, addresses: Iterable[str]) -> None:
        """`addresses`: `HOST:PORT` each, for example DEFAULT_ADDRESS. Raises UsageError."""
        self._addresses = [_resolved(address) for address in addresses]
        families = {family for family, _ in self._addresses}
        self._sockets = {family: _sender(family) for family in families}
        self.sent = 0
        """Datagrams handed to the network; whether somebody listens is not known."""
        self.failed = 0
        """Datagrams that the network did not take."""

    def publish(self, forecasts: ForecastSet) -> None:
        """Send one cycle."""
        if not self._addresses:
            return
        for payload in encode_datagrams(forecasts):
            for family, address in self._addresses:
                try:
                    self._sockets[family].sendto(payload, address)
                except OSError:
                    self.failed += 1
                else:
                    self.sent += 1

    def close(self) -> None:
        """Give the sockets back; leaving a `with` block does it too."""
        for sender in self._sockets.values():
            sender.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def encode_datagrams(forecasts: ForecastSet) -> Iterator[bytes]:
    """The datagrams of one cycle, each of at most MAX_BYTES; one also if there are no targets."""
    _, num_modes, horizon, _ = forecasts.trajectories.shape
    object_bytes = _OBJECT_BYTES + 4 * num_modes * (2 * horizon + 1)
    rows = max(1, (MAX_BYTES - _HEADER_BYTES) // object_bytes)
    parts = max(1, -(-forecasts.num_targets // rows))
    for part in range(parts):
        yield _ENCODER.encode(_wire(forecasts, slice(part * rows, (part + 1) * rows), part, parts))


def decode_datagram(payload: bytes) -> Datagram:
    """The record in a datagram; ValueError if it is none of ours or of another version."""
    try:
        version = msgspec.msgpack.decode(payload, type=_Version).version
        if version != FORMAT_VERSION:
            raise ValueError(f"datagram format {version}, this version of eqrt reads format 1")
        wire = _DECODER.decode(payload)
        return Datagram(wire.part, wire.parts, _forecasts(wire))
    except msgspec.MsgspecError as error:
        raise ValueError(f"not a datagram of eqrt ({error})") from error


class _Version(msgspec.Struct):
    """What every version of the format has."""

    version: int


class _Wire(msgspec.Struct):
    """The map that travels: keys as here; A objects, K modes, H steps, all arrays row by row."""

    version: int
    part: int
    parts: int
    cycle: int
    timestamp_s: float
    made_s: float
    compute_s: float
    mode: int
    model_id: str
    tile_id: str
    map_from_ego: tuple[float, float, float]  # x m, y m, yaw rad
    origin: tuple[float, float]  # m, map frame: `position` and `trajectories` count from here
    dt_s: float
    shape: tuple[int, int, int]  # A, K, H
    track_id: bytes  # int64 (A,)
    object_id: bytes  # int64 (A,)
    anchor_s: bytes  # float64 (A,)
    agent_mode: bytes  # uint8 (A,)
    position: bytes  # float32 (A, 2)
    velocity: bytes  # float32 (A, 2)
    trajectories: bytes  # float32 (A, K, H, 2)
    probabilities: bytes  # float32 (A, K)


_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(_Wire)


def _wire(forecasts: ForecastSet, rows: slice, part: int, parts: int) -> _Wire:
    pose = forecasts.map_from_ego
    origin = (pose.x_m, pose.y_m)  # float32 is exact to 0.1 mm around the ego vehicle
    track_id = forecasts.track_id[rows]
    return _Wire(
        version=FORMAT_VERSION,
        part=part,
        parts=parts,
        cycle=forecasts.cycle,
        timestamp_s=forecasts.timestamp_s,
        made_s=forecasts.made_s,
        compute_s=forecasts.compute_s,
        mode=int(forecasts.mode),
        model_id=forecasts.model_id,
        tile_id=forecasts.tile_id,
        map_from_ego=(pose.x_m, pose.y_m, pose.yaw_rad),
        origin=origin,
        dt_s=forecasts.dt_s,
        shape=(len(track_id), *forecasts.trajectories.shape[1:3]),
        track_id=track_id.astype("<i8").tobytes(),
        object_id=forecasts.object_id[rows].astype("<i8").tobytes(),
        anchor_s=forecasts.anchor_s[rows].astype("<f8").tobytes(),
        agent_mode=forecasts.agent_mode[rows].tobytes(),
        position=(forecasts.position[rows] - origin).astype("<f4").tobytes(),
        velocity=forecasts.velocity[rows].astype("<f4").tobytes(),
        trajectories=(forecasts.trajectories[rows] - origin).astype("<f4").tobytes(),
        probabilities=forecasts.probabilities[rows].astype("<f4").tobytes(),
    )


def _forecasts(wire: _Wire) -> ForecastSet:
    """Raises ValueError if the arrays have not the shape that the map says, or the mode is new."""
    agents, num_modes, horizon = wire.shape
    return ForecastSet(
        cycle=wire.cycle,
        timestamp_s=wire.timestamp_s,
        made_s=wire.made_s,
        compute_s=wire.compute_s,
        mode=Mode(wire.mode),
        model_id=wire.model_id,
        tile_id=wire.tile_id,
        map_from_ego=Pose2(*wire.map_from_ego),
        dt_s=wire.dt_s,
        track_id=np.frombuffer(wire.track_id, "<i8").reshape(agents),
        object_id=np.frombuffer(wire.object_id, "<i8").reshape(agents),
        anchor_s=np.frombuffer(wire.anchor_s, "<f8").reshape(agents),
        agent_mode=np.frombuffer(wire.agent_mode, np.uint8).reshape(agents),
        position=_array(wire.position, agents, 2) + wire.origin,
        velocity=_array(wire.velocity, agents, 2),
        trajectories=_array(wire.trajectories, agents, num_modes, horizon, 2) + wire.origin,
        probabilities=_array(wire.probabilities, agents, num_modes),
    )


def _array(values: bytes, *shape: int) -> NDArray[np.float64]:
    return np.frombuffer(values, "<f4").astype(np.float64).reshape(shape)


def _resolved(address: str) -> tuple[int, tuple[str, int]]:
    """(address family, socket address) of `HOST:PORT`."""
    host, _, port = address.rpartition(":")
    try:
        if not host or not 0 < int(port) < 65_536:
            raise ValueError("no host, or no port")
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
        family, _, _, _, target = found[0]
    except (OSError, ValueError) as error:
        raise UsageError(
            f"cannot send datagrams to {address!r} ({error}); give HOST:PORT, such as "
            f"{DEFAULT_ADDRESS}"
        ) from error
    return family, (str(target[0]), int(target[1]))


def _sender(family: int) -> socket.socket:
    sender = socket.socket(family, socket.SOCK_DGRAM)
    sender.setblocking(False)
    sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)
    return sender
