"""Datasets as training and evaluation see them: rows of windows, gathered from wherever they lie.

`open_data` opens a prepared folder, whose shards stay on the disk, or cuts a raw dataset into
memory. A store may join several datasets; rows are counted through all of them.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.training.dataset.pieces import RawData, Skipped, cut
from eqrt.training.dataset.prepared import Geometry, is_prepared, read_dataset
from eqrt.training.dataset.shards import (
    PROVENANCE,
    Layout,
    Records,
    Shard,
    layout,
    open_shard,
    records,
    shard_folder,
)
from eqrt.training.dataset.split import SIDES, Split
from eqrt.training.dataset.windows import TENSORS, WindowCutter, WindowOptions, Windows
from eqrt.training.recordings.formats import FORMATS, Format, ReaderOptions
from eqrt.training.recordings.recording import Source

Rows = NDArray[np.intp]

MAX_OPEN_SHARDS = 512
"""Each takes a file descriptor, of which a process has 1024 unless told otherwise."""
MAX_IN_MEMORY_BYTES = 4e9
"""Of windows cut on the fly; more is prepared first."""


SAMPLED = 64
"""Windows that are read to tell something of all: whether they are still the same, for one."""


class RecordingEntry(NamedTuple):
    """One recording of a store."""

    name: str
    group: str
    split: str
    """`train` or `val`."""


class _Block(Protocol):
    """Where windows lie."""

    @property
    def kind(self) -> Layout:
        """Of the records."""

    def __len__(self) -> int: ...

    def take(self, rows: Rows) -> Records:
        """Copies of the records `rows`."""


class WindowStore:
    """Windows of one geometry, on disk or in memory. Threads may share one."""

    def __init__(
        self,
        blocks: Sequence[_Block],
        provenance: Records,
        recordings: Sequence[RecordingEntry],
        *,
        contract: ModelContract,
        source: Source,
    ) -> None:
        self.contract = contract
        """Whose model reads the windows."""
        self.source = source
        """Whose data it is."""
        self.recordings = list(recordings)
        """By the number that the column `recording` holds."""
        self._blocks = list(blocks)
        self._ends = np.cumsum([len(block) for block in blocks])
        self._provenance = provenance

    def __len__(self) -> int:
        return len(self._provenance)

    def gather(self, rows: Rows) -> Windows:
        """The windows `rows`, in this order, copied. Raises IndexError if there is no such row."""
        if len(rows) and not 0 <= rows.min() <= rows.max() < len(self):
            raise IndexError(f"rows {rows.min()} to {rows.max()} of {len(self)} windows")
        here = self._provenance[rows]
        provenance = {name: np.ascontiguousarray(here[name]) for name in PROVENANCE}
        return Windows(**provenance, **self._tensors(rows))

    def column(self, name: str) -> NDArray[Any]:
        """One of the columns that say where windows are from (`PROVENANCE`), for all rows."""
        return np.ascontiguousarray(self._provenance[name])

    def checksum(self) -> int:
        """Of where all windows are from, and of what SAMPLED of them, evenly spread, hold."""
        named = "".join(f"{entry.name}\n{entry.group}\n" for entry in self.recordings)
        checksum = zlib.crc32(named.encode())
        for name in PROVENANCE:
            checksum = zlib.crc32(self.column(name).tobytes(), checksum)
        return self.gather(self._sample()).checksum(checksum)

    def has_lanes(self) -> bool:
        """Whether any of the SAMPLED windows has a centerline."""
        return bool(self.gather(self._sample()).centerlines_valid.any())

    def rows(self, split: str = "all") -> Rows:
        """The rows of one side, `train` or `val`, or `all`."""
        if split not in SIDES:
            raise ValueError(f"split is {split!r}, expected one of {SIDES}")
        if split == "all":
            return np.arange(len(self))
        wanted = np.array([entry.split == split for entry in self.recordings], np.bool_)
        return np.flatnonzero(wanted[self._provenance["recording"]])

    def split_by(self, split: Split) -> WindowStore:
        """The same windows, split another way.

        Raises EqrtError if something is held out that is not here.
        """
        named = [(entry.name, entry.group) for entry in self.recordings]
        return WindowStore(
            self._blocks,
            self._provenance,
            _entries(named, split),
            contract=self.contract,
            source=self.source,
        )

    @staticmethod
    def concat(stores: Sequence[WindowStore]) -> WindowStore:
        """The windows of several datasets one after the other, each split as it was.

        Raises ValueError if they were not opened for one geometry.
        """
        first = stores[0]
        if any(Geometry.of(s.contract) != Geometry.of(first.contract) for s in stores):
            raise ValueError("datasets that were opened for different contracts cannot be joined")
        return WindowStore(
            [block for store in stores for block in store._blocks],
            _renumbered([s._provenance for s in stores], [len(s.recordings) for s in stores]),
            [entry for store in stores for entry in store.recordings],
            contract=first.contract,
            source=join_sources([store.source for store in stores]),
        )

    def _sample(self) -> Rows:
        """SAMPLED rows, evenly spread."""
        return np.linspace(0, len(self) - 1, min(SAMPLED, len(self))).astype(np.intp)

    def _tensors(self, rows: Rows) -> dict[str, NDArray[Any]]:
        """What training reads of the windows `rows`: block by block, then back in order."""
        block_of = np.searchsorted(self._ends, rows, side="right")
        parts, places = [], []
        for number in np.unique(block_of) if len(rows) else [0]:
            block = self._blocks[number]
            places.append(np.flatnonzero(block_of == number))
            taken = block.take(rows[places[-1]] - (self._ends[number] - len(block)))
            parts.append({name: self._as_asked(name, taken[name]) for name in TENSORS})
        if len(parts) == 1:
            return parts[0]
        back = np.argsort(np.concatenate(places))
        return {name: np.concatenate([p[name] for p in parts])[back] for name in TENSORS}

    def _as_asked(self, name: str, column: NDArray[Any]) -> NDArray[Any]:
        """The first N agents and Q centerlines of a block's column (B, ...)."""
        if name in ("history", "history_valid"):
            column = column[:, : self.contract.num_agents]
        if name in ("centerlines", "centerlines_valid"):
            column = column[:, : self.contract.num_centerlines]
        return np.ascontiguousarray(column)


def open_data(
    path: Path,
    contract: ModelContract,
    *,
    options: WindowOptions | None = None,
    split: Split | None = None,
    format_name: str | None = None,
    reader_options: ReaderOptions | None = None,
    formats: Sequence[Format] = FORMATS,
) -> WindowStore:
    """The windows of the dataset at `path`, for a model of `contract`.

    A prepared folder serves any model with the same steps and points and no more agents and
    centerlines; `options` must be those it was prepared with, and `split` is used instead of its
    own. Anything else is recorded traffic in one of `formats`, and is cut into memory, with
    `WindowOptions()` and `Split()` unless told otherwise. Raises EqrtError if `path` is neither, or
    something in it cannot be used.
    """
    if is_prepared(path):
        return _open_prepared(path, contract, options, split)
    data = RawData.open(
        path,
        contract,
        options or WindowOptions(),
        formats=formats,
        format_name=format_name,
        reader_options=reader_options or ReaderOptions(),
    )
    return _cut_into_memory(data, split or Split())


def _cut_into_memory(data: RawData, split: Split) -> WindowStore:
    named: list[tuple[str, str]] = []
    rows: list[Records] = []
    provenance: list[Records] = []
    kinds = layout(data.contract, TENSORS), layout(data.contract, PROVENANCE)
    cutter, size = WindowCutter(data.contract, data.options), 0
    for found in cut(data.reader, data.reader.parts(data.path), cutter, keep_going=False):
        assert not isinstance(found, Skipped)  # an error ends it
        recording, windows = found
        named.append((recording.name, recording.group))
        rows.append(records(windows, kinds[0]))
        provenance.append(records(windows, kinds[1]))
        size += rows[-1].nbytes
        if size > MAX_IN_MEMORY_BYTES:
            raise EqrtError(
                f"{data.path}: too much for the memory, more than {MAX_IN_MEMORY_BYTES / 1e9:.0f} "
                "GB of windows; make a prepared folder of it with `eqrt prepare`"
            )
    if not any(map(len, rows)):
        raise no_windows_error(data, len(named))
    return WindowStore(
        [_Memory(np.concatenate(rows))],
        np.concatenate(provenance),
        _entries(named, split),
        contract=data.contract,
        source=data.reader.source,
    )


def no_windows_error(data: RawData, recordings: int) -> EqrtError:
    """For recordings that can be read, and of which nothing is left to train on."""
    options = data.options
    stride = options.stride or data.reader_options.stride  # whichever of them chooses the steps
    hint = "; perhaps it names no targets: try all" if options.targets == "focal" else ""
    return EqrtError(
        f"{data.path}: no window in {recordings} recordings (targets {options.targets}, stride "
        f"{stride}){hint}"
    )


def join_sources(sources: Sequence[Source]) -> Source:
    """Several sources as one: all their credits, and all their licences at once."""

    def each(name: str, between: str) -> str:
        return between.join(dict.fromkeys(getattr(source, name) for source in sources))

    return Source(
        name=each("name", " and "),
        credits=each("credits", "; "),
        license=each("license", " AND "),
        non_commercial=any(source.non_commercial for source in sources),
    )


def license_notice(source: Source) -> str | None:
    """The line to print when a source forbids commercial use, None where it does not."""
    if not source.non_commercial:
        return None
    return f"data licence: {source.license}, non-commercial; {source.credits}"


def _open_prepared(
    path: Path, contract: ModelContract, options: WindowOptions | None, split: Split | None
) -> WindowStore:
    settings, totals = read_dataset(path)
    lacking = settings.geometry.shortcomings(contract)
    if lacking:
        raise EqrtError(
            f"{path}: prepared for another model: {'; '.join(lacking)}; prepare it for this one"
        )
    if options is not None and options != settings.options:
        raise EqrtError(
            f"{path}: prepared with targets {settings.options.targets}, stride "
            f"{settings.options.stride}, asked for are targets {options.targets}, stride "
            f"{options.stride}; prepare it like that"
        )
    prepared_for = settings.geometry.contract()
    shards = [open_shard(shard_folder(path, i), prepared_for) for i in range(totals.shards)]
    named = [(entry.name, entry.group) for shard in shards for entry in shard.index.recordings]
    return WindowStore(
        [_Shards(shards, layout(prepared_for, TENSORS))],
        _renumbered([s.provenance() for s in shards], [len(s.index.recordings) for s in shards]),
        _entries(named, split or settings.split),
        contract=contract,
        source=settings.source,
    )


def _entries(named: Sequence[tuple[str, str]], split: Split) -> list[RecordingEntry]:
    sides = split.sides(named)
    return [RecordingEntry(*pair, side) for pair, side in zip(named, sides, strict=True)]


def _renumbered(parts: Sequence[Records], recordings: Sequence[int]) -> Records:
    """Provenances in a row, each counting on behind the `recordings` of those before it."""
    joined = np.concatenate(parts)
    firsts = np.cumsum([0, *recordings[:-1]])
    joined["recording"] += np.repeat(firsts, [len(part) for part in parts]).astype(np.int32)
    return joined


@dataclass(frozen=True, slots=True)
class _Memory:
    """Windows in memory."""

    all: Records

    @property
    def kind(self) -> Layout:
        return self.all.dtype

    def __len__(self) -> int:
        return len(self.all)

    def take(self, rows: Rows) -> Records:
        return self.all[rows]


class _Shards:
    """The shards of a prepared folder. They are mapped when needed, the last ones stay so."""

    def __init__(self, shards: Sequence[Shard], kind: Layout) -> None:
        self.kind = kind
        self._shards = shards
        self._ends = np.cumsum([shard.index.windows for shard in shards])
        self._mapped = lru_cache(maxsize=MAX_OPEN_SHARDS)(self._map)

    def __len__(self) -> int:
        return int(self._ends[-1])

    def take(self, rows: Rows) -> Records:
        """Shard by shard, and there in the order of the file."""
        order = np.argsort(rows, kind="stable")
        ordered = rows[order]
        shard = np.searchsorted(self._ends, ordered, side="right")
        begins = np.flatnonzero(np.diff(shard, prepend=-1))
        taken = np.empty((len(rows), self.kind.itemsize), np.uint8)
        for begin, end in zip(begins, np.append(begins, len(rows))[1:], strict=True):
            windows, first = self._mapped(int(shard[begin]))
            taken[order[begin:end]] = windows[ordered[begin:end] - first]
        records: Records = taken.view(self.kind)[:, 0]
        return records

    def _map(self, number: int) -> tuple[NDArray[np.uint8], int]:
        """A shard's records (W, bytes), and the row of the first."""
        shard = self._shards[number]
        return shard.windows(), int(self._ends[number]) - shard.index.windows
