"""Which messages on the bus a profile means, and what must be true of them."""

from __future__ import annotations

from dataclasses import dataclass

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding.checksum_binding import bind_checksum, counter_signal
from eqrt.runtime.decoding.checksums import Check, E2eCheck
from eqrt.runtime.decoding.dbc_files import DbcMessage
from eqrt.runtime.decoding.dbc_tables import Signal
from eqrt.runtime.decoding.profile_schema import ChecksumTable

_MAX_STANDARD_ID, _MAX_EXTENDED_ID = 0x7FF, 0x1FFFFFFF


@dataclass(frozen=True, slots=True, kw_only=True)
class Address:
    """One message on the bus."""

    name: str
    """In the DBC."""
    arbitration_id: int
    is_extended: bool
    checksum: Check | None
    counter: Signal | None
    """Counts the messages with this id: one more in each."""
    needed_bytes: int
    """A shorter message lacks something that the profile asks for."""


def address_of(
    message: DbcMessage,
    checksum: ChecksumTable | None,
    *,
    counter: Signal | None = None,
    id_offset: int,
    needed_bytes: int,
    where: str,
) -> Address:
    """`counter` counts the messages; that of E2E need not be given.

    Raises ProfileError, led by `where`, if the offset leads out of the range of ids, or the
    checksum makes no sense.
    """
    arbitration_id = message.arbitration_id + id_offset
    highest = _MAX_EXTENDED_ID if message.is_extended else _MAX_STANDARD_ID
    if not 0 <= arbitration_id <= highest:
        raise ProfileError(
            f"{where}: arbitration_id_offset {id_offset:#x} makes {arbitration_id:#x} of "
            f"{message.name}'s id {message.arbitration_id:#x}; ids go from 0 to {highest:#x}"
        )
    check = None
    if checksum is not None:
        check = bind_checksum(checksum, message, arbitration_id, f"{where}.checksum")
    if isinstance(check, E2eCheck):
        counter = counter_signal(check)
    return Address(
        name=message.name,
        arbitration_id=arbitration_id,
        is_extended=message.is_extended,
        checksum=check,
        counter=counter,
        needed_bytes=needed_bytes,
    )
