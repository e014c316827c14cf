"""Shards: windows on disk, in a folder each, that can be read row by row.

    shard-00003/windows.npy      a record per window: what training reads (`TENSORS`)
    shard-00003/provenance.npy   a record per window: where it is from (the other columns)
    shard-00003/recordings.json  the recordings in it, and what had to be skipped

Plain .npy files with a record per row, and not a file per column: a window drawn at random is one
stretch of the file, and a shard takes one open file. Gathering 64 windows from 60 shards in the
page cache was measured 1.5 to 6 times as fast as from columns.
`np.load(path, mmap_mode="r")["future"]` is a column.

A shard is written under another name and renamed when it is whole.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.core.files import PART, write_whole
from eqrt.training.dataset.windows import COLUMNS, TENSORS, Windows, no_windows

Records = NDArray[np.void]
Layout = np.dtype[np.void]

PROVENANCE = tuple(name for name in COLUMNS if name not in TENSORS)
_WINDOWS_FILE = "windows.npy"
_PROVENANCE_FILE = "provenance.npy"
_RECORDINGS_FILE = "recordings.json"
_UNFINISHED = ".unfinished-"  # how the names of shards that are not whole begin


def layout(contract: ModelContract, columns: Sequence[str]) -> Layout:
    """The record of one window: `columns`, as a model of this contract reads them."""
    empty = no_windows(contract)
    arrays = {name: getattr(empty, name) for name in columns}
    return np.dtype([(n, a.dtype, a.shape[1:]) for n, a in arrays.items()], align=True)


def records(windows: Windows, kind: Layout) -> Records:
    """The windows as records, (W,)."""
    rows = np.zeros(len(windows), kind)  # zeros, so that the gaps between the fields are the same
    assert kind.names is not None  # `layout` names them
    for name in kind.names:
        rows[name] = getattr(windows, name)
    return rows


class RecordedIn(msgspec.Struct, frozen=True):
    """One recording of a shard."""

    name: str
    group: str


class ShardIndex(msgspec.Struct, frozen=True, kw_only=True):
    """What is in a shard (`recordings.json`)."""

    windows: int
    recordings: tuple[RecordedIn, ...]
    """By the number that the windows' column `recording` holds."""
    skipped: tuple[str, ...]
    """One line per recording, or file, that could not be used."""


@dataclass(frozen=True, slots=True)
class Shard:
    """A whole shard."""

    folder: Path
    index: ShardIndex

    def windows(self) -> NDArray[np.uint8]:
        """(W, bytes) records of the layout of `TENSORS`, mapped from the disk."""
        rows = np.load(self.folder / _WINDOWS_FILE, mmap_mode="r")
        return np.asarray(rows).view(np.uint8).reshape(len(rows), rows.dtype.itemsize)

    def provenance(self) -> Records:
        """(W,) records of the layout of `PROVENANCE`, in memory."""
        rows: Records = np.load(self.folder / _PROVENANCE_FILE)
        return rows


def shard_folder(folder: Path, number: int) -> Path:
    """Where shard `number` of a prepared folder lies."""
    return folder / f"shard-{number:05d}"


def open_shard(path: Path, contract: ModelContract) -> Shard:
    """The shard in the folder `path`, which was prepared for `contract`.

    Raises EqrtError if it is not there or not whole.
    """
    try:
        index = msgspec.json.decode((path / _RECORDINGS_FILE).read_bytes(), type=ShardIndex)
        for file, columns in ((_WINDOWS_FILE, TENSORS), (_PROVENANCE_FILE, PROVENANCE)):
            rows = np.load(path / file, mmap_mode="r")
            if rows.dtype != layout(contract, columns) or rows.shape != (index.windows,):
                raise ValueError(f"{file} does not hold the {index.windows} windows it should")
    except (OSError, ValueError, EOFError, SyntaxError, msgspec.MsgspecError) as error:
        raise EqrtError(
            f"{path}: not a whole shard ({_reason(error)}); run `eqrt prepare` for it again"
        ) from error
    return Shard(path, index)


class ShardWriter:
    """Writes one shard, recording by recording: no more than one is in memory.

    To be used in a `with` block, which leaves a whole shard behind, or nothing. Raises EqrtError if
    the disk does not take it.
    """

    def __init__(self, folder: Path, number: int, contract: ModelContract) -> None:
        self._final = shard_folder(folder, number)
        self._folder = folder / f"{_UNFINISHED}{self._final.name}-{uuid.uuid4().hex}"
        self._contract = contract
        self._recordings: list[RecordedIn] = []
        self._skipped: list[str] = []

    def __enter__(self) -> Self:
        with self._writing():
            self._folder.mkdir(parents=True)
            self._windows = _GrowingFile(
                self._folder / _WINDOWS_FILE, layout(self._contract, TENSORS)
            )
            self._provenance = _GrowingFile(
                self._folder / _PROVENANCE_FILE, layout(self._contract, PROVENANCE)
            )
        return self

    def add(self, name: str, group: str, windows: Windows) -> None:
        """The windows of one recording, cut with the number of those added before it."""
        self._recordings.append(RecordedIn(name, group))
        with self._writing():
            self._windows.append(records(windows, self._windows.kind))
            self._provenance.append(records(windows, self._provenance.kind))

    def skip(self, reason: str) -> None:
        """Note something that could not be used."""
        self._skipped.append(reason)

    def finish(self) -> ShardIndex:
        """The shard is whole; nothing can be added any more."""
        index = ShardIndex(
            windows=self._windows.rows,
            recordings=tuple(self._recordings),
            skipped=tuple(self._skipped),
        )
        with self._writing():
            self._windows.close()
            self._provenance.close()
            write_whole(self._folder / _RECORDINGS_FILE, msgspec.json.encode(index))
            with contextlib.suppress(FileNotFoundError):
                shutil.rmtree(self._final)  # a damaged one, or this one, made twice
            self._folder.rename(self._final)
        return index

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._windows.abandon()
        self._provenance.abandon()
        shutil.rmtree(self._folder, ignore_errors=True)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise EqrtError(f"{self._final}: cannot be written ({_reason(error)})") from error


def remove_unfinished(folder: Path) -> None:
    """Remove what a run that was cut short left half-written."""
    for path in [*folder.glob(f"{_UNFINISHED}*"), *folder.glob(f".*{PART}")]:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


class _GrowingFile:
    """A .npy file of records that grows. Its header has room for any number of rows."""

    def __init__(self, path: Path, kind: Layout) -> None:
        self.kind = kind
        self.rows = 0
        self._file = path.open("wb")
        self._write_header()

    def append(self, rows: Records) -> None:
        """Add (W,) records."""
        self._file.write(rows.tobytes())
        self.rows += len(rows)

    def close(self) -> None:
        """Write how many rows there are, and see it on the disk."""
        self._file.seek(0)
        self._write_header()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Whatever has not been written is not wanted any more."""
        with contextlib.suppress(OSError):  # the disk may be full, and the buffer not empty
            self._file.close()

    def _write_header(self) -> None:
        header: dict[str, Any] = {
            "descr": np.lib.format.dtype_to_descr(self.kind),
            "fortran_order": False,
            "shape": (self.rows,),
        }
        np.lib.format.write_array_header_1_0(self._file, header)


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__
