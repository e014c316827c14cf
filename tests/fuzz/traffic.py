"""Bytes as CAN traffic: four bytes say which message comes when, then follow its data.

Every sequence of bytes is some traffic, and a fuzzer that changes a byte changes one thing.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence

import can

_HEAD = struct.Struct("<BBBb")  # which id, flags, bytes of data, time since the message before
_EXTENDED, _REMOTE, _ERROR, _OTHER_CHANNEL, _NO_CHANNEL, _ODD_TIME = 1, 2, 4, 8, 16, 32
_STEP_S = 0.002
_ODD_TIMES_S = (math.nan, math.inf, -math.inf, -1e9, 1e18, 0.0, 1e300, -0.0)
_MAX_MESSAGES = 400
_OTHER_ID = 0x7FF


def traffic(data: bytes, ids: Sequence[tuple[int, bool]]) -> Iterator[can.Message]:
    """The messages that the bytes mean; `ids`: those of a profile, and whether extended."""
    now_s, at = 1000.0, 0
    for _ in range(_MAX_MESSAGES):
        if at + _HEAD.size > len(data):
            return
        which, flags, length, step = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        payload = data[at : at + length % 65]
        at += len(payload)
        odd_s = _ODD_TIMES_S[step % len(_ODD_TIMES_S)] if flags & _ODD_TIME else None
        now_s += 0.0 if odd_s is not None else step * _STEP_S
        known = which % (len(ids) + 1)
        number, is_extended = ids[known] if known < len(ids) else (_OTHER_ID, False)
        yield can.Message(
            timestamp=now_s if odd_s is None else odd_s,
            arbitration_id=number,
            is_extended_id=is_extended ^ bool(flags & _EXTENDED),
            is_remote_frame=bool(flags & _REMOTE),
            is_error_frame=bool(flags & _ERROR),
            channel=None if flags & _NO_CHANNEL else int(bool(flags & _OTHER_CHANNEL)),
            data=payload,
            is_fd=len(payload) > 8,
        )


def as_bytes(messages: Iterable[can.Message], ids: Sequence[tuple[int, bool]]) -> bytes:
    """The bytes that `traffic` makes these messages of, as far as it can tell them."""
    parts = []
    last_s = None
    for message in messages:
        if last_s is None:
            last_s = message.timestamp
        step = max(-128, min(127, round((message.timestamp - last_s) / _STEP_S)))
        last_s += step * _STEP_S
        address = (message.arbitration_id, message.is_extended_id)
        which = ids.index(address) if address in ids else len(ids)
        parts.append(_HEAD.pack(which, 0, len(message.data), step) + bytes(message.data))
    return b"".join(parts)
