"""`--can`: which channel each bus of a profile is on."""

from __future__ import annotations

from collections.abc import Sequence

from eqrt.core.errors import UsageError


def parse_channels(options: Sequence[str], roles: Sequence[str]) -> dict[str, str]:
    """Role -> channel, from options like `vcan0` (every role) or `radar=can1`.

    Without options, no role has a channel. Raises UsageError for a role that the profile does not
    have, that is given twice, or that is left without a channel.
    """
    channels: dict[str, str] = {}
    everywhere: str | None = None
    for option in options:
        role, equals, channel = option.rpartition("=")
        if not channel or (equals and not role):
            raise UsageError(f"--can {option!r} names no channel; write CHANNEL or ROLE=CHANNEL")
        if not equals:
            if everywhere is not None:
                raise UsageError(
                    f"--can {everywhere} and --can {channel}: with two channels, say what each is: "
                    + " ".join(f"--can {role}=CHANNEL" for role in roles)
                )
            everywhere = channel
        elif role not in roles:
            raise UsageError(
                f"--can {option}: the profile has no bus {role!r}, only {', '.join(roles)}"
            )
        elif role in channels:
            raise UsageError(f"--can {option}: the bus {role!r} already is {channels[role]!r}")
        else:
            channels[role] = channel
    if everywhere is not None:
        return dict.fromkeys(roles, everywhere) | channels
    if missing := [role for role in roles if options and role not in channels]:
        raise UsageError(f"no channel for the bus {missing[0]!r}; add --can {missing[0]}=CHANNEL")
    return channels
