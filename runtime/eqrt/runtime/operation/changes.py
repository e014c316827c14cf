"""What changed from one second to the next, told to the log in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TextIO

from eqrt.runtime.advice import without_motion
from eqrt.runtime.bus.health import LOST, BusWord
from eqrt.runtime.operation.event_log import EventLog, Level
from eqrt.runtime.operation.outlet import Outlet
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.output.status import BusStatus, ServiceStatus, SourceStatus

MODES = {
    Mode.RUN: "predicting, with map and pose",
    Mode.NO_MAP: "predicting without a map",
    Mode.NO_POSE: "no ego motion, or no pose in the map",
    Mode.PARTIAL: "predicting from short histories",
    Mode.LATE: "predictions come late, or there is no time for the model on some objects",
    Mode.FALLBACK: "the model fails, or what it says is refused; constant turn rate and velocity "
    "instead",
    Mode.SILENT: "no input; everything said before is void",
}
"""A mode in words, for whoever reads the log."""
_SAID_AT_ONCE = {state.name for state in LOST}  # and being back from there: `BusTeller`
_GOOD = {Mode.RUN, Mode.NO_MAP, Mode.PARTIAL}


class BusTeller:
    """Says at once that a channel is lost or back: in the log, and on `errors`, if that leads
    elsewhere, for whoever sees nothing of the log.
    """

    def __init__(self, log: EventLog, errors: TextIO) -> None:
        self._log = log
        self._errors = None if log.goes_to(errors) else Outlet(errors)

    def __call__(self, word: BusWord) -> None:
        """Say it, as often as the log admits."""
        is_lost = word.state in LOST
        said = self._log.say(
            Level.ERROR if is_lost else Level.INFO,
            f"bus-{word.channel}-{'lost' if is_lost else 'back'}",
            word.text,
            channel=word.channel,
            state=word.state.name,
        )
        if said and self._errors is not None:
            self._errors.put(f"eqrt serve: {word.text}")


@dataclass(frozen=True, slots=True)
class Counted:
    """A count that somebody should hear of when it grows."""

    event: str
    text: str
    """`{}` is by how much."""
    level: Level = Level.WARNING


COUNTED = {
    "pipeline_fallbacks": Counted(
        "fallback", "the model failed on {} targets, or what it said was refused", Level.INFO
    ),
    "pipeline_shed": Counted("shed", "no time for the model on {} targets; physics instead"),
    "pipeline_model_errors": Counted("model-error", "the model failed {} times"),
    "pipeline_model_overruns": Counted(
        "model-overrun", "the model did not answer in time, {} times"
    ),
    "pipeline_model_restarts": Counted("model-restart", "the model was loaded anew {} times"),
    "decoder_bad_checksum": Counted("checksum", "{} messages with a wrong checksum"),
    "ego_pose_jumps": Counted("pose-jump", "the ego's pose jumped {} times; tracks begin again"),
    "tracks_dropped": Counted("tracks-full", "{} tracks were dropped: more objects than fit"),
    "can_failed": Counted("can-full", "the bus did not take {} messages with predictions"),
    "datagrams_failed": Counted("datagrams-failed", "{} datagrams could not be sent"),
}
"""By the name of the count in `ServiceStatus.totals`."""


class Changes:
    """Hears every status, compares it with the one before."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._before: ServiceStatus | None = None

    def __call__(self, status: ServiceStatus) -> None:
        """Tell what is new."""
        before, self._before = self._before, status
        if status.mode != (before.mode if before else Mode.SILENT):
            self._mode(status)
        buses = {bus.channel: bus for bus in before.buses} if before else {}
        for bus in status.buses:
            self._bus(buses.get(bus.channel), bus)
        sources = {source.name: source for source in before.sources} if before else {}
        for source in status.sources:
            self._source(sources.get(source.name), source)
        for name, counted in COUNTED.items():
            more = status.totals.get(name, 0) - (before.totals.get(name, 0) if before else 0)
            if more > 0:
                text = counted.text.format(more)
                self._log.say(counted.level, counted.event, text, count=more)

    def _mode(self, status: ServiceStatus) -> None:
        mode = Mode(status.mode)
        level = Level.INFO if mode in _GOOD else Level.WARNING
        text = f"mode {mode.name}: {MODES[mode]}"
        if mode is Mode.NO_POSE:
            text = f"mode {mode.name}: {_lacks(status)}"
        self._log.say(level, f"mode-{mode.name}", text, mode=mode.name)

    def _bus(self, before: BusStatus | None, bus: BusStatus) -> None:
        state_before = before.state if before else "UP"
        if bus.state != state_before and not {bus.state, state_before} & _SAID_AT_ONCE:
            level = Level.INFO if bus.state == "UP" else Level.ERROR
            text = f"bus {bus.channel} is {bus.state}"
            self._log.say(level, f"bus-{bus.channel}", text, channel=bus.channel, state=bus.state)
        more = bus.overflow - (before.overflow if before else 0)
        if more > 0:
            text = f"bus {bus.channel}: {more} messages were lost, because they came too fast"
            self._log.say(Level.WARNING, f"overflow-{bus.channel}", text, count=more)

    def _source(self, before: SourceStatus | None, source: SourceStatus) -> None:
        if before is not None and before.valid == source.valid:
            return
        if source.valid and before is None:
            return
        state = "is valid" if source.valid else f"is not valid: {source.reason}"
        level = Level.INFO if source.valid else Level.WARNING
        self._log.say(
            level, f"source-{source.name}", f"source {source.name} {state}", source=source.name
        )


def _lacks(status: ServiceStatus) -> str:
    """What NO_POSE is about, and what to do: with objects the motion is known, the place is not."""
    if status.tile and status.objects:
        return "nothing says where on the map the car is: docs/radar-ins-map.md"
    return without_motion(one.name for one in status.sources if not one.valid)
