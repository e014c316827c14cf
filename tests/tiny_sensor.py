"""A made-up sensor small enough to check by hand, and profiles for it in every kind of framing."""

from __future__ import annotations

from pathlib import Path

import can

from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.profile import Profile, load_profile

LIST, FIRST, SECOND, POLAR, PACKED, EGO, GEAR = 0x100, 0x110, 0x120, 0x130, 0x140, 0x150, 0x151

_OBJECT = """ SG_ X : 0|16@1- (0.01,0) [0|0] "m" R
 SG_ Y : 16|16@1- (0.01,0) [0|0] "m" R
 SG_ ID : 32|8@1+ (1,0) [0|0] "" R
 SG_ COUNTER : 40|4@1+ (1,0) [0|0] "" R
 SG_ STATE : 44|4@1+ (1,0) [0|0] "" R
 SG_ RATE : 48|8@1- (0.5,0) [0|0] "m/s" R
"""
_MORE = """ SG_ ID : 0|8@1+ (1,0) [0|0] "" R
 SG_ LENGTH : 8|8@1+ (10,0) [0|0] "cm" R
 SG_ COUNTER : 16|4@1+ (1,0) [0|0] "" R
 SG_ SCORE : 24|8@1+ (0.5,0) [0|100] "%" R
"""
_PACKED = "".join(
    f' SG_ O{i}_X : {at}|16@1- (0.01,0) [0|0] "m" R\n'
    f' SG_ O{i}_Y : {at + 16}|16@1- (0.01,0) [0|0] "m" R\n'
    f' SG_ O{i}_ID : {at + 32}|8@1+ (1,0) [0|0] "" R\n'
    for i, at in ((1, 0), (2, 40), (3, 80))
)

DBC = (
    'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: R\n\n'
    f"BO_ {LIST} LIST: 8 R\n"
    ' SG_ COUNT : 0|8@1+ (1,0) [0|0] "" R\n'
    ' SG_ COUNTER : 8|4@1+ (1,0) [0|0] "" R\n'
    ' SG_ AGE : 16|16@1+ (1,0) [0|0] "ms" R\n\n'
    + "".join(f"BO_ {FIRST + i} FIRST_{i:02d}: 8 R\n{_OBJECT}\n" for i in range(4))
    + "".join(f"BO_ {SECOND + i} SECOND_{i:X}: 4 R\n{_MORE}\n" for i in range(4))
    + f"BO_ {POLAR} POLAR: 8 R\n"
    ' SG_ RANGE : 0|16@1+ (0.1,0) [0|0] "" R\n'
    ' SG_ ANGLE : 16|16@1- (0.1,0) [0|0] "deg" R\n'
    ' SG_ RATE : 32|16@1- (0.1,0) [0|0] "km/h" R\n\n'
    f"BO_ {PACKED} PACKED: 24 R\n{_PACKED}\n"
    f"BO_ {EGO} EGO: 8 R\n"
    ' SG_ LEFT : 0|16@1+ (0.1,0) [0|0] "km/h" R\n'
    ' SG_ RIGHT : 16|16@1+ (0.1,0) [0|0] "km/h" R\n'
    ' SG_ YAW_RATE : 32|16@1- (0.1,0) [0|0] "deg/s" R\n\n'
    f'BO_ {GEAR} GEAR: 1 R\n SG_ GEAR : 0|8@1+ (1,0) [0|0] "" R\n\n'
)

SENSOR = """
description = "a tiny sensor"

[[sensor]]
name = "tiny"
bus = "radar"
dbc = "tiny.dbc"
"""

COUNTED = (
    SENSOR
    + """
framing = "counted"
velocity = "radial"
timeout_s = 0.1

[sensor.header]
message = "LIST"
count = "COUNT"
counter = "COUNTER"
age = "AGE"

[sensor.messages]
first = { message = "FIRST_00", counter = "COUNTER" }
second = { message = "SECOND_0", optional = true }

[sensor.fields]
id = "ID"
x = "first.X"
y = { signal = "first.Y", sign = -1 }
range_rate = "first.RATE"
length = "second.LENGTH"
existence = "second.SCORE"
new_track = "first.STATE == 1"
valid = "first.STATE != 0"
"""
)

SLOTS = (
    SENSOR
    + """
framing = "slots"
slots = { first = 0, last = 3 }
timeout_s = 0.1

[sensor.messages]
first = { message = "FIRST_{slot:02d}", counter = "COUNTER" }
second = "SECOND_{slot:X}"

[sensor.fields]
id = "slot"
x = "first.X"
y = "first.Y"
length = "second.LENGTH"
valid = "first.STATE != 0"
"""
)


_LOADED: dict[tuple[str, str], Profile] = {}


def profile_of(folder: Path, text: str, dbc: str = DBC) -> Profile:
    """The profile that a user would have in a folder, beside its DBC; read once in all tests."""
    (folder / "tiny.dbc").write_text(dbc)
    path = folder / "tiny.toml"
    path.write_text(text)
    if (text, dbc) not in _LOADED:
        _LOADED[text, dbc] = load_profile(str(path))
    return _LOADED[text, dbc]


def decoder_of(folder: Path, text: str) -> Decoder:
    """A decoder for the profile."""
    return Decoder(profile_of(folder, text))


def message(arbitration_id: int, data: bytes, **more: object) -> can.Message:
    """A standard message."""
    return can.Message(
        arbitration_id=arbitration_id,
        data=data,
        is_extended_id=False,
        is_fd=len(data) > 8,
        **more,  # type: ignore[arg-type]  # keywords of can.Message
    )


def header(count: int, counter: int = 0, age_ms: int = 0) -> can.Message:
    """A LIST."""
    return message(LIST, bytes([count, counter]) + age_ms.to_bytes(2, "little") + bytes(4))


def first(
    x_m: float, y_m: float, number: int, *, state: int = 2, counter: int = 0, slot: int = 0
) -> can.Message:
    """A FIRST, at 2 m/s."""
    place = b"".join(round(100 * v).to_bytes(2, "little", signed=True) for v in (x_m, y_m))
    return message(FIRST + slot, place + bytes([number, counter | state << 4, 4, 0]))


def second(
    number: int, length_m: float, *, counter: int = 0, score: int = 100, slot: int = 0
) -> can.Message:
    """A SECOND; the score is in percent."""
    return message(SECOND + slot, bytes([number, round(10 * length_m), counter, 2 * score]))
