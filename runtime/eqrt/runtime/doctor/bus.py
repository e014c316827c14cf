"""Checks of a CAN channel: is it there and up, how fast, what is on it."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can

from eqrt.core.errors import EqrtError
from eqrt.runtime.bus.buses import carries_fd, open_bus
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.doctor.finding import Finding, fail, ok, warn

_STANDARD_BITS, _EXTENDED_BITS = 47, 67  # of a classic message without data, gap included
_BUSY = 0.7  # share of the bitrate; above, messages of low priority come late
_SHOWN_IDS = 6
_PATIENCE_S = 5.0
_INTERFACES = Path("/sys/class/net")
_WHOLE_CYCLE = 130  # messages: 32 objects on classic CAN


@dataclass(slots=True)
class Traffic:
    """What was heard on a channel."""

    seconds: float
    ids: Counter[int] = field(default_factory=Counter)
    bits: int = 0
    """Of classic messages, without stuffed bits, which add up to a fifth."""
    fd_messages: int = 0
    errors: int = 0

    def add(self, message: can.Message) -> None:
        """One more."""
        if message.is_error_frame:
            self.errors += 1
            return
        self.ids[message.arbitration_id] += 1
        if message.is_fd:
            self.fd_messages += 1
            return
        self.bits += _EXTENDED_BITS if message.is_extended_id else _STANDARD_BITS
        self.bits += 8 * len(message.data)


def check_channel(
    channel: str,
    interface: str | None,
    fd: bool | None,
    profile: Profile | None,
    seconds: float,
    *,
    buses: Collection[str],
    sends: bool,
) -> Iterator[Finding]:
    """Open it, and listen for so long, 0 = not at all; `buses`: those of the profile that are said
    to be on it; `sends`: predictions go there.
    """
    name = f"channel {channel}"
    try:
        with open_bus(channel, interface, fd=fd) as bus:
            link = link_of(channel) if interface in (None, "socketcan") else {}
            yield judge_link(name, link, carries_fd(bus))
            traffic = heard(bus, seconds)
    except (EqrtError, can.CanError, OSError) as error:
        yield fail(name, str(error))
        return
    if sends and interface in (None, "socketcan") and (room := room_of(channel)) is not None:
        yield judge_room(f"room {channel}", channel, room)
    if not seconds:
        return
    yield judge_load(f"traffic {channel}", traffic, link.get("bitrate"))
    if profile is not None:
        yield judge_ids(f"ids {channel}", traffic, profile, buses)


def heard(bus: can.BusABC, seconds: float) -> Traffic:
    """Everything that comes."""
    traffic = Traffic(seconds)
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0:
        message = bus.recv(left_s)
        if message is not None:
            traffic.add(message)
    return traffic


def link_of(channel: str) -> dict[str, Any]:
    """What `ip` says of a CAN network interface: kind, state, bitrate, data_bitrate; or nothing."""
    ip = shutil.which("ip")
    if ip is None:
        return {}
    try:
        done = subprocess.run(
            [ip, "-json", "-details", "link", "show", "dev", channel],
            capture_output=True,
            check=True,
            timeout=_PATIENCE_S,
        )
        return parse_link(done.stdout)
    except (OSError, ValueError, AttributeError, subprocess.SubprocessError):
        return {}


def parse_link(text: str | bytes) -> dict[str, Any]:
    """What `link_of` tells, from ip-link(8)'s JSON of one interface."""
    (link,) = json.loads(text)
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    return {
        "kind": info.get("info_kind"),
        "state": data.get("state"),
        "bitrate": data.get("bittiming", {}).get("bitrate"),
        "data_bitrate": data.get("data_bittiming", {}).get("bitrate"),
    }


def judge_link(name: str, link: dict[str, Any], is_fd: bool) -> Finding:
    """Whether the interface can take part in the bus."""
    found = f"open, {'CAN FD' if is_fd else 'classic CAN'}"
    if link.get("kind"):
        found += f", {link['kind']}"
    for key, words in (("bitrate", "{} bit/s"), ("data_bitrate", "data {} bit/s")):
        if link.get(key):
            found += f", {words.format(link[key])}"
    state = link.get("state")
    if state in (None, "ERROR-ACTIVE"):
        return ok(name, found)
    return fail(
        name,
        f"{found}, {state}",
        "wrong bitrate, no second node that answers, or a bad line; then: ip link set NAME type "
        "can restart",
    )


def room_of(channel: str) -> int | None:
    """How many messages a network interface takes at once; None if there is none of that name."""
    try:
        return int((_INTERFACES / channel / "tx_queue_len").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def judge_room(name: str, channel: str, room: int) -> Finding:
    """Whether the interface takes all predictions of a cycle at once; 0 = it has no queue."""
    found = f"the interface takes {room or 'all'} messages at once"
    if not 0 < room < _WHOLE_CYCLE:
        return ok(name, found)
    return warn(
        name,
        f"{found}, a cycle may have {_WHOLE_CYCLE}: the rest waits in the service",
        f"sudo ip link set {channel} txqueuelen 1000",
    )


def judge_load(name: str, traffic: Traffic, bitrate: int | None) -> Finding:
    """Whether something comes, without errors, and leaves room for predictions."""
    rate_hz = traffic.ids.total() / traffic.seconds
    found = f"{rate_hz:.0f} messages/s, {len(traffic.ids)} ids"
    if traffic.fd_messages:
        found += f", {traffic.fd_messages / traffic.seconds:.0f} of them CAN FD"
    share = traffic.bits / traffic.seconds / bitrate if bitrate and not traffic.fd_messages else 0.0
    if share:
        found += f", {share:.0%} of the bitrate without stuffed bits"
    if not traffic.ids:
        advice = "is the sensor on, and the bitrate right? listen: candump CHANNEL"
        return warn(name, f"nothing heard in {traffic.seconds:g} s", advice)
    if traffic.errors:
        return warn(name, f"{found}, {traffic.errors} error frames", "check bitrate and wiring")
    if share > _BUSY:
        return warn(name, found, "nearly full: send predictions on another channel (--out-can)")
    return ok(name, found)


def judge_ids(name: str, traffic: Traffic, profile: Profile, buses: Collection[str]) -> Finding:
    """Whether messages came that the profile reads on these of its buses."""
    known = {number for number, _ in profile.ids_on(buses)}
    came = sorted(known & set(traffic.ids))
    missing = sorted(known - set(traffic.ids))
    others = [role for role in profile.roles if role not in buses]
    where = f" for {' and '.join(buses)}" if others else ""
    found = f"{len(came)} of the profile's {len(known)}{where} heard"
    if not came and traffic.ids.keys() & {number for number, _ in profile.ids_on(others)}:
        found += f", but of those for {' and '.join(others)}"
        return warn(name, found, "which channel is which? see --can")
    if not came:
        return warn(name, found, f"{profile.name} is not for what is on this channel")
    if missing:
        shown = ", ".join(f"{number:#x}" for number in missing[:_SHOWN_IDS])
        more = f" and {len(missing) - _SHOWN_IDS} more" if len(missing) > _SHOWN_IDS else ""
        return ok(name, f"{found}; not {shown}{more}")
    return ok(name, found)
