"""The process that writes a recording: entries come through standard input, MCAP files go to disk.

Run by the recorder of `eqrt serve`, never by hand. It imports little, runs at low priority, and
ends when its input does, whatever became of the service. Every second, what came is closed as a
chunk and handed to the disk, so that a file which is cut there can be read up to there. Exit
status: 0 all is written, 1 something could not be, 3 a limit was reached.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec
from mcap.writer import Writer

from eqrt.runtime.operation.outlet import Outlet
from eqrt.runtime.recording.folder import delete_oldest, file_name, free_bytes, total_bytes
from eqrt.runtime.recording.order import SAID_WHY, Attached, Description, Order
from eqrt.runtime.recording.topics import (
    DESCRIPTION,
    ENTRY,
    FORMAT_VERSION,
    IDENTITY,
    JSON_TOPICS,
    LENGTH,
    NAMES,
    PROFILE,
    Topic,
)

_FLUSH_S = 1.0
_CHUNK_BYTES = 1 << 20  # a chunk is closed before its second is over if it has grown to this
_READ_BYTES = 1 << 20
_NEVER = 1 << 60  # the library's own limit of a chunk: it knows nothing of steps
_NICE = 10


class LimitReachedError(Exception):
    """There is no room left to write to."""


def main() -> int:
    """Write until the input ends, or a limit is reached."""
    _stand_back()
    pieces = _Pieces(sys.stdin.fileno())
    try:
        order = msgspec.msgpack.decode(next(iter(pieces)) or b"", type=Order)
    except (StopIteration, msgspec.MsgspecError):
        return 1  # the service ended before it began
    status, reason = _record(order, pieces)
    if reason:  # the files are whole by now, whoever reads this
        Outlet(sys.stderr).put(f"eqrt serve: recording ended: {reason}; predictions go on")
    return status


def _record(order: Order, pieces: _Pieces) -> tuple[int, str]:
    """Write and close; the exit status, and why it ended before its time, if it did."""
    recording = _Recording(order)
    try:
        _write(recording, pieces)
    except LimitReachedError as reached:
        return SAID_WHY, str(reached)
    except OSError as error:
        return SAID_WHY, f"{order.folder}: {error.strerror}"
    finally:
        with contextlib.suppress(OSError):
            recording.close()
    return 0, ""


def _write(recording: _Recording, pieces: _Pieces) -> None:
    due_s = time.monotonic() + _FLUSH_S
    for batch in pieces:
        if batch is not None:
            recording.add(batch)
        if recording.chunk_bytes >= _CHUNK_BYTES or time.monotonic() >= due_s:
            recording.flush()
            due_s = time.monotonic() + _FLUSH_S


def _stand_back() -> None:
    """The service comes first; and it is the service that is told to stop, not this."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # not the service's real time
    with contextlib.suppress(OSError):
        os.nice(_NICE)


class _Pieces:
    """What comes through the pipe, piece by piece; None when nothing came for a while."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._rest = bytearray()

    def __iter__(self) -> Iterator[bytes | None]:
        while True:
            while (piece := self._next()) is not None:
                yield piece
            ready, _, _ = select.select([self._descriptor], [], [], _FLUSH_S)
            if not ready:
                yield None
                continue
            read = os.read(self._descriptor, _READ_BYTES)
            if not read:
                return  # half a piece may be left: the service was killed while it wrote
            self._rest += read

    def _next(self) -> bytes | None:
        if len(self._rest) < LENGTH.size:
            return None
        end = LENGTH.size + LENGTH.unpack_from(self._rest)[0]
        if len(self._rest) < end:
            return None
        piece = bytes(self._rest[LENGTH.size : end])
        del self._rest[:end]
        return piece


class _Recording:
    """The files of one run, one after the other."""

    def __init__(self, order: Order) -> None:
        self._order = order
        self._description = _read(order.description)
        self._folder = Path(order.folder)
        self._part = 0
        self._file: _File | None = None

    @property
    def chunk_bytes(self) -> int:
        """What came since the last flush."""
        return self._file.chunk_bytes if self._file else 0

    def add(self, batch: bytes) -> None:
        """Raises LimitReachedError, OSError."""
        if batch[0] == DESCRIPTION:
            self.close()
            self._description = _read(msgspec.msgpack.decode(batch[1:], type=Description))
            return
        if self._file is None:
            self._make_room()
            self._file = _File(self._folder, self._order, self._description, self._part)
            self._part += 1
        self._file.add(batch)

    def flush(self) -> None:
        """Raises LimitReachedError, OSError."""
        if self._file is None:
            return
        self._file.flush()
        self._make_room()
        order = self._order
        if self._file.size >= order.file_bytes or self._file.age_s >= order.file_seconds:
            self.close()

    def close(self) -> None:
        """Finish the present file; there may be a next one."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def _make_room(self) -> None:
        """Raises LimitReachedError if there is none to be had."""
        order = self._order
        while True:
            total, free = total_bytes(self._folder), free_bytes(self._folder)
            if total < order.total_bytes and free > order.free_bytes:
                return
            if not (order.delete_oldest and delete_oldest(self._folder)):
                break
        if total >= order.total_bytes:
            raise LimitReachedError(
                f"the recordings in {self._folder} have {total / 1e9:.2f} GB, allowed are "
                f"{order.total_bytes / 1e9:.2f} (--record-limit)"
            )
        raise LimitReachedError(
            f"the file system of {self._folder} has {free / 1e9:.2f} GB left, to be kept are "
            f"{order.free_bytes / 1e9:.2f} (--record-keep-free)"
        )


def _read(description: Description) -> Description:
    """With the content of files that are only named; one that cannot be read is left out."""
    attached = []
    for file in description.attached:
        with contextlib.suppress(OSError):
            content = Path(file.path).read_bytes() if file.path else file.content
            attached.append(Attached(file.name, file.media_type, content))
    return Description(identity=description.identity, attached=attached)


class _File:
    """One MCAP file."""

    def __init__(self, folder: Path, order: Order, description: Description, part: int) -> None:
        self._begun_s = time.monotonic()
        path = folder / file_name(order.run, part, time.time())
        self._stream: BinaryIO = path.open("xb")
        fcntl.flock(self._stream, fcntl.LOCK_EX)  # so that nobody deletes it
        self._writer = Writer(self._stream, chunk_size=_NEVER)
        self._writer.start(PROFILE, f"eqrt {description.identity['eqrt']}")
        self._channels = {topic: self._channel(topic, order) for topic in Topic}
        self._counts = dict.fromkeys(Topic, 0)
        self.chunk_bytes = 0
        self._say_what_it_is(order.run, description, part)

    def _channel(self, topic: Topic, order: Order) -> int:
        name = NAMES[topic]
        if topic not in JSON_TOPICS:
            return self._writer.register_channel(name, "msgpack", 0)
        schema = self._writer.register_schema(
            f"eqrt.{topic.name.title()}", "jsonschema", order.schemas[name]
        )
        return self._writer.register_channel(name, "json", schema)

    def _say_what_it_is(self, run: str, description: Description, part: int) -> None:
        about = {"format": str(FORMAT_VERSION), "run": run, "part": str(part)}
        self._writer.add_metadata(IDENTITY, about | description.identity)
        now_ns = time.time_ns()
        for file in description.attached:
            self._writer.add_attachment(0, now_ns, file.name, file.media_type, file.content)
        self._stream.flush()

    @property
    def age_s(self) -> float:
        return time.monotonic() - self._begun_s

    @property
    def size(self) -> int:
        return self._stream.tell()

    def add(self, batch: bytes) -> None:
        at = 0
        while at < len(batch):
            number, log_ns, publish_ns, length = ENTRY.unpack_from(batch, at)
            at += ENTRY.size
            topic = Topic(number)
            self._writer.add_message(
                self._channels[topic],
                log_ns,
                batch[at : at + length],
                publish_ns,
                self._counts[topic] & 0xFFFF_FFFF,
            )
            self._counts[topic] += 1
            at += length
        self.chunk_bytes += len(batch)

    def flush(self) -> None:
        if self.chunk_bytes:
            self._writer.flush()
            os.fdatasync(self._stream.fileno())
            self.chunk_bytes = 0

    def close(self) -> None:
        with self._stream:
            self._writer.finish()


if __name__ == "__main__":
    sys.exit(main())
