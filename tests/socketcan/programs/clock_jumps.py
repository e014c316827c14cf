"""`eqrt serve` with traffic on vcan0 while the wall clock is set: an hour, and some seconds.

Only in a machine of its own: it refuses to set the clock of any other kernel than User-Mode
Linux's. Prints as JSON, for every jump, the cycles sent and the predictions that came of them, all
times on the monotonic clock, which both processes share.
"""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drives import Car, cycle
from eqrt.runtime.bus.buses import open_bus
from eqrt.runtime.output.datagrams import decode_datagram
from eqrt.runtime.output.status import ServiceStatus
from processes import Serving

CHANNEL = "vcan0"
PERIOD_S = 0.1
CAR = Car(object_id=1, x_m=10.0, y_m=3.0, speed_mps=1.0)
"""Where it is tells in which step it was sent."""
AROUND_S = 1.5
"""Traffic before and after each jump."""
HELD_S = 0.25  # less than three periods: held up for longer, silence would be true
JUMPS_S = (0.0, 3600.0, -3600.0, 5.0, -5.0)


class Sensor:
    """Sends the car ten times a second, and remembers when."""

    def __init__(self) -> None:
        self.sent: list[list[float]] = []
        """Of each cycle: the time before its first message, after that, and after its last."""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._send)

    def _send(self) -> None:
        begun_s = time.monotonic()
        with open_bus(CHANNEL, "socketcan", fd=True, receive_ids=[]) as bus:
            for step in range(1_000_000):
                messages = cycle([CAR], step * PERIOD_S)
                if self._over.wait(max(0.0, begun_s + step * PERIOD_S - time.monotonic())):
                    return
                times_s = [time.monotonic()]
                for message in messages:
                    bus.send(message)
                    times_s.append(time.monotonic())
                self.sent.append([times_s[0], times_s[1], times_s[-1]])

    def __enter__(self) -> Sensor:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()


class Listener:
    """Hears the service's datagrams, and when they came."""

    def __init__(self) -> None:
        self.predictions: list[dict[str, Any]] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        self.address = f"127.0.0.1:{self._socket.getsockname()[1]}"
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen)

    def _listen(self) -> None:
        while not self._over.is_set():
            with contextlib.suppress(TimeoutError):
                heard = decode_datagram(self._socket.recv(65_535))
                if not isinstance(heard, ServiceStatus):
                    self._note(heard.forecasts)

    def _note(self, forecasts: Any) -> None:
        self.predictions.append(
            {
                "heard_s": time.monotonic(),
                "cycle": forecasts.cycle,
                "measured_s": forecasts.timestamp_s,
                "made_s": forecasts.made_s,
                "mode": forecasts.mode.name,
                "x_m": forecasts.position[:, 0].tolist(),
            }
        )

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._socket.close()


def set_clock(by_s: float) -> None:
    """Move CLOCK_REALTIME."""
    time.clock_settime(time.CLOCK_REALTIME, time.time() + by_s)


@contextlib.contextmanager
def held(service: Serving, seconds: float) -> Iterator[None]:
    """The service stands still for some time: what comes meanwhile waits in the kernel's queue."""
    if not seconds:
        yield
        return
    service.send(signal.SIGSTOP)
    time.sleep(seconds / 2.0)
    yield
    time.sleep(seconds / 2.0)
    service.send(signal.SIGCONT)


def main() -> int:
    """Every jump, while the service waits for messages and while messages wait for it."""
    if "User Mode Linux" not in Path("/proc/cpuinfo").read_text(encoding="utf-8"):
        print("clock_jumps.py: sets the clock only in User-Mode Linux", file=sys.stderr)
        return 2
    arguments = ("--can", CHANNEL, "--profile", "generic", "--quiet")
    with (
        Listener() as listener,
        Serving(*arguments, "--datagrams", listener.address) as service,
    ):
        with Sensor() as sensor:
            jumps = [jump(service, by_s, held_s) for held_s in (0.0, HELD_S) for by_s in JUMPS_S]
            time.sleep(AROUND_S)
        time.sleep(AROUND_S)
        status, stdout, stderr = service.end()
    told = {"status": status, "stdout": stdout, "stderr": stderr}
    told |= {"jumps": jumps, "sent": sensor.sent, "predictions": listener.predictions}
    print(json.dumps(told))
    return 0


def jump(service: Serving, by_s: float, held_s: float) -> dict[str, float]:
    """Set the clock after some traffic, while the service is held up for so long."""
    time.sleep(AROUND_S)
    with held(service, held_s):
        wall_s, at_s = time.time(), time.monotonic()
        set_clock(by_s)
        moved_s = time.time() - wall_s - (time.monotonic() - at_s)
    return {"by_s": by_s, "held_s": held_s, "at_s": at_s, "moved_s": moved_s}


if __name__ == "__main__":
    sys.exit(main())
