"""The `checksum` of a message in a profile, as what checks it."""

from __future__ import annotations

from dataclasses import fields

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding.checksums import Check, Checksum, E2eCheck, sum8, xor8
from eqrt.runtime.decoding.dbc_files import DbcMessage
from eqrt.runtime.decoding.dbc_tables import Signal
from eqrt.runtime.decoding.profile_schema import ChecksumTable
from eqrt.runtime.protection.crc import CCITT, crc_of
from eqrt.runtime.protection.e2e import Profile5, data_id_of

_HEADER_BYTES = 3  # of profile 5
_CRC_KEYS = ("polynomial", "start", "final_xor")
_KEYS = {  # those that not every kind has
    "sum8": ("byte", "covers_id", "covers_length"),
    "xor8": ("byte", "covers_id", "covers_length"),
    "crc8": ("byte", "covers_id", "covers_length", *_CRC_KEYS),
    "crc16": ("byte", "covers_id", "covers_length", "order", *_CRC_KEYS),
    "e2e-p5": ("data_id", "offset"),
}
_SAE_J1850 = {"polynomial": 0x1D, "start": 0xFF, "final_xor": 0xFF}
_CCITT_FALSE = {"polynomial": CCITT, "start": 0xFFFF, "final_xor": 0}


def bind_checksum(
    table: ChecksumTable, message: DbcMessage, arbitration_id: int, where: str
) -> Check:
    """Raises ProfileError, led by `where`, if a key does not go with the kind, or is out of range.

    `arbitration_id` is the one on the bus.
    """
    _check_keys(table, where)
    if table.kind == "e2e-p5":
        return _e2e(table, message, arbitration_id, where)
    size = 2 if table.kind == "crc16" else 1
    combine = {"sum8": sum8, "xor8": xor8}.get(table.kind)
    return Checksum(
        combine=combine or crc_of(8 * size, *_crc_numbers(table, size, where)),
        byte=-size if table.byte is None else table.byte,
        size=size,
        order=table.order,
        covers_id=table.covers_id,
        covers_length=table.covers_length,
    )


def counter_signal(check: E2eCheck) -> Signal:
    """Where a message that is so protected has its counter."""
    place = check.profile.offset + 2
    return Signal(
        name="E2E counter",
        length=8,
        first_byte=place,
        last_byte=place,
        shift=0,
        is_little_endian=True,
        is_signed=False,
        is_float=False,
        scale=1.0,
        offset=0.0,
        unit="",
    )


def _check_keys(table: ChecksumTable, where: str) -> None:
    known = _KEYS[table.kind]
    for field in fields(table):
        is_given = getattr(table, field.name) != field.default
        if is_given and field.name not in ("kind", *known):
            raise ProfileError(
                f"{where}: {field.name} does not go with kind = {table.kind!r}; "
                f"{', '.join(known)} do"
            )


def _crc_numbers(table: ChecksumTable, size: int, where: str) -> list[int]:
    numbers, highest = [], (1 << 8 * size) - 1
    for key, default in (_CCITT_FALSE if size == 2 else _SAE_J1850).items():
        given = getattr(table, key)
        number = default if given is None else given
        if not 0 <= number <= highest:
            raise ProfileError(f"{where}: {key} is {number}, not 0 to {highest}")
        numbers.append(number)
    return numbers


def _e2e(table: ChecksumTable, message: DbcMessage, arbitration_id: int, where: str) -> E2eCheck:
    data_id = data_id_of(arbitration_id) if table.data_id is None else table.data_id
    offset = 0 if table.offset is None else table.offset
    if not 0 <= data_id <= 0xFFFF:
        raise ProfileError(f"{where}: data_id is {data_id}, not 0 to 65535")
    if not 0 <= offset <= message.length - _HEADER_BYTES:
        raise ProfileError(
            f"{where}: offset is {offset}, and the header of {_HEADER_BYTES} bytes must be in the "
            f"{message.length} bytes of {message.name}"
        )
    return E2eCheck(profile=Profile5(data_id=data_id, offset=offset), length=message.length)
