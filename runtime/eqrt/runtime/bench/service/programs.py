"""Starts the processes of a service benchmark and hears what they say."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, Self

from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.schedule import CLOCK
from eqrt.runtime.bench.service.orders import ServiceOrder, TrafficOrder, written

PATIENCE_S = 60.0
"""For what a process should do at once, on a machine that is busy."""
_PACKAGE = "eqrt.runtime.bench.service"


class Program:
    """A process with an order, ended at the end of the `with` block."""

    def __init__(self, order: ServiceOrder | TrafficOrder) -> None:
        self._name = "serving" if isinstance(order, ServiceOrder) else "traffic"
        self.started_ns = CLOCK()
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"{_PACKAGE}.{self._name}", written(order)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"ORT_DISABLE_TELEMETRY": "1"},  # as the predictor sets it
        )

    def wait_for(self, event: str, patience_s: float = PATIENCE_S) -> dict[str, Any] | None:
        """What it says of an event; None if it ended without.

        Raises EqrtError if it failed, or did not say so in time.
        """
        assert self._process.stdout is not None
        too_late = threading.Timer(patience_s, self._process.kill)
        too_late.start()
        try:
            for line in self._process.stdout:
                told: dict[str, Any] = json.loads(line)
                if told["event"] == event:
                    return told
        finally:
            too_late.cancel()
        errors = self._process.communicate()[1].strip().splitlines()
        if self._process.returncode == 0:
            return None
        said = errors[-1] if errors else f"no word of {event!r} in {patience_s:.0f} s"
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
        """Tell it to end; it may still say something."""
        self._process.terminate()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.communicate(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
