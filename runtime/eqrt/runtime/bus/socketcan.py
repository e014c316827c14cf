"""The kernel's own CAN, SocketCAN: read many messages at a time, sent without waiting.

Layouts and options are those of the kernel's documentation (networking/can.rst) and its header
linux/can.h. python-can reads the same sockets, but tells neither of messages that found the receive
queue full nor of the channel's state; docs/reliability.md compares the two.
"""

from __future__ import annotations

import socket
import struct

import can

from eqrt.runtime.bus.ids import Ids
from eqrt.runtime.bus.kernel_queue import KernelQueue, enlarge

_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000  # beside the id
_STANDARD_MASK, _EXTENDED_MASK = 0x7FF, 0x1FFFFFFF
_BITRATE_SWITCH, _ERROR_STATE = 0x01, 0x02  # in the CAN FD flags
_HEAD = struct.Struct("=IBBxx")  # id with its flags, length, CAN FD flags; then the data
_CLASSIC_BYTES, _FD_BYTES = 16, 72  # of struct can_frame, struct canfd_frame
_MAX_FILTERS = 512  # CAN_RAW_FILTER_MAX
_FILTER = struct.Struct("=II")  # id, mask
_ERROR_FILTER, _ALL_ERRORS = 2, 0x1FFFFFFF  # CAN_RAW_ERR_FILTER, CAN_ERR_MASK


class SocketCan:
    """An open channel."""

    def __init__(self, channel: str, *, fd: bool, receive: Ids | None) -> None:
        """`receive`: None = every message; error frames come in any case, unless it is empty.

        Raises OSError if there is no such channel, or it is not for this user.
        """
        self.channel = channel
        self.protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._wanted = None if receive is None else frozenset(receive)
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            self._socket.setblocking(False)
            self._set_filters()
            enlarge(self._socket)
            if fd:
                self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            self._queue = KernelQueue(self._socket, _FD_BYTES)
            self._socket.bind((channel,))
        except OSError:
            self._socket.close()
            raise

    def _set_filters(self) -> None:
        option = self._socket.setsockopt
        option(socket.SOL_CAN_RAW, _ERROR_FILTER, _ALL_ERRORS)
        if self._wanted is not None and len(self._wanted) <= _MAX_FILTERS:
            filters = b"".join(_filter(*one) for one in sorted(self._wanted))
            option(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)

    def read(self) -> list[can.Message]:
        """What has come, oldest first, perhaps not all of it; empty if nothing has. Never waits.

        Raises OSError if the channel can no longer be read, perhaps before all that waits was.
        """
        buffer = self._queue.buffer
        return [
            self._message(buffer[start : start + size], arrived_s)
            for start, size, arrived_s in self._queue.read()
        ]

    def _message(self, frame: memoryview, arrived_s: float) -> can.Message:
        flagged_id, length, flags = _HEAD.unpack_from(frame)
        is_extended, is_error = flagged_id >= _EXTENDED, bool(flagged_id & _ERROR)
        mask = _EXTENDED_MASK if is_extended or is_error else _STANDARD_MASK
        is_remote, is_fd = bool(flagged_id & _REMOTE), len(frame) == _FD_BYTES
        return can.Message(  # by position, which is twice as fast; see the signature there
            arrived_s,
            flagged_id & mask,
            is_extended,
            is_remote,
            is_error,
            self.channel,
            length,
            None if is_remote else frame[8 : 8 + length],
            is_fd,
            True,
            bool(flags & _BITRATE_SWITCH) and is_fd,
            bool(flags & _ERROR_STATE) and is_fd,
        )

    def drops(self) -> int:
        """How many messages found the receive queue full, and are lost."""
        return self._queue.drops()

    def send(self, msg: can.Message) -> None:
        """Hand a message to the driver; OSError if it takes none now, or the channel is down."""
        flagged_id = (
            msg.arbitration_id
            | (_EXTENDED if msg.is_extended_id else 0)
            | (_REMOTE if msg.is_remote_frame else 0)
            | (_ERROR if msg.is_error_frame else 0)
        )
        flags = (_BITRATE_SWITCH if msg.bitrate_switch else 0) | (
            _ERROR_STATE if msg.error_state_indicator else 0
        )
        frame = _HEAD.pack(flagged_id, msg.dlc, flags if msg.is_fd else 0) + msg.data
        self._socket.send(frame.ljust(_FD_BYTES if msg.is_fd else _CLASSIC_BYTES, b"\0"))

    def fileno(self) -> int:
        """For select: readable when something has come, or the channel is lost."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Close it."""
        self._socket.close()


def _filter(arbitration_id: int, is_extended: bool) -> bytes:
    """What the kernel compares: this very id, and neither remote frames nor the other length."""
    mask = (_EXTENDED_MASK if is_extended else _STANDARD_MASK) | _EXTENDED | _REMOTE
    return _FILTER.pack(arbitration_id | (_EXTENDED if is_extended else 0), mask)
