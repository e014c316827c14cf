"""What waits in a socket's receive queue: many datagrams per system call, when each of them came,
and how many found the queue full and are lost.

Linux only. Python's own `recvmsg` reads one datagram per call and, of a CAN socket, asks the kernel
for the channel's name each time. Layouts are those of recvmmsg(2), cmsg(3) and socket(7).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import socket
import struct
import time

BATCH = 64
"""Datagrams read by one system call at most; a full 500 kbit/s bus brings as many in 16 ms."""
RECEIVE_BYTES = 4 << 20
"""Asked for as the size of a receive queue: Linux doubles it, and some 11,000 CAN messages find
room, nearly three seconds of a full 500 kbit/s bus."""
_DONT_WAIT = 0x40  # MSG_DONTWAIT
_TIMESTAMPS, _TELL_DROPS = 35, 40  # SO_TIMESTAMPNS, SO_RXQ_OVFL
_MEMORY, _DROPS = 55, 8  # SO_MEMINFO, and where in it SK_MEMINFO_DROPS stands
_FORCE_BUFFER = 33  # SO_RCVBUFFORCE
_CONTROL = struct.Struct("@Nii")  # length, level and kind of a control message
_TIMESPEC = struct.Struct("@ll")  # s, ns
_COUNT = struct.Struct("@I")
_MEMORY_BYTES = (_DROPS + 1) * _COUNT.size
_NOTHING_YET = (errno.EAGAIN, errno.EINTR)
SENDER_BYTES = 16
"""Of an IPv4 address with its port, struct sockaddr_in."""

Arrival = tuple[int, int, float]
"""Where a datagram starts in the buffer, its length, and the wall-clock time at which it came."""


class _Vector(ctypes.Structure):  # struct iovec
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Message(ctypes.Structure):  # struct msghdr
    _fields_ = (
        ("sender", ctypes.c_void_p),
        ("sender_bytes", ctypes.c_uint32),
        ("vectors", ctypes.c_void_p),
        ("num_vectors", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_bytes", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Header(ctypes.Structure):  # struct mmsghdr
    _fields_ = (("message", _Message), ("datagram_bytes", ctypes.c_uint))


def _aligned(size: int) -> int:
    word = ctypes.sizeof(ctypes.c_size_t)
    return -(-size // word) * word


_CONTROL_START = _aligned(_CONTROL.size)
_STAMP_SPACE = _CONTROL_START + _aligned(_TIMESPEC.size)
_CONTROL_SPACE = _STAMP_SPACE + _CONTROL_START + _aligned(_COUNT.size)
_CONTROL_AT, _LENGTH_AT = _Message.control_bytes.offset, _Header.datagram_bytes.offset
_LENGTHS = struct.Struct(  # of each _Header: bytes of control messages, bytes of the datagram
    f"@{_CONTROL_AT}xN{_LENGTH_AT - _CONTROL_AT - struct.calcsize('N')}x"
    f"I{ctypes.sizeof(_Header) - _LENGTH_AT - _COUNT.size}x"
)


class KernelQueue:
    """The receive queue of one socket, which stays its opener's to close."""

    def __init__(self, receiver: socket.socket, datagram_bytes: int) -> None:
        """Longer datagrams are cut to `datagram_bytes`; what came before has no time of its own."""
        receiver.setsockopt(socket.SOL_SOCKET, _TIMESTAMPS, 1)
        receiver.setsockopt(socket.SOL_SOCKET, _TELL_DROPS, 1)
        self._receiver = receiver
        self._stride = _aligned(datagram_bytes)
        self._drops = 0
        self._data = ctypes.create_string_buffer(BATCH * self._stride)
        self._senders = ctypes.create_string_buffer(BATCH * SENDER_BYTES)
        self._controls = ctypes.create_string_buffer(BATCH * _CONTROL_SPACE)
        self._vectors = (_Vector * BATCH)()
        self._headers = (_Header * BATCH)()
        self._lay_out(datagram_bytes)
        self._fresh = bytes(self._headers)
        self._recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg
        self._control_view = memoryview(self._controls).cast("B")
        self.buffer = memoryview(self._data).cast("B")
        """What was read last; the next `read` writes over it."""
        self.senders = memoryview(self._senders).cast("B")
        """Their socket addresses, `SENDER_BYTES` each."""

    def _lay_out(self, datagram_bytes: int) -> None:
        """Give every datagram its part of the buffers."""
        data, senders = ctypes.addressof(self._data), ctypes.addressof(self._senders)
        controls, vectors = ctypes.addressof(self._controls), ctypes.addressof(self._vectors)
        for i, (vector, header) in enumerate(zip(self._vectors, self._headers, strict=True)):
            vector.base, vector.length = data + i * self._stride, datagram_bytes
            message = header.message
            message.sender, message.sender_bytes = senders + i * SENDER_BYTES, SENDER_BYTES
            message.vectors, message.num_vectors = vectors + i * ctypes.sizeof(_Vector), 1
            message.control = controls + i * _CONTROL_SPACE
            message.control_bytes = _CONTROL_SPACE

    def read(self) -> list[Arrival]:
        """What has come, oldest first, at most `BATCH`; empty if nothing has. Never waits.

        Raises OSError if the socket can no longer be read, perhaps before all that waits was.
        """
        ctypes.memmove(self._headers, self._fresh, len(self._fresh))
        count = self._recvmmsg(self._receiver.fileno(), self._headers, BATCH, _DONT_WAIT, None)
        if count < 0:
            error = ctypes.get_errno()
            if error in _NOTHING_YET:
                return []
            raise OSError(error, os.strerror(error))
        lengths = _LENGTHS.iter_unpack(memoryview(self._headers).cast("B")[: count * _LENGTHS.size])
        controls, stride = self._control_view, self._stride
        arrivals = []
        for i, (control_bytes, length) in enumerate(lengths):
            at = i * _CONTROL_SPACE
            if control_bytes == _STAMP_SPACE:  # a time stamp and nothing else, as nearly always
                seconds, nanoseconds = _TIMESPEC.unpack_from(controls, at + _CONTROL_START)
                arrived_s = seconds + 1e-9 * nanoseconds
            else:
                arrived_s = self._told(controls[at : at + control_bytes])
            arrivals.append((i * stride, length, arrived_s))
        return arrivals

    def _told(self, controls: memoryview) -> float:
        """The time that control messages tell; a number of drops is noted."""
        arrived_s = time.time()
        while len(controls) >= _CONTROL_START:
            length, _, kind = _CONTROL.unpack_from(controls)
            if kind == _TIMESTAMPS:
                seconds, nanoseconds = _TIMESPEC.unpack_from(controls, _CONTROL_START)
                arrived_s = seconds + 1e-9 * nanoseconds
            elif kind == _TELL_DROPS:
                (self._drops,) = _COUNT.unpack_from(controls, _CONTROL_START)
            controls = controls[_aligned(length) :]
        return arrived_s

    def drops(self) -> int:
        """How many datagrams the kernel had no room for, since the socket was opened.

        Exact at any moment from Linux 4.12 on; before, as of the last datagram that was read.
        """
        with contextlib.suppress(OSError):
            told = self._receiver.getsockopt(socket.SOL_SOCKET, _MEMORY, _MEMORY_BYTES)
            if len(told) == _MEMORY_BYTES:
                (self._drops,) = _COUNT.unpack_from(told, _DROPS * _COUNT.size)
        return self._drops


def enlarge(receiver: socket.socket) -> None:
    """Make room for `RECEIVE_BYTES` in a socket's receive queue, or as much as the kernel grants.

    Never makes it smaller. Without CAP_NET_ADMIN the sysctl net.core.rmem_max is the limit.
    """
    level, size = socket.SOL_SOCKET, socket.SO_RCVBUF
    before = receiver.getsockopt(level, size)
    if before < RECEIVE_BYTES:
        try:
            receiver.setsockopt(level, _FORCE_BUFFER, RECEIVE_BYTES)
        except OSError:
            if _granted(receiver) > before:
                receiver.setsockopt(level, size, RECEIVE_BYTES)


def _granted(receiver: socket.socket) -> int:
    """What asking would lead to: less than the default, where that was raised and the limit not."""
    with socket.socket(receiver.family, receiver.type, receiver.proto) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        return trial.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
