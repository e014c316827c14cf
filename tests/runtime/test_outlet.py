"""The log of a service goes to somebody who may not read it, and the service goes on."""

from __future__ import annotations

import io
import json
import os
import select
from collections.abc import Iterator

import pytest

from eqrt.runtime.operation.event_log import EventLog, Level
from eqrt.runtime.operation.outlet import Outlet


@pytest.fixture
def pipe() -> Iterator[tuple[io.FileIO, io.TextIOWrapper]]:
    reader, writer = os.pipe()
    with io.FileIO(reader) as out, os.fdopen(writer, "w", encoding="utf-8") as stream:
        yield out, stream


def waiting(reader: io.FileIO) -> list[str]:
    """All lines that wait in a pipe."""
    data = b""
    while select.select([reader], [], [], 0.0)[0]:
        data += os.read(reader.fileno(), 1 << 20)
    assert data.endswith(b"\n")
    return data.decode().splitlines()


def test_what_the_stream_has_kept_comes_first(pipe: tuple[io.FileIO, io.TextIOWrapper]) -> None:
    reader, stream = pipe
    stream.write("before\n")
    assert Outlet(stream).put("Grüße")
    assert waiting(reader) == ["before", "Grüße"]


def test_a_full_pipe_takes_nothing_and_holds_nobody_up(
    pipe: tuple[io.FileIO, io.TextIOWrapper],
) -> None:
    reader, stream = pipe
    outlet = Outlet(stream)
    taken = 0
    while outlet.put(f"line {taken}"):
        taken += 1
    assert not outlet.put("lost")
    assert waiting(reader) == [f"line {number}" for number in range(taken)]
    assert outlet.put("after")
    assert waiting(reader) == ["after"]


def test_a_reader_that_has_gone_is_no_error(pipe: tuple[io.FileIO, io.TextIOWrapper]) -> None:
    reader, stream = pipe
    outlet = Outlet(stream)
    reader.close()
    assert not outlet.put("into nothing")


def test_a_stream_that_is_no_file_is_written_to() -> None:
    stream = io.StringIO()
    assert Outlet(stream).put("line")
    assert stream.getvalue() == "line\n"


def test_the_log_says_how_many_lines_were_not_taken(
    pipe: tuple[io.FileIO, io.TextIOWrapper],
) -> None:
    reader, stream = pipe
    log = EventLog("json", stream=stream)
    for number in range(3_000):
        log.line("status", f"line {number}")
    heard = [json.loads(line) for line in waiting(reader)]
    assert 0 < len(heard) < 3_000
    log.say(Level.INFO, "run", "going on")
    missing, last = (json.loads(line) for line in waiting(reader))
    assert (missing["event"], missing["level"]) == ("log", "warning")
    assert missing["untaken"] == 3_000 - len(heard)
    assert last["text"] == "going on"
    log.line("status", "nothing more is missing")
    assert len(waiting(reader)) == 1
