"""Protocol buffer messages without the protobuf package: field numbers and raw values.

`fields` walks through a message; `number`, `text` and `nested` make the fields of one.
"""

from __future__ import annotations

from collections.abc import Iterator

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_FIXED = {_FIXED64: 8, _FIXED32: 4}


def fields(message: bytes | memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Field numbers and values: an int for a varint, else the bytes of the value.

    Raises ValueError or IndexError, while iterating, where the bytes are no message.
    """
    view = memoryview(message)
    at = 0
    while at < len(view):
        key, at = _varint(view, at)
        field, wire_type = key >> 3, key & 7
        if wire_type == _VARINT:
            value, at = _varint(view, at)
            yield field, value
            continue
        if wire_type == _BYTES:
            size, at = _varint(view, at)
        elif wire_type in _FIXED:
            size = _FIXED[wire_type]
        else:
            raise ValueError(f"wire type {wire_type}")
        if at + size > len(view):
            raise ValueError("truncated")
        yield field, view[at : at + size]
        at += size


def varints(packed: memoryview) -> Iterator[int]:
    """The numbers of a packed repeated field."""
    at = 0
    while at < len(packed):
        value, at = _varint(packed, at)
        yield value


def number(field: int, value: int) -> bytes:
    """A field that is a whole number, 0 or more."""
    return _written(field << 3 | _VARINT) + _written(value)


def text(field: int, value: str) -> bytes:
    """A field that is text."""
    return nested(field, value.encode())


def nested(field: int, content: bytes) -> bytes:
    """A field that is a message, or bytes."""
    return _written(field << 3 | _BYTES) + _written(len(content)) + content


def _written(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _varint(view: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = view[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
        if shift > 63:
            raise ValueError("a number longer than 64 bits")
