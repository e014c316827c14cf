"""`eqrt serve` on a channel that comes late, goes down, comes back and is unplugged at last.

serve_life.py LOG plays the log whenever the channel is there, and prints what was found as JSON.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import restricted
from predicted_cycles import predicted_cycles

EQRT = [sys.executable, "-m", "eqrt"]
RESTRICTED = [sys.executable, restricted.__file__, *EQRT]  # with the sockets of the unit
CHANNEL = "vcan5"
SERVE = [*RESTRICTED, "serve", "--can", CHANNEL, "--profile", "ars408", "--wait-for-bus"]
PATIENCE_S = 30.0


def ip_link(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True)


def wait_for(errors: Path, words: str, times: int) -> None:
    """Until the service has said that so often."""
    give_up_s = time.monotonic() + PATIENCE_S
    while errors.read_text().count(words) < times:
        assert time.monotonic() < give_up_s, errors.read_text()
        time.sleep(0.02)


def predictions(log: str) -> int:
    """How many cycles the service predicts while the log is played."""
    return predicted_cycles(log, CHANNEL, EQRT)


def main(log: str) -> dict[str, object]:
    """From before there is a channel until after."""
    errors, output = Path("errors"), Path("output")
    with errors.open("w") as stderr, output.open("w") as stdout:
        serve = subprocess.Popen(SERVE, stdout=stdout, stderr=stderr)
        wait_for(errors, "waiting for", 1)
        time.sleep(1.0)
        ip_link("add", "dev", CHANNEL, "type", "vcan")
        ip_link("set", CHANNEL, "up", "mtu", "72")
        wait_for(errors, "is there after", 1)
        found: dict[str, object] = {"first": predictions(log)}
        ip_link("set", CHANNEL, "down")
        wait_for(errors, "is lost", 1)
        time.sleep(1.5)
        ip_link("set", CHANNEL, "up")
        wait_for(errors, "is back after", 1)
        found["second"] = predictions(log)
        ip_link("del", CHANNEL)
        wait_for(errors, "is lost", 2)
        time.sleep(1.0)
        found["alive"] = serve.poll() is None
        begun_s = time.monotonic()
        serve.send_signal(signal.SIGTERM)
        found["status"] = serve.wait(PATIENCE_S)
        found["ended_s"] = time.monotonic() - begun_s
    found["errors"], found["output"] = errors.read_text(), output.read_text()
    return found


if __name__ == "__main__":
    print(json.dumps(main(*sys.argv[1:])))
