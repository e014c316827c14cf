"""The log: forms, levels, rate, and which changes are told in which words."""

from __future__ import annotations

import io
import json
import re
import time
from datetime import datetime
from pathlib import Path

import msgspec
import pytest

from drives import shipped_predictor
from eqrt.runtime.bus.health import BusState, BusWord
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.operation.changes import COUNTED, MODES, BusTeller, Changes
from eqrt.runtime.operation.event_log import PER_MINUTE, EventLog, Level
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.output.status import BusStatus, ServiceStatus, SourceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.status_book import StatusBook
from no_channels import NoChannels


class Heard:
    """A log, what it wrote, and a clock that stands still until it is set."""

    def __init__(self, form: str = "text", level: Level = Level.INFO, **more: str) -> None:
        self.now_s = 100.0
        self._stream = io.StringIO()
        self.log = EventLog(
            form, level, stream=self._stream, clock=lambda: self.now_s, environment=more
        )

    @property
    def lines(self) -> list[str]:
        """Without the time of the day."""
        return [
            re.sub(r"^\d\d:\d\d:\d\d ", "", line)
            for line in self._stream.getvalue().split("\n")[:-1]
        ]


def test_an_event_is_a_line_for_people() -> None:
    heard = Heard()
    heard.log.say(Level.INFO, "reload", "reloaded", tile="x")
    heard.log.say(Level.ERROR, "bus", "bus can0 is DOWN")
    assert heard.lines == ["reloaded", "error: bus can0 is DOWN"]


def test_an_event_is_an_object_for_machines() -> None:
    heard = Heard("json")
    heard.log.say(Level.WARNING, "bus", 'bus "can0"\nis DOWN', channel="can0")
    (line,) = heard.lines
    told = json.loads(line)
    assert datetime.fromisoformat(told.pop("time")).tzinfo is not None
    assert told == {
        "level": "warning",
        "event": "bus",
        "text": 'bus "can0"\nis DOWN',
        "channel": "can0",
    }


def test_under_systemd_lines_carry_their_level() -> None:
    heard = Heard(JOURNAL_STREAM="8:1")
    heard.log.say(Level.WARNING, "bus", "x")
    heard.log.say(Level.INFO, "bus", "y")
    assert heard.lines == ["<4>warning: x", "<6>y"]


def test_events_below_the_level_are_not_said() -> None:
    heard = Heard(level=Level.WARNING)
    for level in Level:
        heard.log.say(level, level.name, level.name)
    assert heard.lines == ["error: ERROR", "warning: WARNING"]


def test_an_event_is_said_a_few_times_a_minute_and_what_was_left_out_is_counted() -> None:
    heard = Heard("json")
    for _ in range(PER_MINUTE + 500):
        heard.log.say(Level.INFO, "storm", "again")
    heard.log.say(Level.INFO, "other", "something else")
    heard.now_s += 59.9
    heard.log.say(Level.INFO, "storm", "again")
    heard.now_s += 0.2
    heard.log.say(Level.INFO, "storm", "again")
    heard.log.say(Level.INFO, "storm", "again")
    told = [json.loads(line) for line in heard.lines]
    assert [one["event"] for one in told] == ["storm"] * PER_MINUTE + ["other", "storm", "storm"]
    assert told[-2]["left_out"] == 501
    assert told[-2]["text"] == "again (501 more like it left out)"
    assert "left_out" not in told[-1]


def test_lines_that_are_always_said_are_not_counted() -> None:
    heard = Heard()
    for second in range(100):
        heard.log.line("status", f"{second}")
    assert len(heard.lines) == 100


# --- changes


@pytest.fixture(scope="module")
def quiet() -> ServiceStatus:
    """Of a service before its first cycle."""
    pipeline = Pipeline(load_profile("ars408"), shipped_predictor())
    made = StatusBook(pipeline, NoChannels(), []).close(time.monotonic() + 1.0)
    return msgspec.structs.replace(made, sources=[])


def told(*statuses: ServiceStatus) -> list[str]:
    heard = Heard()
    changes = Changes(heard.log)
    for status in statuses:
        changes(status)
    return heard.lines


def test_modes_are_told_when_they_change(quiet: ServiceStatus) -> None:
    modes = [Mode.SILENT, Mode.NO_MAP, Mode.NO_MAP, Mode.LATE, Mode.SILENT]
    statuses = [msgspec.structs.replace(quiet, mode=int(mode)) for mode in modes]
    assert told(*statuses) == [
        "mode NO_MAP: predicting without a map",
        "warning: mode LATE: predictions come late, or there is no time for the model on some "
        "objects",
        "warning: mode SILENT: no input; everything said before is void",
    ]
    assert set(MODES) == set(Mode)


def test_without_ego_motion_or_pose_the_log_says_what_to_do(quiet: ServiceStatus) -> None:
    """No objects: the motion is not known. Objects and a tile: the place on the map is not."""
    speed = SourceStatus(name="ego SpeedInformation", valid=False, reason="", since_s=1.0)
    radar = SourceStatus(name="ars408", valid=True, reason="", since_s=1.0)
    no_pose = msgspec.structs.replace(quiet, mode=int(Mode.NO_POSE), sources=[radar, speed])
    still = told(no_pose)[0]
    assert "(SpeedInformation not on the bus)" in still
    assert still.endswith("or say --stationary if the sensor stands still")
    lost = msgspec.structs.replace(no_pose, tile="/town.tile", objects=3)
    assert told(lost)[0].endswith("where on the map the car is: docs/radar-ins-map.md")


def test_buses_that_come_and_go_are_told(quiet: ServiceStatus) -> None:
    def with_bus(state: str, overflow: int) -> ServiceStatus:
        bus = BusStatus(channel="can0", state=state, since_s=1.0, overflow=overflow)
        return msgspec.structs.replace(quiet, buses=[bus])

    assert told(
        with_bus("UP", 0), with_bus("ERROR_PASSIVE", 0), with_bus("UP", 5), with_bus("UP", 5)
    ) == [
        "error: bus can0 is ERROR_PASSIVE",
        "bus can0 is UP",
        "warning: bus can0: 5 messages were lost, because they came too fast",
    ]


def lost(channel: str) -> BusWord:
    return BusWord(channel=channel, state=BusState.DOWN, text=f"{channel} is lost: unplugged")


def test_a_lost_bus_is_said_once_where_log_and_errors_are_one_file(tmp_path: Path) -> None:
    """As on a terminal and in the journal; in another file it is said again, not more often."""
    out, other = tmp_path / "out", tmp_path / "other"
    with out.open("w") as stdout, out.open("a") as same, other.open("w") as elsewhere:
        BusTeller(EventLog(stream=stdout, environment={}), same)(lost("can0"))
        assert out.read_text().count("can0 is lost: unplugged\n") == 1
        tell = BusTeller(EventLog(stream=stdout, environment={}), elsewhere)
        for _ in range(3 * PER_MINUTE):
            tell(lost("can1"))
        tell(BusWord(channel="can1", state=BusState.UP, text="can1 is back after 3.2 s"))
    lines = ["eqrt serve: can1 is lost: unplugged"] * PER_MINUTE
    assert other.read_text().splitlines() == [*lines, "eqrt serve: can1 is back after 3.2 s"]
    assert out.read_text().count("error: can1 is lost: unplugged\n") == PER_MINUTE
    assert out.read_text().endswith(" can1 is back after 3.2 s\n")


def test_a_lost_bus_is_told_to_machines() -> None:
    heard = Heard("json")
    BusTeller(heard.log, io.StringIO())(lost("can0"))
    (line,) = map(json.loads, heard.lines)
    expected = {"event": "bus-can0-lost", "level": "error", "channel": "can0", "state": "DOWN"}
    assert expected.items() <= line.items()


def test_a_lost_bus_is_not_told_again_by_the_next_status(quiet: ServiceStatus) -> None:
    def with_bus(state: str) -> ServiceStatus:
        bus = BusStatus(channel="can0", state=state, since_s=1.0, overflow=0)
        return msgspec.structs.replace(quiet, buses=[bus])

    assert told(*map(with_bus, ("UP", "DOWN", "UP", "BUS_OFF", "UP"))) == []


def test_sources_that_become_invalid_are_told_with_the_reason(quiet: ServiceStatus) -> None:
    def with_source(valid: bool) -> ServiceStatus:
        source = SourceStatus(name="radar", valid=valid, reason="no data", since_s=1.0)
        return msgspec.structs.replace(quiet, sources=[source])

    assert told(with_source(True), with_source(False), with_source(False), with_source(True)) == [
        "warning: source radar is not valid: no data",
        "source radar is valid",
    ]


def test_counts_are_told_by_how_much_they_grew(quiet: ServiceStatus) -> None:
    def with_count(count: int) -> ServiceStatus:
        return msgspec.structs.replace(quiet, totals=quiet.totals | {"can_failed": count})

    assert told(with_count(0), with_count(3), with_count(3), with_count(10)) == [
        "warning: the bus did not take 3 messages with predictions",
        "warning: the bus did not take 7 messages with predictions",
    ]


def test_only_counts_that_exist_are_waited_for(quiet: ServiceStatus) -> None:
    of_publishers = {"can_failed", "datagrams_failed"}
    assert set(COUNTED) <= set(quiet.totals) | of_publishers
