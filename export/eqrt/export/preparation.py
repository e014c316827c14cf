"""Making a prepared folder: shards by whichever workers there are, and what is said about them."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.export.cluster import run_pieces
from eqrt.export.profiles import profile_id
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.training.claim import claimed
from eqrt.training.dataset import prepared
from eqrt.training.dataset.pieces import Counts, Piece, RawData, ShardCutter, peak_mb, plan
from eqrt.training.dataset.prepared import Geometry, Settings
from eqrt.training.dataset.shards import ShardIndex, open_shard, remove_unfinished, shard_folder
from eqrt.training.dataset.split import Split
from eqrt.training.dataset.store import license_notice, no_windows_error, open_data
from eqrt.training.recordings.formats import ReaderOptions

NAMED_SKIPS = 5
"""So many of what was skipped are named; all are in skipped.txt."""


def prepare(
    data: RawData,
    folder: Path,
    split: Split,
    *,
    keep_going: bool,
    force: bool,
    jobs: int,
    scheduler: str | None,
) -> None:
    """Make the prepared `folder` of `data`, or what is missing of it, and print what came of it.

    Raises EqrtError at the first thing that cannot be used, unless `keep_going` skips it; whole
    shards stay then, for the next run. Likewise while another process works on the folder.
    """
    parts = data.reader.parts(data.path)
    settings = Settings(
        path=str(data.path),
        format=data.format,
        reader=_with_contents(data.reader_options),
        source=data.reader.source,
        geometry=Geometry.of(data.contract),
        options=data.options,
        split=split,
        parts=prepared.fingerprint(parts),
    )
    pieces = plan(parts)
    cutter = ShardCutter(data=data, folder=folder, keep_going=keep_going)
    with claimed(folder):
        if prepared.begin(folder, settings, force=force) and all(
            _index(cutter, piece) for piece in pieces
        ):
            print(f"already there  {folder}")
        else:
            try:
                work = _make_shards(cutter, pieces, jobs, scheduler)
                _finish(data, settings, folder, pieces)
            except EqrtError:
                prepared.discard_if_empty(folder)
                raise
            finally:
                remove_unfinished(folder)
            _report_work(work)
    _report(folder, data.contract)


def _with_contents(options: ReaderOptions) -> dict[str, str]:
    """What was said of the data, and of files what is in them: an edited profile makes others."""
    given = options.given()
    if options.profile is not None:
        given["profile"] = profile_id(options.profile)
    if options.tile is not None:
        given["tile"] = load_tile(options.tile).info.tile_id
    return given


@dataclass(frozen=True, slots=True)
class _Work:
    """What this run did."""

    counts: Counts
    seconds: float


def _make_shards(
    cutter: ShardCutter, pieces: Sequence[Piece], jobs: int, scheduler: str | None
) -> _Work:
    """Make the shards that are not there yet."""
    missing = [piece for piece in pieces if not _counts(_index(cutter, piece), cutter)]
    if len(missing) < len(pieces):
        print(f"going on       {len(pieces) - len(missing)} of {len(pieces)} shards are there")
    began, counts = time.perf_counter(), Counts()
    outcomes = run_pieces(cutter, missing, jobs=jobs, scheduler=scheduler)
    with closing(outcomes), _progress(sum(piece.recordings for piece in missing)) as show:  # type: ignore[type-var]  # a generator
        for outcome in outcomes:
            if outcome.value is None:
                assert outcome.error is not None  # it is one or the other
                raise outcome.error
            counts += outcome.value
            show(missing[outcome.index].recordings, counts)
    return _Work(counts, time.perf_counter() - began)


def _index(cutter: ShardCutter, piece: Piece) -> ShardIndex | None:
    """The shard of a piece, if it is there and whole."""
    path = shard_folder(cutter.folder, piece.number)
    if not path.is_dir():
        return None
    try:
        return open_shard(path, cutter.data.contract).index
    except EqrtError:
        return None


def _counts(index: ShardIndex | None, cutter: ShardCutter) -> bool:
    """Whether a shard need not be made: nothing in it was skipped that now ends the run."""
    return index is not None and (cutter.keep_going or not index.skipped)


def _finish(data: RawData, settings: Settings, folder: Path, pieces: Sequence[Piece]) -> None:
    """Count what is in the shards, and write the page that says that they are all there."""
    counts, named = Counts(), list[tuple[str, str]]()
    for piece in pieces:
        index = open_shard(shard_folder(folder, piece.number), data.contract).index
        counts += Counts.of(index)
        named += [(recording.name, recording.group) for recording in index.recordings]
    if not counts.windows:
        prepared.discard(folder)
        raise no_windows_error(data, counts.recordings)
    settings.split.sides(named)  # names what is held out and not there
    prepared.finish(folder, settings, len(pieces), counts)


@contextmanager
def _progress(total: int) -> Iterator[Callable[[int, Counts], None]]:
    """Shows how many of `total` recordings are done: a bar on a terminal, else a line per tenth."""
    if sys.stdout.isatty():
        from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn  # noqa: PLC0415

        columns = (*Progress.get_default_columns(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, transient=True) as bar:
            task = bar.add_task("recordings", total=total)
            yield lambda done, _: bar.update(task, advance=done)
        return
    seen = 0

    def line(done: int, counts: Counts) -> None:
        nonlocal seen
        before, seen = seen, seen + done
        if 10 * before // total != 10 * seen // total:
            print(f"{100 * seen // total:>3} %  {counts.windows} windows", flush=True)

    yield line


def _report_work(work: _Work) -> None:
    seconds = max(work.seconds, 1e-9)
    ours, children = peak_mb(), _children_peak_mb()
    print(f"cut            {work.counts.recordings} scenes in {seconds:.1f} s")
    print(f"speed          {work.counts.recordings / seconds:.3g} scenes/s")
    print(
        f"peak memory    {max(ours, children, work.counts.peak_mb):.0f} MB in the largest process"
    )


def _children_peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0  # KiB on Linux


def _report(folder: Path, contract: ModelContract) -> None:
    """What is in a prepared folder, read back from it."""
    settings, totals = prepared.read_dataset(folder)
    store = open_data(folder, contract)
    size = sum(path.stat().st_size for path in folder.glob("shard-*/*"))
    sides = [entry.split for entry in store.recordings]
    train, val = len(store.rows("train")), len(store.rows("val"))
    print(f"prepared       {folder}")
    print(f"format         {settings.format}")
    print(f"recordings     {len(sides)}: {sides.count('train')} train, {sides.count('val')} val")
    print(f"windows        {len(store)}: {train} train, {val} val")
    print(f"size           {size / 1e6:.1f} MB in {totals.shards} shards")
    if not store.has_lanes():
        print("lanes          none: no map was found or given (docs/data.md says where it belongs)")
    if not (train and val):
        print(f"one side of the split is empty; {_why_empty(settings.split)}")
    if totals.skipped:
        _report_skipped(folder, totals.skipped)
    if notice := license_notice(settings.source):
        print(notice)


def _why_empty(split: Split) -> str:
    if split.others_elsewhere:
        return "as the configuration's held_out has it"
    if not split.held_out and split.held_out_share in (0.0, 1.0):
        return "as --held-out has it"
    return "few groups: name some with --held-out-groups"


def _report_skipped(folder: Path, skipped: int) -> None:
    reasons = (folder / prepared.SKIPPED).read_text(encoding="utf-8").splitlines()
    print(f"skipped        {skipped}, all in {folder / prepared.SKIPPED}")
    for reason in reasons[:NAMED_SKIPS]:
        print(f"               {reason}")
