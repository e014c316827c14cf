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

EQRT = [sys.executable, "-m", "eqrt"]
SERVE = [*EQRT, "serve", "--can", "vcan0", "--profile", "ars408", "--quiet"]


def main(log: str, speed: str, heard: str) -> int:
    """Play the log to a service that is ready, give it time to notice the silence, end it."""
    serve = subprocess.Popen(SERVE, stdout=subprocess.PIPE, text=True)
    assert serve.stdout is not None
    if not serve.stdout.readline():  # what it says when it is ready
        return serve.wait()
    with Path(heard).open("w") as file:
        candump = subprocess.Popen(["candump", "-L", "vcan0"], stdout=file)
        time.sleep(0.3)
        play = subprocess.run([*EQRT, "play", log, "--can", "vcan0", "--speed", speed], check=False)
        time.sleep(1.0)
        serve.send_signal(signal.SIGTERM)
        print(serve.communicate(timeout=5.0)[0])
        candump.terminate()
        candump.wait()
    return serve.returncode or play.returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
