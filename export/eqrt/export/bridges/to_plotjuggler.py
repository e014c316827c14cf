"""Numbers to plot, as PlotJuggler's UDP server reads them: MessagePack maps of maps and numbers.

PlotJuggler makes a series of every number and names it after the keys that lead there, `/` between
them. `timestamp` (s, the service's monotonic clock) is in every datagram. What is not known has no
key: NaN is no number to plot. Fields: docs/bridges.md.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from typing import Any, Self

import msgspec
import numpy as np

from eqrt.core.frames import Pose2
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.view.hearing import Ear
from eqrt.runtime.view.updates import ego_pose
from eqrt.runtime.view.words import DROPS

PLOTJUGGLER_ADDRESS = "127.0.0.1:9870"
"""Where PlotJuggler's UDP server listens unless told otherwise."""
MAX_BYTES = 1_400
"""Fits one Ethernet frame, and the 2,048 bytes at which some of PlotJuggler's versions cut off."""
TRACKS_PER_DATAGRAM = 5
"""Of at most 225 bytes each; the cycle's own numbers take as much."""
PREDICTED_S = (1, 2, 3)
_ENCODER = msgspec.msgpack.Encoder()


class ToPlotJuggler:
    """Sends every cycle and every status to one address; nobody has to listen there."""

    def __init__(self, address: str) -> None:
        """`address`: `HOST:PORT`. Raises UsageError."""
        self._publisher = DatagramPublisher([address])
        self._cycles = 0
        self.where = f"PlotJuggler at udp {address}"
        """For the command's first line."""

    def pass_on(self, ear: Ear) -> None:
        """Everything that has come since."""
        for record in ear.records():
            if isinstance(record, ServiceStatus):
                self._publisher.send(encode_status(record, lost_cycles=ear.lost_cycles))
                continue
            self._cycles += 1
            for payload in encode_cycle(record):
                self._publisher.send(payload)

    def told(self) -> str:
        """What was passed on."""
        failed = f", {self._publisher.failed} not taken" if self._publisher.failed else ""
        return f"{self._cycles} cycles in {self._publisher.sent} datagrams{failed}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._publisher.close()


def encode_cycle(forecasts: ForecastSet) -> Iterator[bytes]:
    """The datagrams of one cycle: the first has the cycle, all have some of its tracks."""
    tracks = list(_tracks(forecasts))
    head = _cycle(forecasts)
    for first in range(0, max(1, len(tracks)), TRACKS_PER_DATAGRAM):
        some = dict(tracks[first : first + TRACKS_PER_DATAGRAM])
        yield _ENCODER.encode({"timestamp": forecasts.moment_s, **head, **some})
        head = {}


def encode_status(status: ServiceStatus, *, lost_cycles: int) -> bytes:
    """The service's own word, once a second."""
    numbers: dict[str, Any] = {
        "uptime_s": status.uptime_s,
        "mode_s": status.mode_s,
        "messages_per_s": status.messages / status.seconds if status.seconds > 0 else math.nan,
        "bridge_lost_cycles": lost_cycles,
    }
    if status.latencies_s:
        numbers["latency_median_ms"] = 1e3 * statistics.median(status.latencies_s)
        numbers["latency_worst_ms"] = 1e3 * max(status.latencies_s)
    stages = {f"{name}_ms": 1e3 * stage_s for name, stage_s in status.stages_s.items()}
    drops = {name: status.totals.get(name, 0) for name in DROPS}
    return _ENCODER.encode(
        {
            "timestamp": status.time_s,
            "status": {**_known(numbers), "stages": _known(stages), "drops": drops},
        }
    )


def _cycle(forecasts: ForecastSet) -> dict[str, Any]:
    pose = ego_pose(forecasts)
    head: dict[str, Any] = {
        "mode": int(forecasts.mode),
        "cycle": {
            "number": forecasts.cycle,
            "objects": forecasts.num_targets,
            "fallbacks": int(np.count_nonzero(forecasts.agent_mode == Mode.FALLBACK)),
            "input_age_ms": 1e3 * (forecasts.made_s - forecasts.timestamp_s),
            "oldest_ms": 1e3 * float(forecasts.age_s.max(initial=0.0)),
            "compute_ms": 1e3 * forecasts.compute_s,
        },
    }
    if pose is not None:
        x_m, y_m, yaw_rad = pose
        head["ego"] = {"x": x_m, "y": y_m, "yaw": yaw_rad, "speed": forecasts.ego_speed_mps}
    return head


def _tracks(forecasts: ForecastSet) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and numbers of every track; places in the ego frame, x ahead and y to the left."""
    modes = forecasts.agent_mode.tolist()
    columns = {
        "object": forecasts.object_id.astype(np.float64),
        "age_ms": 1e3 * forecasts.age_s,
        "speed": np.linalg.norm(forecasts.velocity, axis=-1),
    }
    if forecasts.probabilities.shape[1]:
        columns["probability"] = forecasts.probabilities[:, 0]
    if (pose := ego_pose(forecasts)) is not None:
        columns |= _places(forecasts, Pose2(*pose).inverse())
    table = {name: values.tolist() for name, values in columns.items()}
    for row, track_id in enumerate(forecasts.track_id.tolist()):
        numbers = {name: values[row] for name, values in table.items()}
        yield f"track_{track_id}", {"mode": modes[row], **_known(numbers)}


def _places(
    forecasts: ForecastSet, ego_from_map: Pose2
) -> dict[str, np.ndarray[Any, np.dtype[np.float64]]]:
    """Columns: where each target was measured, and where its most probable mode will be."""
    position = ego_from_map.apply(forecasts.position)
    columns = {
        "x": position[:, 0],
        "y": position[:, 1],
        "range": np.linalg.norm(position, axis=-1),
    }
    _, num_modes, horizon, _ = forecasts.trajectories.shape
    for ahead_s in PREDICTED_S:
        step = round(ahead_s / forecasts.dt_s) - 1
        if num_modes and 0 <= step < horizon:
            place = ego_from_map.apply(forecasts.trajectories[:, 0, step])
            columns[f"x_{ahead_s}s"], columns[f"y_{ahead_s}s"] = place[:, 0], place[:, 1]
    return columns


def _known(numbers: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in numbers.items() if math.isfinite(value)}
