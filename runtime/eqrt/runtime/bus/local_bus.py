"""A CAN bus between the processes of one machine that needs no CAN in the kernel.

Messages go as datagrams to a multicast group of the loopback interface: nothing leaves the machine,
no route or other network has to exist, and any number of programs may join. Like a real bus it is
shared by all who name the same channel, and a reader that is too slow loses messages. python-can
tools can join with `--interface eqrt_local`. (python-can's own `udp_multicast` wants a default
route, sends into the local network, and brings a further package.)
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import socket
import struct
import sys
import time
from itertools import starmap
from typing import Any

import can

from eqrt.runtime.bus.ids import Ids
from eqrt.runtime.bus.kernel_queue import (
    RECEIVE_BYTES,
    SENDER_BYTES,
    Arrival,
    KernelQueue,
    enlarge,
)

PORT = 43114
_HEADER = struct.Struct("<8sIBBxx")  # channel digest, id and its flags, length, CAN FD flags
_DATAGRAM_BYTES = _HEADER.size + 64
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000  # beside the id, as in SocketCAN
_BITRATE_SWITCH, _ERROR_STATE, _FD = 0x01, 0x02, 0x04  # in the CAN FD flags, as in SocketCAN
_LOOPBACK = "127.0.0.1"
_IP_MULTICAST_ALL = 49  # Linux: if not cleared, groups that others have joined come in as well
_SO_TIMESTAMPNS = 35  # Linux: the kernel says when a datagram came, however late it is read
_TIMESPEC = struct.Struct("@ll")  # s, ns


class LocalBus(can.BusABC):
    """One program's place on the bus of this machine that is called `channel`."""

    def __init__(
        self,
        channel: can.typechecking.Channel = "can0",
        can_filters: can.typechecking.CanFilters | None = None,
        fd: bool = True,
        **kwargs: Any,  # python-can hands every interface what its configuration files say
    ) -> None:
        """Raises can.CanInitializationError if there is no loopback network."""
        super().__init__(channel, can_filters=can_filters, **kwargs)
        self.channel = channel
        self.channel_info = f"eqrt_local channel '{channel}'"
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._digest = hashlib.blake2b(str(channel).encode(), digest_size=8).digest()
        self._destination = (_group(self._digest), PORT)
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._join()
        except OSError as error:
            self.shutdown()
            problem = f"no loopback network ({error.strerror}); switch it on: ip link set lo up"
            if error.errno == errno.EADDRINUSE:
                problem = f"another program keeps UDP port {PORT} for itself; end it"
            raise can.CanInitializationError(problem) from error

    def _join(self) -> None:
        loopback = socket.inet_aton(_LOOPBACK)
        group = socket.inet_aton(self._destination[0])
        self._sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, loopback)
        self._sender.bind((_LOOPBACK, 0))
        self._sender.setblocking(False)
        self._address = self._sender.getsockname()
        self._receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if sys.platform == "linux":
            enlarge(self._receiver)
        else:
            self._receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        with contextlib.suppress(OSError):  # another system than Linux
            self._receiver.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        if sys.platform == "linux":
            self._receiver.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._receiver.bind(self._destination)
        self._receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group + loopback)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Hand the message to all others on the channel; never waits."""
        if msg.is_fd and self._can_protocol is not can.CanProtocol.CAN_FD:
            raise can.CanOperationError("a CAN FD message on a classic CAN bus")
        try:
            self._sender.sendto(_pack(self._digest, msg), self._destination)
        except OSError as error:
            raise can.CanOperationError(f"cannot send: {error.strerror}", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            self._receiver.settimeout(timeout)
            datagram, arrived_s, sender = self._read()
        except (TimeoutError, BlockingIOError):
            return None, False
        except OSError as error:
            raise can.CanOperationError(f"cannot receive: {error.strerror}", error.errno) from error
        is_ours = sender != self._address and datagram[:8] == self._digest
        if not is_ours or len(datagram) < _HEADER.size:
            return None, False
        message = _unpack(datagram, str(self.channel), arrived_s)
        if message.is_fd and self._can_protocol is not can.CanProtocol.CAN_FD:
            return None, False
        return message, False

    def _read(self) -> tuple[bytes, float, Any]:
        """A datagram, the wall-clock time at which it came, and who sent it."""
        if sys.platform != "linux":
            datagram, sender = self._receiver.recvfrom(_DATAGRAM_BYTES)
            return datagram, time.time(), sender
        datagram, told, _, sender = self._receiver.recvmsg(
            _DATAGRAM_BYTES, socket.CMSG_SPACE(_TIMESPEC.size)
        )
        for _, kind, stamp in told:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack(stamp)
                return datagram, seconds + 1e-9 * nanoseconds, sender
        return datagram, time.time(), sender

    def fileno(self) -> int:
        """For select: readable when a message may have come."""
        return self._receiver.fileno()

    @property
    def own_address(self) -> bytes:
        """Port and address of what this sends, as in struct sockaddr_in."""
        host, port = self._address
        return struct.pack("!H4s", port, socket.inet_aton(host))

    def batches(self, receive: Ids | None) -> LocalReader:
        """What reads many messages at a time, and closes this bus with itself. Linux only.

        `receive`: None = every message; error frames come in any case, unless it is empty.
        """
        return LocalReader(self, self._receiver, self._digest, receive)

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._sender.close()
        self._receiver.close()


class LocalReader:
    """A place on the bus of this machine that is read many messages at a time."""

    def __init__(
        self, bus: LocalBus, receiver: socket.socket, digest: bytes, receive: Ids | None
    ) -> None:
        """See `LocalBus.batches`."""
        self._bus = bus
        self._digest = digest
        self._own = bus.own_address
        self._is_fd = bus.protocol is can.CanProtocol.CAN_FD
        self._queue = KernelQueue(receiver, _DATAGRAM_BYTES)
        self._wanted = None if receive is None else frozenset(starmap(_flagged, receive))

    @property
    def protocol(self) -> can.CanProtocol:
        """Whether it carries CAN FD."""
        return self._bus.protocol

    def fileno(self) -> int:
        """For select: readable when a message may have come."""
        return self._bus.fileno()

    def read(self) -> list[can.Message]:
        """What has come, oldest first, perhaps not all of it; empty if nothing has. Never waits.

        Raises OSError if the bus can no longer be read.
        """
        messages: list[can.Message] = []
        while not messages and (arrivals := self._queue.read()):
            messages = self._ours(arrivals)
        return messages

    def _ours(self, arrivals: list[Arrival]) -> list[can.Message]:
        """Without what this sent itself, and what other channels sent to the same group."""
        buffer, senders, channel = self._queue.buffer, self._queue.senders, str(self._bus.channel)
        messages = []
        for i, (start, length, arrived_s) in enumerate(arrivals):
            sender = senders[i * SENDER_BYTES + 2 : i * SENDER_BYTES + 8]  # its port and address
            datagram = buffer[start : start + length]
            if sender != self._own and datagram[:8] == self._digest and self._wants(datagram):
                messages.append(_unpack(datagram, channel, arrived_s))
        return messages

    def _wants(self, datagram: memoryview) -> bool:
        if len(datagram) < _HEADER.size:
            return False
        _, flagged_id, _, flags = _HEADER.unpack_from(datagram)
        if flags & _FD and not self._is_fd:
            return False
        if self._wanted is None or flagged_id in self._wanted:
            return True
        return bool(flagged_id & _ERROR and self._wanted)

    def drops(self) -> int:
        """How many datagrams found the receive queue full, and are lost.

        Among them may be some of other channels whose names lead to the same multicast group.
        """
        return self._queue.drops()

    def send(self, msg: can.Message) -> None:
        """As LocalBus's own."""
        self._bus.send(msg)

    def shutdown(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


def _flagged(arbitration_id: int, is_extended: bool) -> int:
    return arbitration_id | (_EXTENDED if is_extended else 0)


def _group(digest: bytes) -> str:
    """The multicast group of a channel, within what is kept for private use (239.192.0.0/14)."""
    return f"239.{192 + digest[0] % 4}.{digest[1]}.{digest[2]}"


def _pack(digest: bytes, message: can.Message) -> bytes:
    flagged_id = (
        message.arbitration_id
        | (_EXTENDED if message.is_extended_id else 0)
        | (_REMOTE if message.is_remote_frame else 0)
        | (_ERROR if message.is_error_frame else 0)
    )
    flags = (
        (_FD if message.is_fd else 0)
        | (_BITRATE_SWITCH if message.bitrate_switch else 0)
        | (_ERROR_STATE if message.error_state_indicator else 0)
    )
    return _HEADER.pack(digest, flagged_id, message.dlc, flags) + message.data


def _unpack(datagram: bytes | memoryview, channel: str, arrived_s: float) -> can.Message:
    """The message of a datagram of this format."""
    _, flagged_id, length, flags = _HEADER.unpack_from(datagram)
    return can.Message(  # by position, which is twice as fast; see the signature there
        arrived_s,
        flagged_id & 0x1FFFFFFF,
        bool(flagged_id & _EXTENDED),
        bool(flagged_id & _REMOTE),
        bool(flagged_id & _ERROR),
        channel,
        length if flagged_id & _REMOTE else None,  # else as many as have come
        datagram[_HEADER.size :],
        bool(flags & _FD),
        True,
        bool(flags & _BITRATE_SWITCH),
        bool(flags & _ERROR_STATE),
    )
