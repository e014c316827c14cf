"""A recorded or replayed file, cycle by cycle, for pages that ask for the moment they show.

The file is read once, from its start, by a thread; what pages are told is kept in a temporary file,
so that any moment of an hour is at hand and the memory stays small.
"""

from __future__ import annotations

import asyncio
import os
import tempfile
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

from eqrt.core.errors import EqrtError
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.view.recorded import Record, TileUsed
from eqrt.runtime.view.server import SERVER_ID, Outbox, ViewServer, Wanted
from eqrt.runtime.view.updates import encode_status, encode_text
from eqrt.runtime.view.watch import NO_LANES, Lanes, Watch

_TELL_S = 0.5  # how often pages hear how far the file is read


class Playback:
    """What pages are told of a file."""

    def __init__(self, records: Iterable[Record], name: str, tile: Path | None) -> None:
        self._records, self._name = records, name
        self._watch = Watch(joins_runs=True)
        self._lanes = Lanes(tile)
        self._store = _Store()
        self._times_s: list[float] = []
        self._lanes_told: list[str] = []
        self._lanes_at: list[int] = []
        self._statuses: list[msgspec.Raw] = []
        self._thread = threading.Thread(target=self._read, name="read", daemon=True)
        self._ended = threading.Event()
        self.trouble = ""
        self.done = False

    def __enter__(self) -> Playback:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._store.close()

    def greet(self, outbox: Outbox) -> None:
        """What the file is, and how far it has been read."""
        outbox.tell("hello", encode_text("hello", mode="file", server=SERVER_ID, name=self._name))
        outbox.tell("index", self._index())
        if self.done:
            outbox.tell("statuses", encode_text("statuses", statuses=self._statuses))
        if self.trouble:
            outbox.tell("trouble", encode_text("trouble", words=self.trouble))

    def find(self, wanted: Wanted) -> Iterator[str | bytes]:
        """The updates of these cycles, as far as they have been read, and the lanes there."""
        first, last = max(0, wanted.first), min(wanted.last, len(self._times_s))
        for number in sorted({*self._lanes_at[first:last]} - {NO_LANES, wanted.lanes}):
            yield self._lanes_told[number]
        for number in range(first, last):
            yield self._store.read(number)

    async def tell_progress(self, server: ViewServer) -> None:
        """How far the file has been read, until all of it is."""
        told = -1
        while not self.done or told != len(self._times_s):
            await asyncio.sleep(_TELL_S)
            told = len(self._times_s)
            server.tell("index", self._index())
        server.tell("statuses", encode_text("statuses", statuses=self._statuses))
        if self.trouble:
            server.tell("trouble", encode_text("trouble", words=self.trouble))

    def _index(self) -> str:
        done = self.done  # before the rest: what it says must be true of them
        return encode_text(
            "index",
            times_s=[round(time_s, 4) for time_s in self._times_s],
            done=done,
        )

    def _read(self) -> None:
        try:
            for record in self._records:
                if self._ended.is_set():
                    return
                self._take(record)
        except EqrtError as error:
            self.trouble = str(error)
        finally:
            self.done = True

    def _take(self, record: Record) -> None:
        if isinstance(record, TileUsed):
            self._lanes.use(record.tile)
            return
        if isinstance(record, ServiceStatus):
            self.trouble = self._lanes.hear(record) or self.trouble
            text = encode_status(record, lost_cycles=0, shift_s=self._watch.shift_s)
            self._statuses.append(msgspec.Raw(text.encode()))
            return
        if (lanes := self._lanes.near(record)) is not None:
            self._lanes_told.append(lanes)
        update = self._watch.update(record, lanes=self._lanes.number)
        self._lanes_at.append(self._lanes.number)
        self._store.append(update)
        self._times_s.append(self._watch.time_s)  # last: from now on it may be asked for


class _Store:
    """Updates in a file without a name, which goes when it is closed; read while it is written."""

    def __init__(self) -> None:
        self._file, name = tempfile.mkstemp(prefix="eqrt-view-")
        os.unlink(name)
        self._ends = [0]

    def append(self, update: bytes) -> None:
        """The next one."""
        os.pwrite(self._file, update, self._ends[-1])
        self._ends.append(self._ends[-1] + len(update))

    def read(self, number: int) -> bytes:
        """One of those appended, counted from 0."""
        start, end = self._ends[number], self._ends[number + 1]
        return os.pread(self._file, end - start, start)

    def close(self) -> None:
        """Give the space back."""
        os.close(self._file)
