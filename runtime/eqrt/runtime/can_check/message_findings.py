"""What looks wrong with the messages themselves, before anything of them is believed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from eqrt.runtime.can_check.observation import UNNAMED, Observation
from eqrt.runtime.can_check.report import Finding, ProfileMessage
from eqrt.runtime.can_check.traffic import key_of, named_messages
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.decoding.profile import Profile


def message_findings(messages: tuple[ProfileMessage, ...]) -> Iterator[Finding]:
    """Messages that did not come, or came damaged."""
    for user in dict.fromkeys(message.used_by for message in messages):
        needed = [m for m in messages if m.used_by == user and not m.optional]
        absent = [m for m in needed if not m.rhythm.count]
        if absent and len(absent) == len(needed):
            names = _listed([f"{m.name} ({m.id})" for m in absent])
            yield Finding(about=user, text=f"none of its messages came: {names}")
        elif absent:
            names = _listed([f"{m.name} ({m.id})" for m in absent])
            yield Finding(about=user, text=f"never came: {names}")
    for user in dict.fromkeys(message.used_by for message in messages):
        yield from _damage([message for message in messages if message.used_by == user])


def both_bus_findings(messages: tuple[ProfileMessage, ...]) -> Iterator[Finding]:
    """Messages that come on several channels, where none was asked for with `--can`."""
    several = [message for message in messages if len(message.channels) > 1]
    for channels in dict.fromkeys(message.channels for message in several):
        yield Finding(
            about=_listed([message.name for message in several if message.channels == channels]),
            text=f"on {' and '.join(channels)}, and all of it is read; say which is meant with "
            "--can ROLE=NAME",
        )


def other_bus_findings(
    profile: Profile, asked: Mapping[str, str | int], seen: Observation
) -> Iterator[Finding]:
    """Buses of the profile that are on another channel than was asked for."""
    for bus, channel in asked.items():
        keys = {key_of(named.address) for named in named_messages(profile) if named.bus == bus}
        came = {name for key in keys & seen.streams.keys() for name in seen.streams[key].channels}
        if came and not came & {str(channel), UNNAMED}:
            names = sorted(came)
            yield Finding(
                about=bus,
                text=f"its messages come on {' and '.join(names)}, and none on {channel}: is it "
                f"--can {bus}={names[0]}?",
            )


def clock_findings(seen: Observation) -> Iterator[Finding]:
    """A clock that goes back, or does not go at all."""
    if steps := seen.backward_steps:
        times = "once" if steps == 1 else f"{steps} times"
        text = f"its clock goes back {times}: was it recorded in one piece?"
        yield Finding(about="log", text=text)
    elif seen.counters.messages > 1 and not seen.seconds:
        yield Finding(
            about="log",
            text="all its messages carry the same time: nothing that moves can be checked, and "
            "`eqrt replay` predicts at that one time only",
        )


def left_out_findings(profile: Profile, counters: DecoderCounters) -> Iterator[Finding]:
    """Objects that were announced and do not count; empty slots of a radar with slots are none."""
    if any(sensor.framing != "counted" for sensor in profile.sensors):
        return
    announced = counters.objects + counters.invalid_objects
    if counters.invalid_objects > 0.1 * announced:
        yield Finding(
            about=", ".join(sensor.name for sensor in profile.sensors),
            text=f"{counters.invalid_objects} of {announced} objects are left out: `valid` does "
            "not hold for them, or they share their `id` with another of the same cycle",
        )


def _damage(messages: Sequence[ProfileMessage]) -> Iterator[Finding]:
    """One finding for all that have the same damage: a radar has up to 256 slots."""
    for numbers, what in (
        (
            [message.short for message in messages],
            "are too short for what the profile reads of them; is this the right DBC?",
        ),
        (
            [message.bad_checksum for message in messages],
            "fail their checksum; if all do, its kind or byte is wrong",
        ),
        (
            [message.bad_counter for message in messages],
            "do not follow in the counter: lost messages, or the wrong signal",
        ),
    ):
        bad = [
            (message, number)
            for message, number in zip(messages, numbers, strict=True)
            if number > max(2, 0.01 * message.rhythm.count)
        ]
        if bad:
            yield Finding(
                about=_listed([message.name for message, _ in bad]),
                text=f"{sum(number for _, number in bad)} of "
                f"{sum(message.rhythm.count for message, _ in bad)} {what}",
            )


def _listed(names: list[str]) -> str:
    """The first few names, and how many more."""
    shown = ", ".join(names[:4])
    return shown if len(names) <= 4 else f"{shown} and {len(names) - 4} more"
