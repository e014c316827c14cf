"""CAN messages in; detections, ego motion and ego poses out, as a profile says.

    decoder = Decoder(load_profile("ars408"))
    for message in bus:
        for event in decoder.feed(message, time.monotonic()):
            ...

Nothing on the bus raises: what cannot be used is counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

from eqrt.core.errors import UsageError
from eqrt.runtime.decoding.addresses import Address
from eqrt.runtime.decoding.cycles import Cycle, framing_of
from eqrt.runtime.decoding.dbc_tables import Payload
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.decoding.detections import Detections, EgoMotion, EgoPose
from eqrt.runtime.decoding.ego_messages import EgoDecoder
from eqrt.runtime.decoding.geodesy import MapOrigin
from eqrt.runtime.decoding.objects import ObjectDecoder
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.decoding.sensor_profile import SensorProfile

if TYPE_CHECKING:
    import can

Event = Detections | EgoMotion | EgoPose
Take = Callable[[Payload, float], Sequence[Event]]
"""(data, timestamp in seconds) -> what that completes."""

_NOTHING: list[Event] = []  # shared by every message that completes nothing; never appended to
_UNREADABLE = b""  # stands for a message that came, but damaged


class Decoder:
    """Takes the messages of all buses, gives what each of them completes."""

    def __init__(
        self,
        profile: Profile,
        channels: Mapping[str, str | int] | None = None,
        map_origin_deg: tuple[float, float] | None = None,
    ) -> None:
        """`channels`: role of a bus in the profile -> its channel; None = every role is anywhere.

        A message that does not say its channel (None) is taken for any. `map_origin_deg`: latitude
        and longitude of the map's origin; None = where the first pose is, NaN = the map does not
        say, and poses by latitude and longitude are of no use. Raises UsageError if a role has no
        channel, or there is no such role.
        """
        self.counters = DecoderCounters()
        self.arbitration_ids = profile.arbitration_ids
        """Every id that the profile means, on any bus."""
        self._sensors = [_SensorInput(sensor, self.counters) for sensor in profile.sensors]
        self._routes: dict[int, list[_Route]] = {}
        accepted = _accepted_channels(profile, channels)
        for sensor in self._sensors:
            for address, take in sensor.inputs():
                self._add_route(address, accepted[sensor.profile.bus], take)
        origin = _map_origin(map_origin_deg)
        self._egos = [EgoDecoder(ego, origin) for ego in profile.ego]
        for ego, decoder in zip(profile.ego, self._egos, strict=True):
            for i, part in enumerate(ego.parts):
                self._add_route(part.address, accepted[ego.bus], partial(decoder.add, i))

    def set_map_origin(self, map_origin_deg: tuple[float, float] | None) -> bool:
        """Count latitudes and longitudes from another origin, see `__init__`; True if there are."""
        geodetic = [ego for ego in self._egos if ego.is_geodetic]
        for ego in geodetic:
            ego.set_origin(_map_origin(map_origin_deg))
        return bool(geodetic)

    def _add_route(self, address: Address, channels: _Channels, take: Take) -> None:
        route = _Route(address, channels, take, self.counters)
        self._routes.setdefault(address.arbitration_id, []).append(route)

    def feed(self, message: can.Message, timestamp_s: float) -> list[Event]:
        """What this message completes; mostly nothing. The list is not to be changed."""
        counters = self.counters
        counters.messages += 1
        routes = self._routes.get(message.arbitration_id)
        if routes is None:
            counters.other_id += 1
            return _NOTHING
        events, used, data = _NOTHING, False, message.data
        for route in routes:
            if route.accepts(message):
                used = True
                if told := route.take(data, timestamp_s):
                    events = [*events, *told]
        if used:
            counters.used += 1
        elif _is_data(message, routes):
            counters.wrong_bus += 1
        else:
            counters.not_data += 1
        return events

    def poll(self, now_s: float) -> list[Event]:
        """What has waited too long for its last message, as far as it came."""
        events = _NOTHING
        for sensor in self._sensors:
            if told := sensor.expire(now_s):
                events = [*events, *told]
        return events


def _map_origin(origin_deg: tuple[float, float] | None) -> MapOrigin | None:
    return None if origin_deg is None else MapOrigin(*map(math.radians, origin_deg))


class _Route:
    """From a message on the bus to what takes its data."""

    def __init__(
        self, address: Address, channels: _Channels, take: Take, counters: DecoderCounters
    ) -> None:
        self.address = address
        self.channels = channels
        self._is_extended = address.is_extended
        self._needed_bytes = address.needed_bytes
        self._checksum = address.checksum
        self._take = take
        self._counters = counters

    def accepts(self, message: can.Message) -> bool:
        return (
            (self.channels is None or message.channel in self.channels)
            and message.is_extended_id == self._is_extended
            and not message.is_error_frame
            and not message.is_remote_frame
        )

    def take(self, data: Payload, timestamp_s: float) -> Sequence[Event]:
        if len(data) < self._needed_bytes:
            self._counters.short += 1
        if self._checksum is not None and not self._checksum.holds(
            self.address.arbitration_id, data
        ):
            self._counters.bad_checksum += 1
            data = _UNREADABLE
        return self._take(data, timestamp_s)


class _SensorInput:
    """One sensor: its messages to cycles, its cycles to detections."""

    def __init__(self, profile: SensorProfile, counters: DecoderCounters) -> None:
        self.profile = profile
        self._framing = framing_of(profile, counters)
        self._objects = ObjectDecoder(profile, counters)
        self._counters = counters

    def inputs(self) -> Iterator[tuple[Address, Take]]:
        """Which messages it takes, and what takes each."""
        if self.profile.header is not None:
            yield self.profile.header.address, self._open
        for i, part in enumerate(self.profile.parts):
            for slot, address in enumerate(part.addresses):
                yield address, partial(self._add, i, slot)

    def expire(self, now_s: float) -> Sequence[Event]:
        return self._decoded(self._framing.expire(now_s))

    def _open(self, data: Payload, timestamp_s: float) -> Sequence[Event]:
        return self._decoded(self._framing.open(data, timestamp_s))

    def _add(self, part: int, slot: int, data: Payload, timestamp_s: float) -> Sequence[Event]:
        return self._decoded(self._framing.add(part, slot, data, timestamp_s))

    def _decoded(self, cycles: tuple[Cycle, ...]) -> Sequence[Event]:
        if not cycles:
            return ()
        detections = [self._objects.decode(cycle) for cycle in cycles]
        self._counters.cycles += len(cycles)
        self._counters.incomplete_cycles += sum(not cycle.complete for cycle in cycles)
        self._counters.objects += sum(len(one.object_id) for one in detections)
        return detections


_Channels = frozenset[str | int | None] | None
"""What `can.Message.channel` may be; None = anything."""


def _accepted_channels(
    profile: Profile, channels: Mapping[str, str | int] | None
) -> dict[str, _Channels]:
    """By role."""
    if not channels:
        return dict.fromkeys(profile.roles)
    for role in channels.keys() ^ set(profile.roles):
        problem = "no bus" if role in channels else "no channel for its bus"
        example = " ".join(f"--can {name}=CHANNEL" for name in profile.roles)
        raise UsageError(
            f"the profile {profile.name!r} has {problem} {role!r}; give {example}, "
            f"or one channel for everything: --can CHANNEL"
        )
    return {role: _spellings(channel) for role, channel in channels.items()}


def _spellings(channel: str | int) -> frozenset[str | int | None]:
    """python-can calls a numbered channel 1 or '1', as the interface or log format has it."""
    text = str(channel)
    return frozenset({text, None} | ({int(text)} if text.isdecimal() else set()))


def _is_data(message: can.Message, routes: Sequence[_Route]) -> bool:
    right_length = any(message.is_extended_id == route.address.is_extended for route in routes)
    return right_length and not message.is_error_frame and not message.is_remote_frame
