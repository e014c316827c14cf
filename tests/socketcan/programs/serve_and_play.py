"""`eqrt serve` and `eqrt play` as two processes on vcan0, and candump as the third that listens.

serve_and_play.py LOG SPEED HEARD: what candump hears goes to the file HEARD, and what serve prints
after its first line to stdout. The exit status is serve's, or play's if that failed.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import can

EQRT = [sys.executable, "-m", "eqrt"]
SERVE = [*EQRT, "serve", "--can", "vcan0", "--profile", "ars408", "--quiet"]
STATUS, MODE_BYTE, SILENT = 0x6E0, 3, 6  # of eqrt.dbc
CAUGHT_UP_S = 30.0


def main(log: str, speed: str, heard: str) -> int:
    """Play the log to a service that is ready, let it notice the silence after it, end it."""
    serve = subprocess.Popen(SERVE, stdout=subprocess.PIPE, text=True)
    assert serve.stdout is not None
    if not serve.stdout.readline():  # what it says when it is ready
        return serve.wait()
    with Path(heard).open("w") as file:
        candump = subprocess.Popen(["candump", "-L", "vcan0"], stdout=file)
        time.sleep(0.3)
        play = subprocess.run([*EQRT, "play", log, "--can", "vcan0", "--speed", speed], check=False)
        wait_until_silent()
        serve.send_signal(signal.SIGTERM)
        print(serve.communicate(timeout=10.0)[0])
        candump.terminate()
        candump.wait()
    return serve.returncode or play.returncode


def wait_until_silent() -> None:
    """Until the service says nothing but SILENT: it has seen all that was played."""
    filters: list[can.typechecking.CanFilter] = [{"can_id": STATUS, "can_mask": 0x7FF}]
    with can.Bus("vcan0", "socketcan", fd=True, can_filters=filters) as bus:
        give_up_s = time.monotonic() + CAUGHT_UP_S
        in_a_row = 0
        while in_a_row < 5 and time.monotonic() < give_up_s:
            message = bus.recv(1.0)
            in_a_row = in_a_row + 1 if message and message.data[MODE_BYTE] == SILENT else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
