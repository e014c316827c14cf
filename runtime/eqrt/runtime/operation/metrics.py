"""The service's state as Prometheus reads it: the text format, version 0.0.4.

https://prometheus.io/docs/instrumenting/exposition_formats/ says how a line looks; units are base
units (seconds, bytes), counters end in `_total`. docs/operations.md has the table.
"""

from __future__ import annotations

import bisect
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from eqrt.runtime.bus.health import LOST, BusState
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.output.status import ServiceStatus

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BUCKETS_S = (0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2, 0.5)
"""Upper ends of the latency's histogram; the last one is infinity."""
TOTALS_HELP = "Count since the start (docs/output.md)."

_LOST = {state.name for state in LOST}
_SAID_BY_CHANNEL = {"bus_not_up", "bus_losses", "bus_error_frames"}
"""Totals that are no metrics of their own: `eqrt_bus_...` says the same of every channel."""

Labels = dict[str, str]
Sample = tuple[Labels, float]


@dataclass(slots=True)
class Latencies:
    """A histogram since the start."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(BUCKETS_S) + 1))
    sum_s: float = 0.0

    def add(self, latencies_s: Iterable[float]) -> None:
        """Those of another second."""
        for latency_s in latencies_s:
            self.counts[bisect.bisect_left(BUCKETS_S, latency_s)] += 1
            self.sum_s += latency_s


@dataclass(frozen=True, slots=True)
class Metric:
    """A gauge or a counter, made from a status."""

    name: str
    kind: str
    help: str
    samples: Callable[[ServiceStatus], Iterable[Sample]]


def _one(read: Callable[[ServiceStatus], float]) -> Callable[[ServiceStatus], Iterable[Sample]]:
    return lambda status: [({}, read(status))]


METRICS = (
    Metric(
        "eqrt_info",
        "gauge",
        "Always 1; the labels say what is running.",
        lambda s: [
            (
                {
                    "version": s.eqrt,
                    "profile": s.profile,
                    "model": s.model,
                    "model_id": s.model_id,
                    "tile": s.tile,
                    "tile_id": s.tile_id,
                },
                1.0,
            )
        ],
    ),
    Metric("eqrt_uptime_seconds", "gauge", "Since the start.", _one(lambda s: s.uptime_s)),
    Metric(
        "eqrt_mode",
        "gauge",
        "1 for the mode of the newest cycle, 0 for the others.",
        lambda s: [({"mode": mode.name}, float(mode == s.mode)) for mode in Mode],
    ),
    Metric("eqrt_mode_seconds", "gauge", "How long it has been so.", _one(lambda s: s.mode_s)),
    Metric("eqrt_objects", "gauge", "Targets of the newest cycle.", _one(lambda s: s.objects)),
    Metric(
        "eqrt_stage_seconds",
        "gauge",
        "Time that the newest cycle spent, by stage.",
        lambda s: [({"stage": stage}, spent_s) for stage, spent_s in s.stages_s.items()],
    ),
    Metric(
        "eqrt_bus_up",
        "gauge",
        "1 while messages go both ways, also if the controller is error passive.",
        lambda s: [({"channel": bus.channel}, float(bus.state not in _LOST)) for bus in s.buses],
    ),
    Metric(
        "eqrt_bus_state",
        "gauge",
        "1 for the state of the channel, 0 for the others.",
        lambda s: [
            ({"channel": bus.channel, "state": state.name}, float(state.name == bus.state))
            for bus in s.buses
            for state in BusState
        ],
    ),
    Metric(
        "eqrt_bus_losses_total",
        "counter",
        "Times that the channel went away.",
        lambda s: [({"channel": bus.channel}, float(bus.losses)) for bus in s.buses],
    ),
    Metric(
        "eqrt_bus_overflow_messages_total",
        "counter",
        "Messages lost because they were not fetched in time.",
        lambda s: [({"channel": bus.channel}, float(bus.overflow)) for bus in s.buses],
    ),
    Metric(
        "eqrt_bus_error_frames_total",
        "counter",
        "Error frames of the channel.",
        lambda s: [({"channel": bus.channel}, float(bus.error_frames)) for bus in s.buses],
    ),
    Metric(
        "eqrt_source_valid",
        "gauge",
        "1 while the sensor, or the source of the ego's motion, is valid.",
        lambda s: [({"source": source.name}, float(source.valid)) for source in s.sources],
    ),
    Metric(
        "process_resident_memory_bytes",
        "gauge",
        "Memory of the process.",
        _one(lambda _: resident_bytes()),
    ),
    Metric(
        "process_cpu_seconds_total",
        "counter",
        "Processor time that the process has used.",
        _one(lambda _: time.process_time()),
    ),
)
"""Besides them: the histogram `eqrt_latency_seconds`, and `eqrt_NAME_total` for other totals."""


def render(status: ServiceStatus, latencies: Latencies) -> str:
    """All metrics, one line each."""
    lines: list[str] = []
    for metric in METRICS:
        lines += _head(metric.name, metric.kind, metric.help)
        lines += [_line(metric.name, *sample) for sample in metric.samples(status)]
    lines += _histogram(latencies)
    for name, count in status.totals.items():
        if name in _SAID_BY_CHANNEL:
            continue
        lines += _head(f"eqrt_{name}_total", "counter", TOTALS_HELP)
        lines.append(_line(f"eqrt_{name}_total", {}, count))
    return "\n".join(lines) + "\n"


def resident_bytes() -> int:
    """Of this process, now; 0 where there is no /proc."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _histogram(latencies: Latencies) -> Iterator[str]:
    name = "eqrt_latency_seconds"
    what = "From the arrival of a cycle's last message until its predictions had been sent."
    yield from _head(name, "histogram", what)
    total = 0
    for count, limit in zip(latencies.counts, [*map(str, BUCKETS_S), "+Inf"], strict=True):
        total += count
        yield _line(f"{name}_bucket", {"le": limit}, total)
    yield _line(f"{name}_sum", {}, latencies.sum_s)
    yield _line(f"{name}_count", {}, total)


def _head(name: str, kind: str, text: str) -> list[str]:
    return [f"# HELP {name} {text}", f"# TYPE {name} {kind}"]


def _line(name: str, labels: Labels, value: float) -> str:
    if not labels:
        return f"{name} {value!r}"
    told = ",".join(f'{key}="{_escaped(text)}"' for key, text in labels.items())
    return f"{name}{{{told}}} {value!r}"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
