"""Which messages on the bus a profile means, and what must be true of them."""

from __future__ import annotations

from dataclasses import dataclass

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding.checksums import Checksum, crc8, sum8, xor8
from eqrt.runtime.decoding.dbc_files import DbcMessage
from eqrt.runtime.decoding.profile_schema import ChecksumTable

_MAX_STANDARD_ID, _MAX_EXTENDED_ID = 0x7FF, 0x1FFFFFFF


@dataclass(frozen=True, slots=True, kw_only=True)
class Address:
    """One message on the bus."""

    arbitration_id: int
    is_extended: bool
    checksum: Checksum | None
    needed_bytes: int
    """A shorter message lacks something that the profile asks for."""


def address_of(
    message: DbcMessage,
    checksum: ChecksumTable | None,
    *,
    id_offset: int,
    needed_bytes: int,
    where: str,
) -> Address:
    """Raises ProfileError, led by `where`, if the offset leads out of the range of ids."""
    arbitration_id = message.arbitration_id + id_offset
    highest = _MAX_EXTENDED_ID if message.is_extended else _MAX_STANDARD_ID
    if not 0 <= arbitration_id <= highest:
        raise ProfileError(
            f"{where}: arbitration_id_offset {id_offset:#x} makes {arbitration_id:#x} of "
            f"{message.name}'s id {message.arbitration_id:#x}; ids go from 0 to {highest:#x}"
        )
    return Address(
        arbitration_id=arbitration_id,
        is_extended=message.is_extended,
        checksum=None if checksum is None else _checksum(checksum, where),
        needed_bytes=needed_bytes,
    )


def _checksum(table: ChecksumTable, where: str) -> Checksum:
    for name in ("polynomial", "start", "final_xor"):
        if not 0 <= getattr(table, name) <= 0xFF:
            raise ProfileError(f"{where}.checksum: {name} is {getattr(table, name)}, not 0 to 255")
    combine = {
        "sum8": sum8,
        "xor8": xor8,
        "crc8": crc8(table.polynomial, table.start, table.final_xor),
    }[table.kind]
    return Checksum(
        combine=combine,
        byte=table.byte,
        covers_id=table.covers_id,
        covers_length=table.covers_length,
    )
