"""Is it the right sensor, only with other ids? An ARS408 of sensor id 1 sends 0x61A, not 0x60A."""

from __future__ import annotations

from collections.abc import Iterator

from eqrt.runtime.can_check.observation import MessageKey, Observation
from eqrt.runtime.can_check.report import Finding
from eqrt.runtime.can_check.traffic import key_of, named_messages
from eqrt.runtime.decoding.profile import Profile


def offset_findings(profile: Profile, seen: Observation) -> Iterator[Finding]:
    """For each sensor of which nothing came: an offset at which all that it needs is there."""
    unknown = seen.streams.keys() - {key_of(named.address) for named in named_messages(profile)}
    for sensor in profile.sensors:
        messages = [named for named in named_messages(profile) if named.user == sensor.name]
        needed = [key_of(named.address) for named in messages if not named.optional]
        if any(key in seen.streams for key in needed):
            continue
        all_keys = [key_of(named.address) for named in messages]
        if (offset := _offset(needed, all_keys, unknown)) is not None:
            yield Finding(
                about=sensor.name,
                text=f"the same pattern of ids is there {_shown(offset)}: "
                f"add {offset} to its arbitration_id_offset, if that is this sensor",
            )


def _offset(
    needed: list[MessageKey], all_keys: list[MessageKey], unknown: set[MessageKey]
) -> int | None:
    """One that finds every needed id among those that the profile does not name, and the most of
    all; None where one id proves nothing.
    """
    if len(needed) < 2:
        return None
    first, is_extended = needed[0]
    candidates = {arbitration_id - first for arbitration_id, wide in unknown if wide == is_extended}
    fitting = [offset for offset in candidates if _found(needed, offset, unknown) == len(needed)]
    if not fitting:
        return None
    return max(fitting, key=lambda offset: (_found(all_keys, offset, unknown), -abs(offset)))


def _found(keys: list[MessageKey], offset: int, unknown: set[MessageKey]) -> int:
    return sum((arbitration_id + offset, wide) in unknown for arbitration_id, wide in keys)


def _shown(offset: int) -> str:
    return f"{abs(offset):#x} {'higher' if offset > 0 else 'lower'}"
