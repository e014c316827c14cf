"""Forecasts and the service's status as UDP datagrams, for viewers and recorders on this machine.

A datagram is one msgpack map (docs/output.md): of kind `forecast` (`_Wire`), with its arrays as
little-endian bytes, or of kind `status` (`ServiceStatus`). A cycle that is too large for one is
sent in parts, each a complete record of some of its objects. Nobody has to listen: sending to a
closed port costs the same and fails nothing.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import AddressError, UsageError, in_one_line
from eqrt.runtime.output.forecasts import ForecastSet, Mode, pose_numbers, pose_of
from eqrt.runtime.output.status import ServiceStatus

FORMAT_VERSION = 2
DEFAULT_ADDRESS = "127.0.0.1:47310"
MAX_BYTES = 60_000
"""A datagram's size at most; UDP allows 65,507."""
_MAX_UDP_BYTES = 65_507
_HEADER_BYTES, _OBJECT_BYTES = 1_200, 66  # more than the map's keys take; per object, less T, K, H
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
        """`addresses`: `HOST:PORT` each, for example DEFAULT_ADDRESS.

        Raises UsageError if one is none, AddressError if it is not to be found, which may change.
        """
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
            self.send(payload)

    def report(self, status: ServiceStatus) -> None:
        """Send the service's own state."""
        self.send(_ENCODER.encode(_StatusWire(version=FORMAT_VERSION, status=status)))

    def counts(self) -> dict[str, int]:
        """Since the start, by name."""
        return {"datagrams_sent": self.sent, "datagrams_failed": self.failed}

    def send(self, payload: bytes) -> None:
        """Send bytes as they are; what the network does not take is counted."""
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
    floats = 2 * forecasts.history.shape[1] + num_modes * (2 * horizon + 1)
    if forecasts.covariances is not None:
        floats += 4 * num_modes * horizon
    object_bytes = _OBJECT_BYTES + forecasts.history.shape[1] + 4 * floats
    rows = max(1, (MAX_BYTES - _HEADER_BYTES) // object_bytes)
    parts = max(1, -(-forecasts.num_targets // rows))
    for part in range(parts):
        yield _ENCODER.encode(_wire(forecasts, slice(part * rows, (part + 1) * rows), part, parts))


def decode_datagram(payload: bytes) -> Datagram | ServiceStatus:
    """The record in a datagram; ValueError if it is none of ours or of another version."""
    if len(payload) > _MAX_UDP_BYTES:
        raise ValueError(f"{len(payload)} bytes are no datagram")
    try:
        version = msgspec.msgpack.decode(payload, type=_Version).version
        if version != FORMAT_VERSION:
            raise ValueError(
                f"datagram format {version}, this version of eqrt reads format {FORMAT_VERSION}"
            )
        wire = _DECODER.decode(payload)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(f"not a datagram of eqrt ({in_one_line(error)})") from error
    if isinstance(wire, _StatusWire):
        return wire.status
    with np.errstate(invalid="ignore", over="ignore"):  # a stranger may send any numbers
        return Datagram(wire.part, wire.parts, _forecasts(wire))


class _Version(msgspec.Struct):
    """What every version of the format has."""

    version: int


class _StatusWire(msgspec.Struct, tag_field="kind", tag="status"):
    """The map that travels with a status."""

    version: int
    status: ServiceStatus


class _Wire(msgspec.Struct, tag_field="kind", tag="forecast"):
    """The map that travels with a cycle: keys as here; A objects, T steps of history, K modes, H
    steps to come, all arrays row by row.
    """

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
    map_from_ego: tuple[float, float, float]  # x m, y m, yaw rad; NaN = not known
    origin: tuple[float, float]  # m, map frame: positions count from here
    ego_speed_mps: float
    dt_s: float
    shape: tuple[int, int, int, int]  # A, T, K, H
    track_id: bytes  # int64 (A,)
    object_id: bytes  # int64 (A,)
    anchor_s: bytes  # float64 (A,)
    agent_mode: bytes  # uint8 (A,)
    position: bytes  # float32 (A, 2)
    velocity: bytes  # float32 (A, 2)
    heading_rad: bytes  # float32 (A,)
    object_class: bytes  # uint8 (A,)
    length_m: bytes  # float32 (A,)
    width_m: bytes  # float32 (A,)
    history: bytes  # float32 (A, T, 2)
    history_valid: bytes  # uint8 (A, T), 0 or 1
    trajectories: bytes  # float32 (A, K, H, 2)
    probabilities: bytes  # float32 (A, K)
    covariances: bytes  # float32 (A, K, H, 2, 2), or empty
    received_s: float = math.nan  # an older service does not tell


_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(_Wire | _StatusWire)


def _wire(forecasts: ForecastSet, rows: slice, part: int, parts: int) -> _Wire:
    pose = forecasts.map_from_ego
    # float32 is exact to 0.1 mm around the ego vehicle; where that is not known, nothing is sent
    origin = (pose.x_m, pose.y_m) if pose is not None else (0.0, 0.0)
    some = forecasts.targets(rows)
    return _Wire(
        version=FORMAT_VERSION,
        part=part,
        parts=parts,
        cycle=some.cycle,
        timestamp_s=some.timestamp_s,
        made_s=some.made_s,
        compute_s=some.compute_s,
        mode=int(some.mode),
        model_id=some.model_id,
        tile_id=some.tile_id,
        map_from_ego=pose_numbers(pose),
        origin=origin,
        ego_speed_mps=some.ego_speed_mps,
        dt_s=some.dt_s,
        shape=(some.num_targets, some.history.shape[1], *some.trajectories.shape[1:3]),
        track_id=some.track_id.astype("<i8").tobytes(),
        object_id=some.object_id.astype("<i8").tobytes(),
        anchor_s=some.anchor_s.astype("<f8").tobytes(),
        agent_mode=some.agent_mode.tobytes(),
        position=_bytes(some.position - origin),
        velocity=_bytes(some.velocity),
        heading_rad=_bytes(some.heading_rad),
        object_class=some.object_class.tobytes(),
        length_m=_bytes(some.length_m),
        width_m=_bytes(some.width_m),
        history=_bytes(some.history - origin),
        history_valid=some.history_valid.tobytes(),
        trajectories=_bytes(some.trajectories - origin),
        probabilities=_bytes(some.probabilities),
        covariances=b"" if some.covariances is None else _bytes(some.covariances),
        received_s=some.received_s,
    )


def _forecasts(wire: _Wire) -> ForecastSet:
    """Raises ValueError if the arrays have not the shape that the map says, or a mode is new, or
    there is a number that no service says.
    """
    _check(wire)
    agents, steps, num_modes, horizon = wire.shape
    covariances = None
    if wire.covariances:
        covariances = _array(wire.covariances, agents, num_modes, horizon, 2, 2)
    return ForecastSet(
        cycle=wire.cycle,
        timestamp_s=wire.timestamp_s,
        received_s=wire.received_s,
        made_s=wire.made_s,
        compute_s=wire.compute_s,
        mode=Mode(wire.mode),
        model_id=wire.model_id,
        tile_id=wire.tile_id,
        map_from_ego=pose_of(wire.map_from_ego),
        ego_speed_mps=wire.ego_speed_mps,
        dt_s=wire.dt_s,
        track_id=np.frombuffer(wire.track_id, "<i8").reshape(agents),
        object_id=np.frombuffer(wire.object_id, "<i8").reshape(agents),
        anchor_s=np.frombuffer(wire.anchor_s, "<f8").reshape(agents),
        agent_mode=np.frombuffer(wire.agent_mode, np.uint8).reshape(agents),
        position=_array(wire.position, agents, 2) + wire.origin,
        velocity=_array(wire.velocity, agents, 2),
        heading_rad=_array(wire.heading_rad, agents),
        object_class=np.frombuffer(wire.object_class, np.uint8).reshape(agents),
        length_m=_array(wire.length_m, agents),
        width_m=_array(wire.width_m, agents),
        history=_array(wire.history, agents, steps, 2) + wire.origin,
        history_valid=np.frombuffer(wire.history_valid, np.uint8).reshape(agents, steps) != 0,
        trajectories=_array(wire.trajectories, agents, num_modes, horizon, 2) + wire.origin,
        probabilities=_array(wire.probabilities, agents, num_modes),
        covariances=covariances,
    )


def _check(wire: _Wire) -> None:
    least = (0, 0, 1, 1)
    if not all(low <= n <= _MAX_UDP_BYTES for low, n in zip(least, wire.shape, strict=True)):
        raise ValueError(f"not a datagram of eqrt (shape {wire.shape})")
    if not 0 <= wire.part < wire.parts:
        raise ValueError(f"not a datagram of eqrt (part {wire.part} of {wire.parts})")
    times_s = (wire.timestamp_s, wire.made_s, wire.compute_s, wire.dt_s)
    if not (all(map(math.isfinite, times_s)) and wire.dt_s > 0.0):
        raise ValueError(f"not a datagram of eqrt (times {times_s})")
    for number in set(wire.agent_mode):
        Mode(number)


def _bytes(values: NDArray[np.float64]) -> bytes:
    return values.astype("<f4").tobytes()


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
        kind = AddressError if isinstance(error, OSError) else UsageError
        raise kind(
            f"cannot send datagrams to {address!r} ({error}); give HOST:PORT, such as "
            f"{DEFAULT_ADDRESS}"
        ) from error
    return family, (str(target[0]), int(target[1]))


def _sender(family: int) -> socket.socket:
    sender = socket.socket(family, socket.SOCK_DGRAM)
    sender.setblocking(False)
    sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)
    return sender
