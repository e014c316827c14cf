"""The predictions of a recording with their wall-clock times, for programs that know no other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.recording.reader import Exchanged, Recording
from eqrt.runtime.recording.topics import Topic

_SHOWN = frozenset({Topic.FORECASTS, Topic.STATUS})


@dataclass(frozen=True, slots=True)
class Moment:
    """One cycle, or one report, and what the wall clock said."""

    log_ns: int
    """When it was recorded, ns since 1970."""
    entry: ForecastSet | ServiceStatus
    attached: Mapping[str, bytes]
    """The files that travel with it, by name: the tile among them."""

    def wall_ns(self, time_s: float) -> int:
        """The wall-clock time of `time_s` on the service's clock; exact to the recording's delay,
        some milliseconds.
        """
        said_s = self.entry.made_s if isinstance(self.entry, ForecastSet) else self.entry.time_s
        return max(self.log_ns - round((said_s - time_s) * 1e9), 0)


def moments(recording: Recording) -> Iterator[Moment]:
    """Every cycle and report, in recorded order."""
    attached = recording.attached
    for one in recording.entries(_SHOWN):
        if isinstance(one.entry, Exchanged):
            attached = one.entry.attached
        elif isinstance(one.entry, ForecastSet | ServiceStatus):
            yield Moment(one.log_ns, one.entry, attached)


MAP, ODOM, EGO = "map", "odom", "ego"


def world_frame(forecasts: ForecastSet) -> str:
    """What the places of a cycle are told in, in ROS's words: MAP, or ODOM where no map pose is
    known, whose origin is where the service began.
    """
    return ODOM if forecasts.mode is Mode.NO_POSE else MAP


DEFAULT_LENGTH_M, DEFAULT_WIDTH_M, HEIGHT_M = 4.5, 1.8, 1.5


def sizes(forecasts: ForecastSet) -> NDArray[np.float64]:
    """(A, 2) length and width, m; those of a car where the sensor does not say."""
    known = np.stack([forecasts.length_m, forecasts.width_m], axis=-1)
    return np.where(np.isfinite(known), known, (DEFAULT_LENGTH_M, DEFAULT_WIDTH_M))
