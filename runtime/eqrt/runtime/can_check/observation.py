"""One pass over a log: which messages came when, and what the decoder made of them."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import can

from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.decoding.detections import Detections, EgoMotion, EgoPose
from eqrt.runtime.decoding.profile import Profile

MessageKey = tuple[int, bool]
"""Arbitration id, and whether it is of the 29-bit kind."""

UNNAMED = "-"
"""The channel of a log that does not say which."""
_AFTER_THE_END_S = 60.0  # longer than any timeout: what is open then is closed


@dataclass(slots=True)
class Stream:
    """The messages with one id."""

    times_s: array[float] = field(default_factory=lambda: array("d"))
    """As recorded."""
    channels: Counter[str] = field(default_factory=Counter)
    short: int = 0
    bad_checksum: int = 0
    bad_counter: int = 0
    """Counted where it was noticed."""


@dataclass(slots=True)
class Observation:
    """What came, and what was decoded."""

    counters: DecoderCounters
    streams: dict[MessageKey, Stream] = field(default_factory=dict)
    first_s: float = 0.0
    last_s: float = 0.0
    backward_steps: int = 0
    """How often a message was stamped earlier than the one before it."""
    detections: list[Detections] = field(default_factory=list)
    motions: list[EgoMotion] = field(default_factory=list)
    poses: list[EgoPose] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """From the first to the last message."""
        return self.last_s - self.first_s


def observe(
    messages: Iterable[can.Message],
    profile: Profile,
    channels: Mapping[str, str | int] | None = None,
) -> Observation:
    """Decode a log on its own clock, as `eqrt replay` does. `channels`: as of `Decoder`."""
    decoder = Decoder(profile, channels)
    seen = Observation(decoder.counters)
    before_s = -math.inf
    for message in messages:
        now_s = message.timestamp
        if seen.counters.messages == 0:
            seen.first_s = seen.last_s = now_s
        seen.backward_steps += now_s < before_s
        seen.last_s, before_s = max(seen.last_s, now_s), now_s
        _keep(seen, decoder.poll(now_s))
        _note(seen, message, decoder)
    _keep(seen, decoder.poll(seen.last_s + _AFTER_THE_END_S))
    return seen


def _note(seen: Observation, message: can.Message, decoder: Decoder) -> None:
    """Decode one message, and note with its id what is wrong with it."""
    counters = decoder.counters
    short, checksum, counter = counters.short, counters.bad_checksum, counters.bad_counter
    _keep(seen, decoder.feed(message, message.timestamp))
    if message.is_error_frame or message.is_remote_frame:
        return
    key = (message.arbitration_id, message.is_extended_id)
    if (stream := seen.streams.get(key)) is None:
        stream = seen.streams[key] = Stream()
    stream.times_s.append(message.timestamp)
    stream.channels[channel_name(message)] += 1
    stream.short += counters.short - short
    stream.bad_checksum += counters.bad_checksum - checksum
    stream.bad_counter += counters.bad_counter - counter


def channel_name(message: can.Message) -> str:
    """What the recorder called the bus; a dash if it does not say."""
    return UNNAMED if message.channel is None else str(message.channel)


def _keep(seen: Observation, events: list[Event]) -> None:
    for event in events:
        if isinstance(event, Detections):
            seen.detections.append(event)
        elif isinstance(event, EgoMotion):
            seen.motions.append(event)
        else:
            seen.poses.append(event)
