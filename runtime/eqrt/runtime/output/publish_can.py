"""Forecasts on the CAN bus: what is sent when, and what happens if the bus does not take it."""

from __future__ import annotations

from collections.abc import Iterator

import can
import numpy as np

from eqrt.core.errors import UsageError
from eqrt.runtime.bus.outbox import Outbox
from eqrt.runtime.output.can_output import Offset, Rows, encode_classic, encode_fd, protect
from eqrt.runtime.output.forecasts import ForecastSet

BASE_ID = 0x6E0
"""The first id unless told otherwise: 16 from here on are free in the production-car and radar DBCs
that we know, and lose arbitration against most of a car's own messages."""
_LAST_STANDARD_ID, _LAST_EXTENDED_ID = 0x7FF, 0x1FFFFFFF


class CanPublisher:
    """Sends every cycle's forecasts on a bus: CAN FD if it carries that, else classic CAN.

    The nearest object goes first, each with all that is said of it, so that a bus without room for
    everything loses the farthest. What it has not taken when the next cycle comes is counted and
    given up; nothing is raised or waited for.
    """

    def __init__(self, outbox: Outbox, *, base_id: int = BASE_ID, num_modes: int = 1) -> None:
        """`num_modes`: how many of an object's modes to send on CAN FD, most probable first.

        Raises UsageError if the ids from `base_id` on are not all standard or all extended.
        """
        check_base_id(base_id)
        self._outbox = outbox
        self._base_id = base_id
        self._num_modes = num_modes
        self._alive = dict.fromkeys(Offset, 0)

    @property
    def sent(self) -> int:
        """Messages that the bus took."""
        return self._outbox.sent

    @property
    def failed(self) -> int:
        """Messages that it did not take until the next cycle: it was full, or down."""
        return self._outbox.failed

    @property
    def is_fd(self) -> bool:
        """Whether it sends CAN FD; that may change while a channel is down."""
        return self._outbox.is_fd

    def publish(self, forecasts: ForecastSet) -> None:
        """Send the messages of one cycle instead of what is left of the one before."""
        for message in self._outbox.give_up():
            # Not sent is not lost: else the loss of the last would make receivers refuse the first.
            self._alive[Offset(message.arbitration_id - self._base_id)] -= 1
        forecasts = nearest_first(forecasts)
        is_fd = self.is_fd
        encoded = encode_fd(forecasts, self._num_modes) if is_fd else encode_classic(forecasts)
        messages: list[tuple[int, can.Message]] = []
        for offset, rows in encoded:
            protect(rows, self._base_id + offset, self._alive[offset] & 0xFF)
            self._alive[offset] += len(rows)
            places = _places(rows)
            messages += zip(places, _messages(self._base_id + offset, rows, is_fd), strict=True)
        messages.sort(key=lambda one: one[0])  # stable: an object, then its points
        self._outbox.put(message for _, message in messages)

    def counts(self) -> dict[str, int]:
        """Since the start, by name."""
        return {"can_sent": self.sent, "can_failed": self.failed}


def check_base_id(base_id: int) -> None:
    """UsageError if the ids from there on are not all standard or all extended."""
    last_id = base_id + max(Offset)
    if not 0 <= base_id <= _LAST_EXTENDED_ID - max(Offset) or (
        base_id <= _LAST_STANDARD_ID < last_id
    ):
        raise UsageError(
            f"the output's first CAN id is {base_id:#x}; give one up to "
            f"{_LAST_STANDARD_ID - max(Offset):#x}, or an extended one from "
            f"{_LAST_STANDARD_ID + 1:#x} to {_LAST_EXTENDED_ID - max(Offset):#x}"
        )


def nearest_first(forecasts: ForecastSet) -> ForecastSet:
    """The same cycle, its targets by their distance from the ego vehicle, if that is known."""
    ego = forecasts.map_from_ego
    if ego is None:
        return forecasts
    offset = forecasts.position - (ego.x_m, ego.y_m)
    return forecasts.targets(np.argsort(np.hypot(offset[:, 0], offset[:, 1]), kind="stable"))


def _places(rows: Rows) -> list[int]:
    """Which object each message is about; -1 = about the cycle."""
    if "object_index" not in (rows.dtype.names or ()):
        return [-1] * len(rows)
    return [int(index) for index in rows["object_index"]]


def _messages(arbitration_id: int, rows: Rows, is_fd: bool) -> Iterator[can.Message]:
    payload, size = rows.tobytes(), rows.itemsize
    for start in range(0, len(payload), size):
        yield can.Message(
            arbitration_id=arbitration_id,
            is_extended_id=arbitration_id > _LAST_STANDARD_ID,
            is_fd=is_fd,
            bitrate_switch=is_fd,
            is_rx=False,
            data=payload[start : start + size],
        )
