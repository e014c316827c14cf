"""Reading recordings back: what the pipeline was told, and what it said then.

A file that was cut, because its writer was killed or the power went, is read up to there.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import IO, Annotated, Protocol, TypeVar

import can
import msgspec

from eqrt.core.errors import LogError, in_one_line
from eqrt.runtime.bus.logs import LogReader
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.recording.exact_forecasts import decode_forecasts
from eqrt.runtime.recording.folder import SUFFIX, part_of, recordings_in, run_of
from eqrt.runtime.recording.identity import Identity, one_line, read_identity
from eqrt.runtime.recording.mcap_entries import Head, Raw, read_entries, read_head
from eqrt.runtime.recording.steps import (
    MAX_TIME_S,
    CanEntry,
    Lost,
    PollEntry,
    Step,
    Time,
    can_message,
)
from eqrt.runtime.recording.topics import FORMAT_VERSION, Topic


@dataclass(frozen=True, slots=True)
class Exchanged:
    """Another model or tile, or both, predict from here on."""

    identity: Identity
    attached: dict[str, bytes]


Entry = Step | ForecastSet | ServiceStatus | Lost | Exchanged
"""What stands in a recording; a `Step` comes with its clock and the outcomes of its runs."""
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
EVERYTHING = frozenset(Topic)
_STEPS = frozenset({Topic.CAN, Topic.POLL, Topic.CLOCK, Topic.RUNS})
_CAN = msgspec.msgpack.Decoder(CanEntry)
_POLL = msgspec.msgpack.Decoder(PollEntry)
_CLOCK = msgspec.msgpack.Decoder(tuple[Time, ...])
_RUNS = msgspec.msgpack.Decoder(tuple[Annotated[int, msgspec.Meta(ge=0, le=2)], ...])
_STATUS = msgspec.json.Decoder(ServiceStatus)
_LOST = msgspec.json.Decoder(Lost)


class _Decoder(Protocol[T_co]):
    """One of msgspec's, of either format."""

    def decode(self, buf: bytes, /) -> T_co:
        """Raises msgspec.MsgspecError."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """An entry, and when it was recorded."""

    log_ns: int
    """Wall-clock time, ns since 1970."""
    entry: Entry


class Recording:
    """One run of the service, or what is there of it; can be read again from the start."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """`paths`: its files in order. Raises LogError if the first is no recording."""
        self.paths = tuple(paths)
        self._head = _head(self.paths[0])
        self.identity = _identity(self._head, self.paths[0])
        self._reset()

    def _reset(self) -> None:
        self.messages = 0
        """Read so far."""
        self.lost = 0
        """Steps that are known to be missing so far."""
        self.cut: list[str] = []
        """Which files read so far end early, and how."""

    @property
    def attached(self) -> dict[str, bytes]:
        """The files that travel in it, by name."""
        return self._head.attached

    @cached_property
    def identities(self) -> list[Identity]:
        """What each file says that it is of: models and tiles are exchanged between two files."""
        return [_identity(_head(path), path) for path in self.paths]

    @cached_property
    def gaps(self) -> list[str]:
        """What is missing of the run's files."""
        parts = [int(identity.part) for identity in self.identities]
        gaps = [f"begins in the middle of its run, with part {parts[0]}"] if parts[0] else []
        return gaps + [
            f"part {before + 1} is missing"
            for before, after in itertools.pairwise(parts)
            if after != before + 1
        ]

    @property
    def remark(self) -> str | None:
        """One line about what is missing, as far as it has been read; None if nothing is."""
        lost = [f"{self.lost} steps were not recorded in time"] if self.lost else []
        remarks = [*self.gaps, *self.cut, *lost]
        return f"{self.paths[0]}: {'; '.join(remarks)}" if remarks else None

    @property
    def is_whole(self) -> bool:
        """Whether a replay starts where the service started, and misses nothing on the way."""
        return not self.gaps and not self.lost

    def entries(self, topics: frozenset[Topic] = EVERYTHING) -> Iterator[Recorded]:
        """Everything of some topics in recorded order. Raises LogError if it cannot be read."""
        self._reset()
        waiting: list[Recorded] = []
        for raw in self._raw():
            if isinstance(raw, Exchanged):
                yield from waiting
                waiting = [Recorded(waiting[-1].log_ns if waiting else 0, raw)]
                continue
            if raw.topic is Topic.LOST:
                self.lost += _decoded(_LOST, raw.payload, self.paths[0]).steps
            if raw.topic not in topics:
                continue
            if raw.topic is Topic.CLOCK:
                said_s = _decoded(_CLOCK, raw.payload, self.paths[0])
                _add(waiting, clock_s=said_s)
                continue
            if raw.topic is Topic.RUNS:
                outcomes = _decoded(_RUNS, raw.payload, self.paths[0])
                _add(waiting, outcomes=outcomes)
                continue
            if raw.topic in _STEPS or not topics & _STEPS:  # what the clock said is complete
                yield from waiting
                waiting.clear()
            waiting.append(Recorded(raw.log_ns, self._entry(raw)))
        yield from waiting

    def steps(self) -> Iterator[Step]:
        """All that the pipeline was told. Raises LogError if it cannot be read."""
        return _only(Step, self.entries(_STEPS))

    def forecasts(self) -> Iterator[ForecastSet]:
        """All that it predicted. Raises LogError if it cannot be read."""
        return _only(ForecastSet, self.entries(frozenset({Topic.FORECASTS})))

    def _raw(self) -> Iterator[Raw | Exchanged]:
        predicting = self.identity.predicting
        for path, identity in zip(self.paths, self.identities, strict=True):
            if identity.predicting != predicting:
                predicting = identity.predicting
                yield Exchanged(identity, _head(path).attached)

            def end_early(what: str, name: str = path.name) -> None:
                self.cut.append(f"{name} {what}, read up to there")

            try:
                with path.open("rb") as stream:
                    yield from read_entries(stream, str(path), end_early)
            except OSError as error:
                raise LogError(f"cannot read {path}: {error.strerror or error}") from error

    def _entry(self, raw: Raw) -> Entry:
        if raw.topic is Topic.CAN:
            self.messages += 1
            entry = _decoded(_CAN, raw.payload, self.paths[0])
            return Step(entry.now_s, can_message(entry))
        if raw.topic is Topic.POLL:
            return Step(_decoded(_POLL, raw.payload, self.paths[0]).now_s, None)
        if raw.topic is Topic.STATUS:
            return _decoded(_STATUS, raw.payload, self.paths[0])
        if raw.topic is Topic.LOST:
            return _decoded(_LOST, raw.payload, self.paths[0])
        try:
            return decode_forecasts(raw.payload)
        except ValueError as error:
            raise LogError(f"{self.paths[0]}: {in_one_line(error)}") from error


def read_recordings(path: Path) -> list[Recording]:
    """The recording in a file, or all in a folder: one per run of the service, oldest first.

    Raises LogError if there is none.
    """
    if not path.is_dir():
        return [Recording([path])]
    runs: dict[str, list[Path]] = {}
    for file in recordings_in(path):
        runs.setdefault(run_of(file), []).append(file)
    if not runs:
        raise LogError(
            f"{path}: there is no recording of eqrt in it (eqrt-*{SUFFIX}); give a recorded CAN "
            "log or a folder of `eqrt serve --record`"
        )
    return [Recording(sorted(files, key=part_of)) for files in runs.values()]


def is_recording(path: Path) -> bool:
    """Whether its name says so: a folder, or a file in MCAP."""
    return path.is_dir() or path.suffix.lower() == SUFFIX


def can_messages(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    """The CAN messages of one file, at their own stamps: a log like any other."""
    for raw in read_entries(stream, str(reader.path), reader.end_early):
        if raw.topic is Topic.CAN:
            entry = _decoded(_CAN, raw.payload, reader.path)
            if not abs(entry.stamp_s) <= MAX_TIME_S:
                raise LogError(f"{reader.path}: a message is stamped {entry.stamp_s}, no time")
            yield can_message(entry)


def _add(
    waiting: list[Recorded], *, clock_s: tuple[float, ...] = (), outcomes: tuple[int, ...] = ()
) -> None:
    """To the step that waits, which is the first; before the first step there is nothing to do."""
    if waiting and isinstance(step := waiting[0].entry, Step):
        more = replace(step, clock_s=step.clock_s + clock_s, outcomes=step.outcomes + outcomes)
        waiting[0] = replace(waiting[0], entry=more)


def _only(kind: type[T], recorded: Iterator[Recorded]) -> Iterator[T]:
    return (one.entry for one in recorded if isinstance(one.entry, kind))


def _decoded(decoder: _Decoder[T], payload: bytes, path: Path) -> T:
    """Raises LogError."""
    try:
        return decoder.decode(payload)
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        raise LogError(f"{path}: an entry cannot be read ({in_one_line(error)})") from error


def _head(path: Path) -> Head:
    try:
        with path.open("rb") as stream:
            return read_head(stream, str(path))
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or error}") from error


def _identity(head: Head, path: Path) -> Identity:
    identity = read_identity(head.identity, path)
    if identity.format != str(FORMAT_VERSION):
        raise LogError(
            f"{path}: is of format {one_line(identity.format)}, this version of eqrt reads format "
            f"{FORMAT_VERSION}; read it with eqrt {one_line(identity.eqrt)}"
        )
    return identity
