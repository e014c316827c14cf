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
from eqrt.runtime.decoding.ego_profile import EgoProfile
from eqrt.runtime.decoding.geodesy import MapOrigin
from eqrt.runtime.decoding.message_check import MessageCheck, message_check
from eqrt.runtime.decoding.objects import ObjectDecoder
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.decoding.sensor_profile import SensorProfile
from eqrt.runtime.protection.sequence import Status
from eqrt.runtime.protection.source_health import SourceHealth, SourceReport

if TYPE_CHECKING:
    import can

Event = Detections | EgoMotion | EgoPose
Take = Callable[[Payload, float, Status], Sequence[Event]]
"""(data, timestamp in seconds, how it came) -> what that completes."""

_NOTHING: list[Event] = []  # shared by every message that completes nothing; never appended to
_OK = Status.OK  # a member's name is looked up slowly, and every message needs it
_UNREADABLE = b""  # stands for a message that came, but damaged or not new


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
        origin = _map_origin(map_origin_deg)
        self._egos = [_EgoInput(ego, origin, self.counters) for ego in profile.ego]
        self._sources: list[_SensorInput | _EgoInput] = [*self._sensors, *self._egos]
        for source in self._sources:
            for address, take in source.inputs():
                check = message_check(address, self.counters, source.profile.silence_s)
                route = _Route(address, accepted[source.profile.bus], take, check, self.counters)
                self._routes.setdefault(address.arbitration_id, []).append(route)

    @property
    def sources(self) -> tuple[SourceReport, ...]:
        """How the sensors of the profile are, then what tells about the ego vehicle.

        As of the last `feed` or `poll`: silence shows only when time passes.
        """
        return tuple(source.health.report for source in self._sources)

    def set_map_origin(self, map_origin_deg: tuple[float, float] | None) -> bool:
        """Count latitudes and longitudes from another origin, see `__init__`; True if there are."""
        geodetic = [ego for ego in self._egos if ego.is_geodetic]
        for ego in geodetic:
            ego.set_origin(_map_origin(map_origin_deg))
        return bool(geodetic)

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
        for ego in self._egos:
            ego.health.expire(now_s)
        return events


def _map_origin(origin_deg: tuple[float, float] | None) -> MapOrigin | None:
    return None if origin_deg is None else MapOrigin(*map(math.radians, origin_deg))


class _Route:
    """From a message on the bus to what takes its data."""

    def __init__(
        self,
        address: Address,
        channels: _Channels,
        take: Take,
        check: MessageCheck | None,
        counters: DecoderCounters,
    ) -> None:
        self.address = address
        self.channels = channels
        self._is_extended = address.is_extended
        self._needed_bytes = address.needed_bytes
        self._check = check
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
        if self._check is None:
            return self._take(data, timestamp_s, _OK)
        status = self._check.status(data, timestamp_s)
        if status is not _OK and not status.is_usable:
            data = _UNREADABLE
        return self._take(data, timestamp_s, status)


class _SensorInput:
    """One sensor: its messages to cycles, its cycles to detections."""

    def __init__(self, profile: SensorProfile, counters: DecoderCounters) -> None:
        self.profile = profile
        self._framing = framing_of(profile, counters)
        self._objects = ObjectDecoder(profile, counters)
        self._counters = counters
        self.health = SourceHealth(profile.name, profile.silence_s)

    def inputs(self) -> Iterator[tuple[Address, Take]]:
        """Which messages it takes, and what takes each."""
        if self.profile.header is not None:
            yield self.profile.header.address, self._open
        for i, part in enumerate(self.profile.parts):
            for slot, address in enumerate(part.addresses):
                yield address, partial(self._add, i, slot)

    def expire(self, now_s: float) -> Sequence[Event]:
        events = self._decoded(self._framing.expire(now_s))
        self.health.expire(now_s)
        return events

    def _open(self, data: Payload, timestamp_s: float, status: Status) -> Sequence[Event]:
        if status is _OK:
            return self._decoded(self._framing.open(data, timestamp_s, status))
        return self._open_wrong(data, timestamp_s, status)

    def _open_wrong(self, data: Payload, timestamp_s: float, status: Status) -> Sequence[Event]:
        if status.is_stale and self._framing.blame_header():
            return ()
        cycles = () if status.is_stale else self._framing.open(data, timestamp_s, status)
        events = self._decoded(cycles)
        if not status.is_usable and not self._framing.is_open:
            # The cycle that does not begin is the wrong one; the next one need not follow it.
            self.health.judge(False, timestamp_s)
            self._objects.forget_counter()
        return events

    def _add(
        self, part: int, slot: int, data: Payload, timestamp_s: float, status: Status
    ) -> Sequence[Event]:
        cycles = self._framing.add(part, slot, data, timestamp_s, status)
        return self._decoded(cycles) if cycles else ()

    def _decoded(self, cycles: tuple[Cycle, ...]) -> Sequence[Event]:
        return [used for cycle in cycles if (used := self._detections(cycle)) is not None]

    def _detections(self, cycle: Cycle) -> Detections | None:
        """What the cycle holds; None if the sensor is not to be believed."""
        if self.health.expire(cycle.first_s):
            self._objects.forget_counter()
        detections = self._objects.decode(cycle)
        self._counters.cycles += 1
        self._counters.incomplete_cycles += not cycle.complete
        if not self.health.judge(self._objects.is_right(cycle), cycle.last_s):
            self.health.refuse()
            self._counters.refused_cycles += 1
            return None
        self._counters.objects += len(detections.object_id)
        return detections


class _EgoInput:
    """One `[[ego]]`: its messages to motion and poses."""

    def __init__(
        self, profile: EgoProfile, origin: MapOrigin | None, counters: DecoderCounters
    ) -> None:
        self.profile = profile
        self._decoder = EgoDecoder(profile, origin)
        self._counters = counters
        self.health = SourceHealth(profile.name, profile.silence_s, len(profile.parts))

    @property
    def is_geodetic(self) -> bool:
        """Whether it tells poses by latitude and longitude."""
        return self._decoder.is_geodetic

    def set_origin(self, origin: MapOrigin | None) -> None:
        """The map has another origin from now on."""
        self._decoder.set_origin(origin)

    def inputs(self) -> Iterator[tuple[Address, Take]]:
        """Which messages it takes, and what takes each."""
        for i, part in enumerate(self.profile.parts):
            yield part.address, partial(self._add, i)

    def _add(self, part: int, data: Payload, timestamp_s: float, status: Status) -> Sequence[Event]:
        events = self._decoder.add(part, data, timestamp_s)
        valid = self.health.judge(status is _OK, timestamp_s, part)
        if valid or not events:
            return events
        self.health.refuse()
        self._counters.refused_ego += 1
        return ()


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
