"""The check of one message's checksum and counter, where the profile has them."""

from __future__ import annotations

from eqrt.runtime.decoding.addresses import Address
from eqrt.runtime.decoding.dbc_tables import Payload
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.protection.sequence import Sequence, Status

_OK = Status.OK  # a member's name is looked up slowly, and every message needs it


class MessageCheck:
    """Checks the messages at one address, in the order in which they come."""

    def __init__(self, address: Address, counters: DecoderCounters, silence_s: float) -> None:
        """`silence_s`: as of `Sequence`."""
        self._arbitration_id = address.arbitration_id
        self._checksum = address.checksum
        self._counter = address.counter
        self._sequence = None
        if address.counter is not None:
            self._sequence = Sequence(1 << address.counter.length, silence_s=silence_s)
        self._counters = counters

    def status(self, data: Payload, timestamp_s: float) -> Status:
        """How the message came; counted if it did not come well."""
        if self._checksum is not None and not self._checksum.holds(self._arbitration_id, data):
            self._counters.bad_checksum += 1
            if self._sequence is not None:
                self._sequence.skip()
            return Status.ERROR
        if self._sequence is None or self._counter is None:
            return _OK
        counter = self._counter.raw(data)
        if counter is None:  # cut off
            self._sequence.skip()
            status = Status.ERROR
        else:
            status = self._sequence.follow(counter, timestamp_s)
        self._counters.bad_counter += status is not _OK
        return status


def message_check(
    address: Address, counters: DecoderCounters, silence_s: float
) -> MessageCheck | None:
    """None if there is nothing to check."""
    if address.checksum is None and address.counter is None:
        return None
    return MessageCheck(address, counters, silence_s)
