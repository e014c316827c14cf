"""The text that `candump -L` writes, a line per message.

(1591372012.436348) can0 60A#01C24910            id, data: classic CAN
(1591372012.436349) can0 18DAF110#0211 R         8-digit id: extended; R or T: the direction
(1591372012.436350) can1 384##1112233            ##: CAN FD, a flag digit, data
(1591372012.436351) can0 123#R8                  a remote frame and its length
(1591372012.436352) can0 20000080#0000000000000000    a bus error and its class
"""

from __future__ import annotations

import can

_ERROR_FLAG = 0x20000000  # SocketCAN's CAN_ERR_FLAG, above the 29 bits of an id
_MAX_STANDARD_ID = 0x7FF
_MAX_EXTENDED_ID = 0x1FFFFFFF
_MAX_TIME_S = 1e11  # the year 5138; a comparison that NaN and infinity fail as well
_FD, _REMOTE = "#", ("R", "r")
_RECEIVED = ("R", "r")


def candump_message(line: str) -> can.Message:
    """The message of one line, equal to what python-can reads; ValueError if there is none.

    Unlike python-can, every kind of bus error is an error frame here and keeps its class as id.
    """
    fields = line.split()
    if not 3 <= len(fields) <= 4:
        raise ValueError("not a line of candump")
    name, mark, payload = fields[2].partition("#")
    kind, flags = payload[:1], 0
    if kind == _FD:
        flags, payload = int(payload[1:2], 16), payload[2:]
    is_remote = kind in _REMOTE
    data = bytearray() if is_remote else bytearray.fromhex(payload)
    length = int(payload[1:] or "0") if is_remote else len(data)
    timestamp_s, arbitration_id, is_extended = float(fields[0][1:-1]), int(name, 16), len(name) > 3
    is_error = arbitration_id > _MAX_EXTENDED_ID and bool(arbitration_id & _ERROR_FLAG)
    if is_error:
        arbitration_id ^= _ERROR_FLAG
    if (
        not mark
        or not 0 <= arbitration_id <= (_MAX_EXTENDED_ID if is_extended else _MAX_STANDARD_ID)
        or not 0 <= length <= (64 if kind == _FD else 8)
        or not 0.0 <= timestamp_s < _MAX_TIME_S
    ):
        raise ValueError("not a CAN message")
    return can.Message(  # by position, which is a quarter faster; see the signature there
        timestamp_s,
        arbitration_id,
        is_extended,
        is_remote,
        is_error,
        int(fields[1]) if fields[1].isdigit() else fields[1],
        length,
        data,
        kind == _FD,
        len(fields) == 3 or fields[3] in _RECEIVED,
        bool(flags & 1),
        bool(flags & 2),
    )


def candump_line(message: can.Message) -> str:
    """The line that `candump_message` reads as this message, but for a microsecond's rounding."""
    number = message.arbitration_id | (_ERROR_FLAG if message.is_error_frame else 0)
    name = f"{number:08X}" if message.is_extended_id or message.is_error_frame else f"{number:03X}"
    if message.is_remote_frame:
        payload = f"#R{message.dlc}"
    elif message.is_fd:
        flags = message.bitrate_switch | 2 * message.error_state_indicator
        payload = f"##{flags:X}{message.data.hex().upper()}"
    else:
        payload = f"#{message.data.hex().upper()}"
    direction = "R" if message.is_rx else "T"
    channel = "can0" if message.channel is None else message.channel
    return f"({message.timestamp:.6f}) {channel} {name}{payload} {direction}\n"
