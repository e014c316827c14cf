"""Forecasts on the CAN bus: what is sent when, and what happens if the bus does not take it."""

from __future__ import annotations

import can

from eqrt.core.errors import UsageError
from eqrt.runtime.bus.buses import Sender, carries_fd
from eqrt.runtime.output.can_output import Offset, Rows, encode_classic, encode_fd, protect
from eqrt.runtime.output.forecasts import ForecastSet

BASE_ID = 0x6E0
"""The first id unless told otherwise: 16 from here on are free in the production-car and radar DBCs
that we know, and lose arbitration against most of a car's own messages."""
_LAST_STANDARD_ID, _LAST_EXTENDED_ID = 0x7FF, 0x1FFFFFFF


class CanPublisher:
    """Sends every cycle's forecasts on a bus: CAN FD if it carries that, else classic CAN.

    A message that the bus does not take is counted and given up; nothing is raised or waited for.
    """

    def __init__(self, bus: Sender, *, base_id: int = BASE_ID, num_modes: int = 1) -> None:
        """`num_modes`: how many of an object's modes to send on CAN FD, most probable first.

        Raises UsageError if the ids from `base_id` on are not all standard or all extended.
        """
        last_id = base_id + max(Offset)
        if not 0 <= base_id <= _LAST_EXTENDED_ID - max(Offset) or (
            base_id <= _LAST_STANDARD_ID < last_id
        ):
            raise UsageError(
                f"the output's first CAN id is {base_id:#x}; give one up to "
                f"{_LAST_STANDARD_ID - max(Offset):#x}, or an extended one from "
                f"{_LAST_STANDARD_ID + 1:#x} to {_LAST_EXTENDED_ID - max(Offset):#x}"
            )
        self._bus = bus
        self._base_id = base_id
        self._num_modes = num_modes
        self._alive = dict.fromkeys(Offset, 0)
        self.sent = 0
        """Messages that the bus took."""
        self.failed = 0
        """Messages that it did not: its buffer was full, or it is down."""

    @property
    def is_fd(self) -> bool:
        """Whether it sends CAN FD; that may change while a channel is down."""
        return carries_fd(self._bus)

    def publish(self, forecasts: ForecastSet) -> None:
        """Send the messages of one cycle."""
        if self.is_fd:
            messages = encode_fd(forecasts, self._num_modes)
        else:
            messages = encode_classic(forecasts)
        for offset, rows in messages:
            protect(rows, self._base_id + offset, self._alive[offset])
            self._alive[offset] = (self._alive[offset] + len(rows)) & 0xFF
            self._send(self._base_id + offset, rows)

    def counts(self) -> dict[str, int]:
        """Since the start, by name."""
        return {"can_sent": self.sent, "can_failed": self.failed}

    def _send(self, arbitration_id: int, rows: Rows) -> None:
        payload, size, is_fd = rows.tobytes(), rows.itemsize, self.is_fd
        for start in range(0, len(payload), size):
            message = can.Message(
                arbitration_id=arbitration_id,
                is_extended_id=arbitration_id > _LAST_STANDARD_ID,
                is_fd=is_fd,
                bitrate_switch=is_fd,
                is_rx=False,
                data=payload[start : start + size],
            )
            try:
                self._bus.send(message)
            except (can.CanError, OSError):
                self.failed += 1
            else:
                self.sent += 1
