"""Opening a CAN bus through python-can, with errors that say what to do.

`socketcan`, the kernel's own, is the default; its channels are network interfaces (`can0`,
`vcan0`). `eqrt_local` joins programs on one machine without any CAN in the kernel.
"""

from __future__ import annotations

import errno
import logging
import socket
import struct
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import can

from eqrt.core.errors import AbsentBusError, BusError, in_one_line
from eqrt.runtime.bus.local_bus import LocalBus

LOCAL = "eqrt_local"
_CAN_HARDWARE = 280  # ARPHRD_CAN, the kernel's type of a CAN network interface
_FD_MTU_BYTES = 72  # of a CAN FD channel; a classic one has 16
_GET_FLAGS, _GET_MTU, _GET_HARDWARE = 0x8913, 0x8921, 0x8927  # SIOCGIFFLAGS, ...MTU, ...HWADDR
_UP = 0x1  # IFF_UP
_ID_MASK = 0x1FFFFFFF
_NOTHING: can.typechecking.CanFilters = [{"can_id": 0x20000000, "can_mask": 0x20000000}]
_UNPRINTED = logging.NullHandler()


def open_bus(
    channel: str,
    interface: str | None = None,
    *,
    fd: bool | None = None,
    receive_ids: Iterable[int] | None = None,
) -> can.BusABC:
    """An open bus; `bus.protocol` says whether it carries CAN FD. Close it with `shutdown()`.

    `interface` is python-can's name for the kind of adapter, None = socketcan. `fd` None = CAN FD
    if the channel can. Only messages with `receive_ids` are received (socketcan: filtered by the
    kernel), perhaps none at all; None = every message. Raises BusError: an AbsentBusError if
    the channel may still come.
    """
    logging.getLogger("can").addHandler(_UNPRINTED)  # else it prints beside our one line
    interface = interface or default_interface()
    filters = None if receive_ids is None else _filters(receive_ids)
    try:
        if interface == LOCAL:
            return LocalBus(channel, filters, fd is not False)
        if interface == "socketcan":
            fd = check_socketcan(channel, fd)
        return can.Bus(channel, interface, can_filters=filters, **_options(interface, fd))
    except BusError:
        raise
    except Exception as error:  # a driver may raise anything, and the user wants one line
        kind = AbsentBusError if interface in interface_names() else BusError
        raise kind(_explanation(channel, interface, error)) from error


def interface_names() -> list[str]:
    """Every `interface` that `open_bus` knows, whether or not its driver is installed."""
    return sorted({LOCAL, *can.VALID_INTERFACES})


class Sender(Protocol):
    """What messages are sent on: a python-can bus, or a channel of a Receiver."""

    @property
    def protocol(self) -> can.CanProtocol:
        """Whether it carries CAN FD."""

    def send(self, msg: can.Message) -> None:
        """Send, without waiting; can.CanError or OSError if it fails."""


def carries_fd(bus: Sender) -> bool:
    """True if CAN FD messages can be sent on it."""
    return bus.protocol is not can.CanProtocol.CAN_20


def default_interface() -> str:
    """SocketCAN; BusError on a system that has none."""
    if sys.platform == "linux":
        return "socketcan"
    names = ", ".join(interface_names())
    raise BusError(f"there is no SocketCAN on this system; give --can-interface, one of {names}")


def _filters(receive_ids: Iterable[int]) -> can.typechecking.CanFilters:
    numbers = sorted(set(receive_ids))
    if not numbers:
        return _NOTHING  # to python-can, an empty list would mean every message
    return [{"can_id": number, "can_mask": _ID_MASK} for number in numbers]


def _options(interface: str, fd: bool | None) -> dict[str, Any]:
    """What this kind of adapter wants to be told about CAN FD."""
    if interface == "virtual":
        is_fd = fd is not False
        return {"protocol": can.CanProtocol.CAN_FD if is_fd else can.CanProtocol.CAN_20}
    if interface == "udp_multicast":
        return {"fd": fd is not False}
    return {} if fd is None else {"fd": fd}  # else left to the adapter and python-can's own files


def _explanation(channel: str, interface: str, error: Exception) -> str:
    if interface not in interface_names():
        return f"there is no CAN interface {interface!r}; known are {', '.join(interface_names())}"
    if interface == LOCAL:
        return f"cannot open CAN channel {channel!r} through {LOCAL}: {error}"
    reason = in_one_line(error)
    if isinstance(error.__cause__, OSError):
        reason += f": {error.__cause__.strerror}"
    advice = "is its driver or Python package installed, and the channel's name right?"
    if interface == "udp_multicast":
        advice = (
            "its channel is a multicast address such as 239.74.163.2, it needs a default route and "
            f"the package msgpack; on one machine use --can-interface {LOCAL}"
        )
    return f"cannot open CAN channel {channel!r} through {interface} ({reason}); {advice}"


# --- SocketCAN


@dataclass(frozen=True, slots=True)
class NetworkInterface:
    """What the kernel says of a network interface."""

    is_can: bool
    is_up: bool
    mtu_bytes: int


def network_interface(name: str) -> NetworkInterface | None:
    """The network interface called `name`, None if there is none. Linux only."""
    from fcntl import ioctl  # noqa: PLC0415 # Linux only, and this module is for every system

    request = struct.pack("16s24x", name.encode()[:16])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        try:
            flags, mtu, hardware = (
                struct.unpack_from(kind, ioctl(control, command, request), 16)[0]
                for kind, command in (("H", _GET_FLAGS), ("i", _GET_MTU), ("H", _GET_HARDWARE))
            )
        except OSError:
            return None
    return NetworkInterface(hardware == _CAN_HARDWARE, bool(flags & _UP), mtu)


def can_channels() -> list[str]:
    """The CAN channels of this machine. Linux only.

    Not by if_nameindex(3), which asks the kernel by netlink: deploy/eqrt.service admits none.
    """
    try:
        lines = Path("/proc/net/dev").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []
    names = [line.partition(":")[0].strip() for line in lines if ":" in line]
    return [name for name in names if (found := network_interface(name)) and found.is_can]


def check_socketcan(channel: str, fd: bool | None) -> bool:
    """Whether to open the channel for CAN FD; BusError if it cannot be used.

    An AbsentBusError if it may still come: it is not there, or down, or the kernel knows no CAN.
    """
    _check_kernel(channel)
    found = network_interface(channel)
    if found is None:
        raise AbsentBusError(
            f"there is no CAN channel {channel!r} ({_channels_found()}); create a virtual one with "
            f"deploy/vcan.sh {channel}, or name another with --can"
        )
    if not found.is_can:
        raise BusError(f"{channel!r} is a network interface, but not a CAN channel")
    if not found.is_up:
        raise AbsentBusError(
            f"the CAN channel {channel!r} is down; switch it on with: sudo ip link set {channel} up"
        )
    if fd and found.mtu_bytes < _FD_MTU_BYTES:
        raise BusError(
            f"the CAN channel {channel!r} is set up for classic CAN; leave out --fd, or set it up "
            f"for CAN FD (virtual: sudo ip link set {channel} mtu {_FD_MTU_BYTES})"
        )
    return found.mtu_bytes >= _FD_MTU_BYTES if fd is None else fd


def _check_kernel(channel: str) -> None:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        if error.errno in (errno.EPERM, errno.EACCES):
            found, advice = "permission denied", "run with the capability CAP_NET_RAW"
        else:
            found = f"this kernel has no SocketCAN: {error.strerror}"
            advice = "load it with: sudo modprobe -a can can_raw vcan"
        raise AbsentBusError(
            f"cannot open CAN channel {channel!r} ({found}); {advice}, or use another adapter with "
            f"--can-interface ({LOCAL} joins programs on this machine and needs none)"
        ) from error


def _channels_found() -> str:
    channels = can_channels()
    return f"found: {', '.join(channels)}" if channels else "this machine has none"
