"""Which windows are evaluated, in batches of bounded size, as recorded or turned by an angle.

A target's errors need its whole future, and comparing them needs its whole history: a window where
one of the two has a gap is left out, and counted.
"""

from __future__ import annotations

from collections.abc import Iterator, Set
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError, UsageError
from eqrt.core.frames import Pose2
from eqrt.export.formats import FORMATS
from eqrt.training.dataset.pieces import RawData
from eqrt.training.dataset.prepared import is_prepared
from eqrt.training.dataset.split import SIDES, group_digest
from eqrt.training.dataset.store import WindowStore, open_data
from eqrt.training.dataset.windows import MIN_DRIVE_M, WindowOptions, Windows
from eqrt.training.recordings.formats import ReaderOptions

Bool = NDArray[np.bool_]
Rows = NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Which of a dataset's windows."""

    split: str = "all"
    """One of SIDES."""
    targets: str | None = None
    """One of TARGETS; None = `focal` where the dataset names any target, else `complete`."""
    stride: int | None = None
    """Steps between windows of raw data; None = as `WindowOptions` says."""
    reader_options: ReaderOptions = field(default_factory=ReaderOptions)
    """For raw data."""


@dataclass(frozen=True, slots=True)
class Selection:
    """The windows of one dataset that may be evaluated."""

    store: WindowStore
    rows: Rows
    """Candidates, in the store's order."""
    targets: str
    """Which they are: one of TARGETS."""
    recordings: int
    """How many the chosen split has."""

    def seen_by(self, trained_on: Set[str]) -> int:
        """How many of the recordings with candidates are of these groups (`group_digest`)."""
        entries = [
            self.store.recordings[i] for i in np.unique(self.store.column("recording")[self.rows])
        ]
        name = self.store.source.name
        return sum(group_digest(name, entry.group) in trained_on for entry in entries)

    def batches(self, size: int) -> Iterator[Batch]:
        """The candidates, `size` at a time."""
        for start in range(0, len(self.rows), size):
            rows = self.rows[start : start + size]
            windows = self.store.gather(rows)
            wanted, complete = _are_wanted(windows, self.targets), is_complete(windows)
            chosen = np.flatnonzero(wanted & complete)
            yield Batch(windows.select(chosen), rows[chosen], int((wanted & ~complete).sum()))


@dataclass(frozen=True, slots=True)
class Batch:
    """Windows to evaluate, at most as many as were asked for; possibly none."""

    windows: Windows
    rows: Rows
    """(W,) where they lie in the store."""
    left_out: int
    """Targets that were not seen at every step."""


def select(path: Path, contract: ModelContract, choice: Choice) -> Selection:
    """Open prepared or raw data and choose windows.

    Raises EqrtError if `focal` targets are asked for and the data names none, UsageError if a
    stride or a reader's option is given for data that is already cut, and what `open_data` raises.
    """
    store = _open(path, contract, choice)
    rows = store.rows(choice.split)
    focal = store.column("focal")[rows]
    targets = choice.targets or ("focal" if focal.any() else "complete")
    if targets == "focal":
        if not focal.any():
            raise EqrtError(
                f"{path}: the data names no targets of its own; use --targets complete or all"
            )
        rows = rows[focal]
    sides = SIDES if choice.split == "all" else (choice.split,)
    recordings = sum(entry.split in sides for entry in store.recordings)
    return Selection(store, rows, targets, recordings)


def _open(path: Path, contract: ModelContract, choice: Choice) -> WindowStore:
    """Prepared data as it is; of raw data no more windows than will be looked at."""
    if is_prepared(path):
        stride = [] if choice.stride is None else ["stride"]
        if given := [*stride, *choice.reader_options.given()]:
            raise UsageError(f"{path}: already cut by `eqrt prepare`; --{given[0]} is for raw data")
        return open_data(path, contract)
    targets = choice.targets or _default_targets(path, contract, choice)
    return open_data(
        path,
        contract,
        options=WindowOptions(stride=choice.stride, targets=targets),
        formats=FORMATS,
        reader_options=choice.reader_options,
    )


def _default_targets(path: Path, contract: ModelContract, choice: Choice) -> str:
    """As the first recording of raw data has it."""
    data = RawData.open(
        path,
        contract,
        WindowOptions(stride=choice.stride),
        formats=FORMATS,
        format_name=None,  # told by the files
        reader_options=choice.reader_options,
    )
    first = next(data.reader.read(data.reader.parts(data.path)[0]), None)
    return "focal" if first is not None and first.focal.any() else "complete"


def is_complete(windows: Windows) -> Bool:
    """(W,) whether the target was seen at every step of history and future."""
    return np.asarray(windows.history_valid[:, 0].all(axis=1) & windows.future_valid.all(axis=1))


def turned(windows: Windows, degrees: float) -> Windows:
    """The same windows in a world turned counter-clockwise about the tile frame's zero.

    Turned in float64, so that what differs afterwards is the model's doing.
    """
    pose = Pose2(yaw_rad=np.radians(degrees))

    def turn(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        return pose.rotate(vectors.astype(np.float64)).astype(np.float32)

    return replace(
        windows,
        history=turn(windows.history),
        heading=turn(windows.heading),
        centerlines=turn(windows.centerlines),
        future=turn(windows.future),
    )


def _are_wanted(windows: Windows, targets: str) -> Bool:
    if targets == "focal":
        return windows.focal
    if targets == "complete":
        drive = np.linalg.norm(windows.future[:, -1] - windows.history[:, 0, 0], axis=-1)
        return np.asarray(is_complete(windows) & (drive >= MIN_DRIVE_M))
    return np.ones(len(windows), np.bool_)
