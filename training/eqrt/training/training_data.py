"""What a training learns from, and what it is measured on, from one or several datasets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import EqrtError
from eqrt.training.configuration import DataConfig, TrainConfig
from eqrt.training.dataset.split import TRAIN, VAL, Split, group_digest, in_share
from eqrt.training.dataset.store import WindowStore, open_data
from eqrt.training.dataset.windows import MIN_DRIVE_M, Windows, join
from eqrt.training.recordings.recording import Source
from eqrt.training.sampling import Pool, Rows

Bool = NDArray[np.bool_]

_CHUNK = 4096
"""Windows looked at together."""


@dataclass(frozen=True, slots=True)
class TrainingData:
    """Windows to train on, windows to evaluate on, and whose they are."""

    pool: Pool
    held_out: Windows
    """Complete windows; of the dataset's own targets where it names them."""
    source: Source
    recordings: int = 0
    """How many the pool's windows come from; 0 = not known."""
    trained_on: frozenset[str] = frozenset()
    """The groups that they are of (`group_digest`)."""


def open_training_data(config: TrainConfig, paths: Sequence[Path]) -> TrainingData:
    """Open prepared folders, or datasets as they are (which are cut into memory).

    Raises EqrtError if there is nothing to train on or nothing to evaluate on, if something that is
    to be held out is nowhere, or if what one dataset holds out is trained on in another.
    """
    contract = config.model.scene.contract(config.name, "0.0.0")
    options = config.data.window_options()
    stores = [open_data(path, contract, options=options) for path in paths]
    where = ", ".join(map(str, paths))
    if config.data.held_out:
        stores = _split(stores, config.data.held_out, where)
    store = WindowStore.concat(stores)
    _check_sides(store, where)
    rows = _shared(store, store.rows("train"), config.data.train_share)
    if not len(rows):
        raise EqrtError(f"{where}: {_why_none(config.data)}; nothing to train on")
    held_out = join([measured_windows(store, "val") for store in stores])
    if not len(held_out):
        count = len(store.rows("val"))
        raise EqrtError(
            f"{where}: nothing to evaluate on: none of the {count} windows held out has a whole "
            "history and future; hold out more, or longer recordings"
        )
    pool = Pool(store, rows, _weights(config.data, store, rows))
    recordings = len(np.unique(store.column("recording")[rows]))
    groups = frozenset[str]().union(*(_groups(s, config.data.train_share) for s in stores))
    return TrainingData(pool, held_out, store.source, recordings, groups)


def measured_windows(store: WindowStore, split: str) -> Windows:
    """The windows of one side that a model is measured on.

    They are complete, and of the dataset's own targets where it names any.
    """
    rows = store.rows(split)
    focal = store.column("focal")[rows]
    return store.gather(rows[focal] if focal.any() else rows).complete()


def _split(stores: Sequence[WindowStore], held_out: Sequence[str], where: str) -> list[WindowStore]:
    """Hold out the groups of what is named, in every store, and nothing else.

    A recording that is named in one store takes along those of its group in all of them.
    """
    entries = [entry for store in stores for entry in store.recordings]
    missing = sorted(set(held_out) - {name for e in entries for name in (e.name, e.group)})
    if missing:
        raise EqrtError(f"{where}: held-out recording or group {missing[0]} is not here")
    groups = {entry.group for entry in entries if {entry.name, entry.group} & set(held_out)}
    return [store.split_by(_holding_out(groups, store)) for store in stores]


def _holding_out(groups: set[str], store: WindowStore) -> Split:
    here = sorted(groups & {entry.group for entry in store.recordings})
    return Split(held_out=tuple(here), held_out_share=0.0)


def _check_sides(store: WindowStore, where: str) -> None:
    """No group is on both sides: each dataset's own split knows of that dataset only."""
    sides = [{e.group for e in store.recordings if e.split == side} for side in (TRAIN, VAL)]
    both = sorted(set.intersection(*sides))
    if both:
        raise EqrtError(
            f"{where}: group {both[0]} is held out in one dataset and trained on in another; name "
            "what is held out in [data] held_out, or prepare them with the same split"
        )


def _groups(store: WindowStore, share: float) -> set[str]:
    """Digests of the groups of a dataset that are trained on."""
    trained = {entry.group for entry in store.recordings if entry.split == TRAIN}
    return {group_digest(store.source.name, g) for g in trained if in_share(g, share)}


def _shared(store: WindowStore, rows: Rows, share: float) -> Rows:
    """Those of the rows whose group is drawn."""
    chosen = np.array([in_share(entry.group, share) for entry in store.recordings], np.bool_)
    kept: Rows = rows[chosen[store.column("recording")[rows]]]
    return kept


def _why_none(config: DataConfig) -> str:
    if config.train_share < 1.0:
        return f"no recording is left by held_out and train_share {config.train_share}"
    return "every recording here is held out"


def _weights(config: DataConfig, store: WindowStore, rows: Rows) -> NDArray[np.float64]:
    """How often each of the rows is drawn in an epoch."""
    focal, standing = store.column("focal")[rows], config.standing_weight
    if config.driving_weight == standing and config.cut_share == 1.0:
        return np.where(focal, config.focal_weight, standing)  # the windows need not be read
    drives, cut = _looked_at(store, rows)
    weights = np.select([focal, drives], [config.focal_weight, config.driving_weight], standing)
    return weights * np.where(cut, config.cut_share, 1.0)


def _looked_at(store: WindowStore, rows: Rows) -> tuple[Bool, Bool]:
    """Of each window: whether its target moves while it is seen, and whether it is cut off."""
    chunks = [rows[first : first + _CHUNK] for first in range(0, len(rows), _CHUNK)]
    looked = [(_drive(windows), _seen_ahead(windows)) for windows in map(store.gather, chunks)]
    drives, ahead = (np.concatenate(kind) for kind in zip(*looked, strict=True))
    return drives, _is_cut(store, rows, ahead)


def _is_cut(store: WindowStore, rows: Rows, ahead: Rows) -> Bool:
    """Whether the recording ends within the horizon, or began within half a history.

    It ends with the last step that any of its targets is seen at.
    """
    recording, step = store.column("recording")[rows], store.column("step")[rows]
    last = np.zeros(len(store.recordings), np.intp)
    np.maximum.at(last, recording, step + ahead)
    contract = store.contract
    cut: Bool = step + contract.horizon_steps > last[recording]
    return cut | (2 * (step + 1) <= contract.history_steps)


def _seen_ahead(windows: Windows) -> Rows:
    """How many steps ahead each target is seen last."""
    seen = windows.future_valid
    return np.where(seen.any(axis=1), seen.shape[1] - seen[:, ::-1].argmax(axis=1), 0)


def _drive(windows: Windows) -> Bool:
    """Whether the target moves, from where it was first seen to where it was last."""
    path = np.concatenate([windows.history[:, 0], windows.future], axis=1)
    seen = np.concatenate([windows.history_valid[:, 0], windows.future_valid], axis=1)
    row, last = np.arange(len(path)), seen.shape[1] - 1
    moved = path[row, last - seen[:, ::-1].argmax(axis=1)] - path[row, seen.argmax(axis=1)]
    drives: Bool = np.hypot(*moved.T) >= MIN_DRIVE_M
    return drives
