"""A dataset cut piece by piece: which recordings go into which shard, and the cutting itself.

What is in a shard depends on the dataset only, and not on who cuts it or when: so pieces can be cut
anywhere, and those of a run that was killed need not be cut again.
"""

from __future__ import annotations

import resource
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.training.dataset.shards import ShardIndex, ShardWriter
from eqrt.training.dataset.windows import WindowCutter, WindowOptions, Windows
from eqrt.training.recordings.formats import Format, ReaderOptions, find_format, open_reader
from eqrt.training.recordings.recording import Part, Reader, Recording

MAX_RECORDINGS = 256
"""Per shard: some 50 MB of Argoverse scenes with all their targets."""
MIN_SHARDS = 64
"""So many at least, of datasets with so many recordings: work for so many processes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RawData:
    """Recorded traffic, and how it is to be cut."""

    path: Path
    """Absolute: it means the same to every worker."""
    format: str
    reader: Reader
    reader_options: ReaderOptions
    contract: ModelContract
    options: WindowOptions

    @classmethod
    def open(
        cls,
        path: Path,
        contract: ModelContract,
        options: WindowOptions,
        *,
        formats: Sequence[Format],
        format_name: str | None,
        reader_options: ReaderOptions,
    ) -> RawData:
        """What is at `path`: in the format called `format_name`, None = in the first that fits.

        A stride goes to the reader if that is what chooses the steps. Raises EqrtError if there is
        nothing that is read, UsageError for options that mean nothing.
        """
        path = path.absolute()
        kind = find_format(path, format_name, formats)
        if "stride" in kind.takes:
            reader_options = replace(reader_options, stride=options.stride)
            options = replace(options, stride=None)
        reader_options = reader_options.absolute()
        return cls(
            path=path,
            format=kind.name,
            reader=open_reader(path, kind, reader_options, contract),
            reader_options=reader_options,
            contract=contract,
            options=options,
        )


@dataclass(frozen=True, slots=True)
class Piece:
    """What becomes one shard."""

    number: int
    parts: tuple[Part, ...]

    @property
    def name(self) -> str:
        """How errors call it."""
        return f"shard {self.number} ({self.parts[0].name} to {self.parts[-1].name})"

    @property
    def recordings(self) -> int:
        """In it, if all of them can be read."""
        return sum(part.count for part in self.parts)


def plan(parts: Sequence[Part]) -> list[Piece]:
    """All parts, in order, in pieces of about as many recordings each."""
    total = sum(part.count for part in parts)
    size = min(max(total // MIN_SHARDS, 1), MAX_RECORDINGS)
    batches: list[list[Part]] = []
    room = 0
    for part in parts:
        if room <= 0:
            batches.append([])
            room = size
        batches[-1].append(part)
        room -= part.count
    return [Piece(number, tuple(batch)) for number, batch in enumerate(batches)]


@dataclass(frozen=True, slots=True)
class Skipped:
    """A recording, or what was to hold it, that could not be used."""

    reason: str


def cut(
    reader: Reader, parts: Sequence[Part], cutter: WindowCutter, *, keep_going: bool
) -> Iterator[tuple[Recording, Windows] | Skipped]:
    """The windows of every recording, whose numbers count those before it.

    What cannot be read or cut is `Skipped` if we keep going, else its EqrtError is raised.
    """
    number = 0
    for part in parts:
        for found in _read(reader, part) if keep_going else reader.read(part):
            if isinstance(found, Skipped):
                yield found
                continue
            try:
                windows = cutter.cut(found, number)
            except EqrtError as error:
                if not keep_going:
                    raise
                yield Skipped(str(error))
                continue
            number += 1
            yield found, windows


def _read(reader: Reader, part: Part) -> Iterator[Recording | Skipped]:
    """The recordings of `part`; where one is bad, reading goes on behind it."""
    first, last = part.first, part.first + part.count
    while first < last:
        try:
            for recording in reader.read(Part(part.path, first, last - first)):
                yield recording
                first += 1
        except EqrtError as error:
            yield Skipped(str(error))
            first += 1
        else:
            return


@dataclass(frozen=True, slots=True)
class Counts:
    """What came of a piece, or of many."""

    recordings: int = 0
    windows: int = 0
    skipped: tuple[str, ...] = ()
    peak_mb: float = 0.0
    """Resident memory of the process that cut it, at its highest."""

    @classmethod
    def of(cls, index: ShardIndex) -> Counts:
        """Those of a shard."""
        return cls(len(index.recordings), index.windows, index.skipped)

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.recordings + other.recordings,
            self.windows + other.windows,
            self.skipped + other.skipped,
            max(self.peak_mb, other.peak_mb),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardCutter:
    """Makes a shard of a piece. Crosses processes; only counts come back."""

    data: RawData
    folder: Path
    keep_going: bool

    def __call__(self, piece: Piece) -> Counts:
        """Read, cut and write one piece. Raises EqrtError, and then leaves nothing behind."""
        contract = self.data.contract
        cutter = _cutter(contract, self.data.options, threading.get_ident())
        with ShardWriter(self.folder, piece.number, contract) as writer:
            for found in cut(self.data.reader, piece.parts, cutter, keep_going=self.keep_going):
                if isinstance(found, Skipped):
                    writer.skip(found.reason)
                else:
                    recording, windows = found
                    writer.add(recording.name, recording.group, windows)
            index = writer.finish()
        return replace(Counts.of(index), peak_mb=peak_mb())


@lru_cache(maxsize=4)
def _cutter(contract: ModelContract, options: WindowOptions, thread: int) -> WindowCutter:  # noqa: ARG001 (a key)
    """One per thread, kept from piece to piece: what it has found out about a map is worth much."""
    return WindowCutter(contract, options)


def peak_mb() -> float:
    """Resident memory of this process at its highest."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0  # KiB on Linux
