"""Starts the processes of a service benchmark and hears what they say."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Self

from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.schedule import CLOCK
from eqrt.runtime.bench.service.orders import ServiceOrder, TrafficOrder, written

PATIENCE_S = 60.0
"""For what a process should do at once, on a machine that is busy."""
_LOOK_S = 0.2  # how often it is asked whether to stop
_NOTHING = {
    "first": "no prediction",
    "measuring": "too few predictions",
}
"""What it means that a service does not say this."""
_PACKAGE = "eqrt.runtime.bench.service"


class Program:
    """A process with an order, ended at the end of the `with` block, or when `should_stop`."""

    def __init__(self, order: ServiceOrder | TrafficOrder, should_stop: Callable[[], bool]) -> None:
        self._name = "serving" if isinstance(order, ServiceOrder) else "traffic"
        self._should_stop = should_stop
        self._is_told = False
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed by __exit__)
        self.started_ns = CLOCK()
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"{_PACKAGE}.{self._name}", written(order)],
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=os.environ | {"ORT_DISABLE_TELEMETRY": "1"},  # as the predictor sets it
        )
        self._said: Queue[str | None] = Queue()
        self._ear = threading.Thread(target=self._listen)
        self._ear.start()

    def wait_for(self, event: str, patience_s: float = PATIENCE_S) -> dict[str, Any] | None:
        """What it says of an event; None if it ended without, as it does when told to stop.

        Raises EqrtError if it failed, or did not say so in time.
        """
        give_up_ns = CLOCK() + round(1e9 * patience_s)
        while (line := self._next_line(give_up_ns)) is not None:
            told: dict[str, Any] = json.loads(line)
            if told["event"] == event:
                return told
        self._said.put(None)  # whoever asks next is told the same
        if self._process.wait() == 0 or self._should_stop():
            return None
        self._errors.seek(0)
        errors = self._errors.read().strip().splitlines()
        nothing = _NOTHING.get(event, f"no word of {event!r}")
        said = errors[-1] if errors else f"{nothing} within {patience_s:.0f} s"
        raise EqrtError(f"the process of the {self._name} failed: {said}")

    def cpu_s(self) -> float:
        """CPU time that it has used so far; 0 if it has ended."""
        try:
            stat = Path(f"/proc/{self._process.pid}/stat").read_text(encoding="utf-8")
        except OSError:
            return 0.0
        fields = stat.rpartition(")")[2].split()  # proc(5): from the third field on
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def stop(self) -> None:
        """Tell it to end, once: a second signal would not let it say what it has."""
        if not self._is_told:
            self._is_told = True
            self._process.terminate()

    def _next_line(self, give_up_ns: int) -> str | None:
        """None at the end of all it says; which is soon, after `give_up_ns`."""
        while True:
            try:
                return self._said.get(timeout=_LOOK_S)
            except Empty:
                if CLOCK() > give_up_ns:
                    self._process.kill()
                elif self._should_stop():
                    self.stop()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._said.put(line)
        self._said.put(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._ear.join()
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._errors.close()
