"""A prepared folder: shards, and a page that says what they were made of and for.

dataset.json     settings and counts; written last, so its presence means that all is there
unfinished.json  the settings of a run that has not come to its end; the same run goes on with it
shard-00000/ ... (`eqrt.training.dataset.shards`)
skipped.txt      one line per recording or file that could not be used, if there were any
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import msgspec

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.core.files import write_whole
from eqrt.training.dataset.pieces import Counts
from eqrt.training.dataset.shards import remove_unfinished
from eqrt.training.dataset.split import Split
from eqrt.training.dataset.windows import WindowOptions
from eqrt.training.recordings.recording import Part, Source

SCHEMA = 1
DATASET = "dataset.json"
_UNFINISHED = "unfinished.json"
SKIPPED = "skipped.txt"


@dataclass(frozen=True, slots=True, kw_only=True)
class Geometry:
    """What of a model contract decides how windows are cut."""

    num_agents: int
    """N."""
    history_steps: int
    """T."""
    num_centerlines: int
    """Q."""
    centerline_points: int
    """L."""
    horizon_steps: int
    """H."""
    dt_s: float
    lane_choice: str

    @classmethod
    def of(cls, contract: ModelContract) -> Geometry:
        """That of `contract`."""
        return cls(**{field.name: getattr(contract, field.name) for field in fields(cls)})

    def contract(self) -> ModelContract:
        """A contract of this geometry, for one mode."""
        return ModelContract(name="prepared", version="0.0.0", num_modes=1, **asdict(self))

    def shortcomings(self, contract: ModelContract) -> list[str]:
        """Why windows of this geometry do not serve a model of `contract`; empty if they do.

        Agents and centerlines stand in order, and the first of many are those that would have been
        chosen if fewer had been asked for: so there may be more of them.
        """
        asked = Geometry.of(contract)
        return [
            f"{name} {ours} (the model's is {theirs})"
            for name, ours, theirs in _pairs(self, asked)
            if (ours < theirs if name in ("num_agents", "num_centerlines") else ours != theirs)
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Everything that decides what is in a prepared folder."""

    path: str
    """The dataset, as an absolute path."""
    format: str
    """How it was read (`eqrt.training.recordings.formats`)."""
    reader: dict[str, str]
    """The reader's options that were given."""
    source: Source
    geometry: Geometry
    options: WindowOptions
    split: Split
    parts: str
    """How many, and a digest of their names: files that came or went are noticed."""

    def differences(self, other: Settings) -> list[str]:
        """One phrase for every setting in which `other`, the newer one, differs."""
        return [f"{name} was {old}, now {new}" for name, old, new in _pairs(self, other)]


def fingerprint(parts: Sequence[Part]) -> str:
    """`Settings.parts`."""
    names = "\n".join(f"{part.path} {part.first} {part.count}" for part in parts)
    return f"{len(parts)}, sha256 {hashlib.sha256(names.encode()).hexdigest()[:16]}"


class Totals(msgspec.Struct, frozen=True, kw_only=True):
    """How much there is in a prepared folder."""

    shards: int
    recordings: int
    windows: int
    skipped: int


class Dataset(msgspec.Struct, frozen=True, kw_only=True):
    """`dataset.json`; without totals, `unfinished.json`."""

    schema: int
    settings: Settings
    totals: Totals | None


def is_prepared(path: Path) -> bool:
    """Whether `path` is a prepared folder, complete or not, even if its page is damaged.

    Other programs call their pages `dataset.json`, too, and what is theirs is not replaced.
    """
    return any(_is_ours(path / name) for name in (DATASET, _UNFINISHED))


def read_dataset(folder: Path) -> tuple[Settings, Totals]:
    """What is in a prepared folder. Raises EqrtError if it is not complete or not readable."""
    found = _read(folder)
    if found.totals is None:
        raise EqrtError(
            f"{folder}: `eqrt prepare` was cut short here; run the same command again to finish it"
        )
    return found.settings, found.totals


def begin(folder: Path, settings: Settings, *, force: bool) -> Totals | None:
    """Make `folder` ready for shards; the totals if it already holds all of them.

    What an equal run left stays; until all is there, the split may change, shards do not depend on
    it. Raises EqrtError if there is something else, unless `force` removes another preparation;
    whatever is not of our making is never touched.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if is_prepared(folder):
            before = None if force else _read(folder)
            if before is None:
                discard(folder)
            elif before.settings == settings:
                remove_unfinished(folder)
                return before.totals
            elif before.totals or replace(before.settings, split=settings.split) != settings:
                differ = "; ".join(before.settings.differences(settings))
                raise EqrtError(
                    f"{folder}: prepared with other settings ({differ}); choose another folder, or "
                    "replace what is there with --force"
                )
        elif any(folder.iterdir()):
            raise EqrtError(f"{folder}: not empty, and not a prepared folder; choose another --out")
        dataset = Dataset(schema=SCHEMA, settings=settings, totals=None)
        write_whole(folder / _UNFINISHED, _page(dataset))
    except OSError as error:
        raise EqrtError(f"{folder}: cannot be written ({error.strerror})") from error
    return None


def finish(folder: Path, settings: Settings, shards: int, counts: Counts) -> None:
    """All shards are there: say so."""
    totals = Totals(
        shards=shards,
        recordings=counts.recordings,
        windows=counts.windows,
        skipped=len(counts.skipped),
    )
    try:
        if counts.skipped:
            lines = "".join(f"{reason}\n" for reason in counts.skipped)
            write_whole(folder / SKIPPED, lines.encode())
        dataset = Dataset(schema=SCHEMA, settings=settings, totals=totals)
        write_whole(folder / DATASET, _page(dataset))
        (folder / _UNFINISHED).unlink(missing_ok=True)  # not there if shards were lost since
    except OSError as error:
        raise EqrtError(f"{folder}: cannot be written ({error.strerror})") from error


def discard(folder: Path) -> None:
    """Remove what a preparation made, the page first."""
    for name in (DATASET, _UNFINISHED, SKIPPED):
        (folder / name).unlink(missing_ok=True)
    remove_unfinished(folder)
    for shard in folder.glob("shard-*"):
        shutil.rmtree(shard)


def discard_if_empty(folder: Path) -> None:
    """Remove the folder of a run that failed before it had made anything."""
    with contextlib.suppress(OSError):  # it failed for a reason of its own, which is told
        if not any(folder.glob("shard-*")):
            discard(folder)
            folder.rmdir()


def _is_ours(page: Path) -> bool:
    """Whether it is a page as `_page` begins them, whatever version of eqrt wrote it."""
    try:
        with page.open("rb") as file:
            return re.match(rb'\s*{\s*"schema": *\d+,\s*"settings":', file.read(100)) is not None
    except OSError:
        return False


def _read(folder: Path) -> Dataset:
    for name in (DATASET, _UNFINISHED):
        try:
            found = msgspec.json.decode((folder / name).read_bytes(), type=Dataset)
        except FileNotFoundError:
            continue
        except (OSError, ValueError, msgspec.MsgspecError) as error:
            raise EqrtError(
                f"{folder / name}: not what `eqrt prepare` writes ({error}); prepare it again with "
                "--force"
            ) from error
        if found.schema != SCHEMA:
            raise EqrtError(
                f"{folder / name}: schema {found.schema}, this version of eqrt reads {SCHEMA}; "
                "prepare it again with --force"
            )
        return found
    raise EqrtError(f"{folder}: not a prepared folder (no {DATASET} in it)")


def _page(dataset: Dataset) -> bytes:
    return msgspec.json.format(msgspec.json.encode(dataset), indent=2) + b"\n"


def _pairs(one: Any, other: Any, prefix: str = "") -> list[tuple[str, Any, Any]]:
    """(name, value, other value) of every field in which two dataclasses of a kind differ."""
    pairs = []
    for field in fields(one):
        mine, theirs = getattr(one, field.name), getattr(other, field.name)
        if mine == theirs:
            continue
        if hasattr(mine, "__dataclass_fields__"):
            pairs += _pairs(mine, theirs, f"{prefix}{field.name}.")
        else:
            pairs.append((f"{prefix}{field.name}", mine, theirs))
    return pairs
