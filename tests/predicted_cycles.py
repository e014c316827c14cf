"""How much of a log a service predicts that listens on a SocketCAN bus."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence

import can

STATUS, MODE_BYTE, NUM_OBJECTS_BYTE, SILENT = 0x6E0, 3, 5, 6  # of eqrt.dbc
PATIENCE_S = 30.0


def predicted_cycles(log: str, channel: str, eqrt: Sequence[str]) -> int:
    """Cycles with predictions while `eqrt play` plays the log, until the service is silent."""
    filters: list[can.typechecking.CanFilter] = [{"can_id": STATUS, "can_mask": 0x7FF}]
    with can.Bus(channel, "socketcan", fd=True, can_filters=filters) as bus:
        subprocess.run([*eqrt, "play", log, "--can", channel], check=True, capture_output=True)
        is_silent, told = False, 0
        while not is_silent:
            message = bus.recv(PATIENCE_S)
            assert message is not None
            is_silent = told > 0 and message.data[MODE_BYTE] == SILENT
            told += message.data[NUM_OBJECTS_BYTE] > 0
        return told
