"""The messages of a log: how many, how regularly, and which of them the profile names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.can_check.observation import UNNAMED, MessageKey, Observation, Stream
from eqrt.runtime.can_check.report import Channel, ProfileMessage, Rhythm, UnknownMessage
from eqrt.runtime.decoding.addresses import Address
from eqrt.runtime.decoding.profile import Profile

SHOWN_UNKNOWN = 10


@dataclass(frozen=True, slots=True)
class Named:
    """A message of the profile, and who reads it."""

    address: Address
    bus: str
    """The role of the bus that it is on."""
    user: str
    optional: bool


def named_messages(profile: Profile) -> Iterator[Named]:
    """Every message of the profile, in its order; one that several read comes several times."""
    for sensor in profile.sensors:
        if sensor.header is not None:
            yield Named(sensor.header.address, sensor.bus, sensor.name, optional=False)
        for part in sensor.parts:
            for address in part.addresses:
                yield Named(address, sensor.bus, sensor.name, part.optional)
    for ego in profile.ego:
        for ego_part in ego.parts:
            yield Named(ego_part.address, ego.bus, "ego", optional=False)


def key_of(address: Address) -> MessageKey:
    """As in `Observation.streams`."""
    return address.arbitration_id, address.is_extended


def has_come(address: Address, channel: str | int | None, seen: Observation) -> bool:
    """Whether the message came, mostly whole, on that channel; None = on any."""
    stream = seen.streams.get(key_of(address), Stream())
    names = stream.channels.keys() if channel is None else {str(channel), UNNAMED}
    damaged = stream.short + stream.bad_checksum + stream.bad_counter
    return bool(names & stream.channels.keys()) and 2 * damaged < len(stream.times_s)


def profile_messages(profile: Profile, seen: Observation) -> tuple[ProfileMessage, ...]:
    """A row for each message that the profile names, whether it came or not."""
    by_key: dict[MessageKey, list[Named]] = {}
    for named in named_messages(profile):
        by_key.setdefault(key_of(named.address), []).append(named)
    return tuple(_row(key, readers, seen) for key, readers in by_key.items())


def _row(key: MessageKey, readers: Sequence[Named], seen: Observation) -> ProfileMessage:
    stream = seen.streams.get(key, Stream())
    return ProfileMessage(
        id=shown_id(key),
        name=readers[0].address.name,
        used_by=", ".join(dict.fromkeys(named.user for named in readers)),
        optional=all(named.optional for named in readers),
        channels=tuple(sorted(stream.channels)),
        rhythm=rhythm(np.array(stream.times_s), seen),
        short=stream.short,
        bad_checksum=stream.bad_checksum,
        bad_counter=stream.bad_counter,
    )


def unknown_messages(
    profile: Profile, seen: Observation
) -> tuple[tuple[UnknownMessage, ...], tuple[int, int]]:
    """Ids that the profile does not name, the most frequent; how many more ids and messages."""
    known = {key_of(named.address) for named in named_messages(profile)}
    unknown = [(key, stream) for key, stream in seen.streams.items() if key not in known]
    unknown.sort(key=lambda item: (-len(item[1].times_s), item[0]))
    rows = tuple(
        UnknownMessage(
            id=shown_id(key),
            channels=tuple(sorted(stream.channels)),
            rhythm=rhythm(np.array(stream.times_s), seen),
        )
        for key, stream in unknown[:SHOWN_UNKNOWN]
    )
    rest = unknown[SHOWN_UNKNOWN:]
    return rows, (len(rest), sum(len(stream.times_s) for _, stream in rest))


def channels(profile: Profile, seen: Observation) -> tuple[Channel, ...]:
    """What came on each bus of the log."""
    named = {key_of(message.address) for message in named_messages(profile)}
    known: Counter[str] = Counter()
    unknown: Counter[str] = Counter()
    for key, stream in seen.streams.items():
        (known if key in named else unknown).update(stream.channels)
    names = sorted(known | unknown)
    return tuple(Channel(name=name, known=known[name], unknown=unknown[name]) for name in names)


def rhythm(times_s: NDArray[np.float64], seen: Observation) -> Rhythm:
    """Rate, usual period and worst gap of what came at `times_s` (n,)."""
    steps_s = np.diff(times_s)
    worst = int(np.argmax(steps_s)) if len(steps_s) else None
    return Rhythm(
        count=len(times_s),
        per_second=len(times_s) / seen.seconds if seen.seconds > 0.0 else 0.0,
        median_period_s=None if worst is None else float(np.median(steps_s)),
        worst_gap_s=None if worst is None else float(steps_s[worst]),
        worst_gap_at_s=None if worst is None else float(times_s[worst] - seen.first_s),
    )


def shown_id(key: MessageKey) -> str:
    """As candump writes it: three digits, or eight of the 29-bit kind."""
    arbitration_id, is_extended = key
    return f"0x{arbitration_id:08X}" if is_extended else f"0x{arbitration_id:03X}"
