"""Open connections as a receiver wants them: read without waiting, whatever kind of adapter."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Protocol

import can

from eqrt.core.errors import BusError
from eqrt.runtime.bus.adapter import Adapter
from eqrt.runtime.bus.buses import check_socketcan, default_interface, open_bus
from eqrt.runtime.bus.ids import Ids
from eqrt.runtime.bus.local_bus import LocalBus
from eqrt.runtime.bus.socketcan import SocketCan


class Link(Protocol):
    """An open channel."""

    @property
    def protocol(self) -> can.CanProtocol:
        """Whether it carries CAN FD."""

    def fileno(self) -> int:
        """For select: readable when something has come, or the channel is lost."""

    def read(self) -> list[can.Message]:
        """What has come, oldest first, perhaps not all of it; empty if nothing has. Never waits.

        Stamped by this machine's wall clock. Raises OSError or can.CanError if the channel can no
        longer be read, perhaps before all that waits was.
        """

    def send(self, msg: can.Message) -> None:
        """Hand a message to the driver, without waiting; OSError or can.CanError if it fails."""

    def drops(self) -> int | None:
        """How many messages found the receive queue full, and are lost; None = it cannot tell."""

    def shutdown(self) -> None:
        """Close it."""


OpenLink = Callable[[str, Ids | None], Link]
"""Opens a channel for messages of these ids, None = all; raises BusError."""


def opener(interface: str | None, *, fd: bool | None) -> OpenLink:
    """`open_link` for one kind of adapter."""
    return lambda channel, ids: open_link(channel, interface, fd=fd, receive=ids)


def open_link(channel: str, interface: str | None, *, fd: bool | None, receive: Ids | None) -> Link:
    """An open channel: SocketCAN and the local bus read by our own readers, others by python-can.

    `interface` and `fd` are as for `open_bus`; `receive` None = every message. Raises BusError;
    AbsentBusError if that may change by itself.
    """
    interface = interface or default_interface()
    if interface == "socketcan":
        fd = check_socketcan(channel, fd)
        try:
            return SocketCan(channel, fd=fd, receive=receive)
        except OSError as error:
            raise BusError(f"cannot open CAN channel {channel!r}: {error.strerror}") from error
    ids = None if receive is None else [number for number, _ in receive]
    bus = open_bus(channel, interface, fd=fd, receive_ids=ids)
    if isinstance(bus, LocalBus) and sys.platform == "linux":
        return bus.batches(receive)
    return Adapter(bus, channel)
