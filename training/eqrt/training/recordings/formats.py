"""The formats of recorded traffic that are read, and which of them a path holds.

A format is told by the names of files, and its reader says what is wrong with their contents. What
reads it is imported only when it is wanted. `eqrt.export.formats` adds CAN logs, whose reader needs
the runtime.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError, UsageError
from eqrt.training.recordings.recording import Reader, Source


@dataclass(frozen=True, slots=True, kw_only=True)
class ReaderOptions:
    """What a user may say about a dataset; `Format.takes` says which format takes what."""

    maps: Path | None = None
    """The folder of a dataset's maps."""
    profile: str | None = None
    """The sensor profile of CAN logs."""
    tile: Path | None = None
    """The map under CAN logs."""
    can: tuple[str, ...] = ()
    """The channels of CAN logs."""
    stationary: bool = False
    """The sensor behind CAN logs stood still."""
    stride: int | None = None
    """For a reader that itself chooses which steps are now."""
    license: str | None = None
    """Instead of the format's usual one."""
    credits: str | None = None
    """Likewise."""

    def given(self) -> dict[str, str]:
        """Those that were said, as text."""
        values = {name: value for name, value in asdict(self).items() if value}
        return {n: " ".join(v) if isinstance(v, tuple) else str(v) for n, v in values.items()}

    def absolute(self) -> ReaderOptions:
        """The same with paths that mean the same everywhere."""
        maps, tile = (path and path.absolute() for path in (self.maps, self.tile))
        return replace(self, maps=maps, tile=tile)

    def source(self, usual: Source) -> Source:
        """`usual`, but for what was said."""
        license_ = self.license or usual.license
        return replace(
            usual,
            credits=self.credits or usual.credits,
            license=license_,
            non_commercial=forbids_commerce(license_) if self.license else usual.non_commercial,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """One format."""

    name: str
    holds: str
    """What its datasets are, in words."""
    files: tuple[str, ...] = ()
    """Patterns for the name of a dataset that is one file."""
    folders: tuple[str, ...] = ()
    """Patterns for files in a dataset that is a folder."""
    takes: tuple[str, ...] = ()
    """The `ReaderOptions` that mean something here."""
    open: Callable[[Path, ReaderOptions, ModelContract], Reader]
    """Makes the reader for a path. Raises EqrtError if an option that it needs was not given."""

    def fits(self, path: Path) -> bool:
        """Whether `path` looks like one."""
        if path.is_file():
            return any(fnmatch(path.name.lower(), pattern) for pattern in self.files)
        return any(next(path.glob(pattern), None) for pattern in self.folders)


def _recording(path: Path, _: ReaderOptions, __: ModelContract) -> Reader:
    from eqrt.training.recordings.recording_file import RecordingFileReader  # noqa: PLC0415

    return RecordingFileReader.open(path)


def _argoverse1(_: Path, options: ReaderOptions, __: ModelContract) -> Reader:
    from eqrt.training.recordings.argoverse1 import Argoverse1Reader  # noqa: PLC0415

    return Argoverse1Reader(options.maps)


def _argoverse1_packed(_: Path, __: ReaderOptions, ___: ModelContract) -> Reader:
    from eqrt.training.recordings.argoverse1_packed import PackedArgoverse1Reader  # noqa: PLC0415

    return PackedArgoverse1Reader()


def _argoverse2(_: Path, __: ReaderOptions, ___: ModelContract) -> Reader:
    try:
        from eqrt.training.recordings.argoverse2 import Argoverse2Reader  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("pyarrow"):
            raise
        raise UsageError(
            "reading Argoverse 2 needs the package 'pyarrow', which is not installed; "
            "install it with: pip install 'eqrt[data]'"
        ) from error
    return Argoverse2Reader()


def _commonroad(_: Path, options: ReaderOptions, __: ModelContract) -> Reader:
    from eqrt.training.recordings import commonroad_recordings  # noqa: PLC0415

    source = options.source(commonroad_recordings.NGSIM)
    return commonroad_recordings.CommonRoadReader(source)


FORMATS: tuple[Format, ...] = (
    Format(
        name="recording",
        holds="recordings saved by eqrt (*.recording.npz)",
        files=("*.recording.npz",),
        folders=("*.recording.npz",),
        open=_recording,
    ),
    Format(
        name="argoverse1",
        holds="a folder of Argoverse 1 forecasting CSVs (*.csv)",
        files=("*.csv",),
        folders=("*.csv",),
        takes=("maps",),
        open=_argoverse1,
    ),
    Format(
        name="argoverse1-packed",
        holds="an Argoverse 1 file in the packed layout (*.npz)",
        files=("*.npz",),
        open=_argoverse1_packed,
    ),
    Format(
        name="argoverse2",
        holds="a folder of Argoverse 2 scenario folders (scenario_*.parquet)",
        folders=("scenario_*.parquet", "*/scenario_*.parquet"),
        open=_argoverse2,
    ),
    Format(
        name="commonroad",
        holds="CommonRoad scenarios, such as NGSIM's (*.xml, *.xml.gz)",
        files=("*.xml", "*.xml.gz"),
        folders=("*.xml", "*.xml.gz"),
        takes=("license", "credits"),
        open=_commonroad,
    ),
)
"""The first that fits counts."""


def find_format(path: Path, name: str | None, formats: Sequence[Format] = FORMATS) -> Format:
    """The format called `name`, or that of what is at `path`.

    Raises UsageError for a name that is none of them, EqrtError if there is nothing at `path`, or
    something else.
    """
    if not path.exists():
        raise EqrtError(f"{path}: no such file or folder; expected recorded traffic")
    if name is None:
        found = next((kind for kind in formats if kind.fits(path)), None)
        if found is None:
            expected = "; ".join(f"{kind.name}: {kind.holds}" for kind in formats)
            more = "; CAN logs are read by `eqrt prepare` first" if formats is FORMATS else ""
            raise EqrtError(
                f"{path}: no recorded traffic that is read here; expected {expected}{more}"
            )
        return found
    named = next((kind for kind in formats if kind.name == name), None)
    if named is None:
        known = ", ".join(kind.name for kind in formats)
        raise UsageError(f"there is no format {name!r}; the formats are {known}")
    return named


def open_reader(
    path: Path, kind: Format, options: ReaderOptions, contract: ModelContract
) -> Reader:
    """What reads the dataset at `path`, for windows of `contract`.

    Raises UsageError if something is said that the format does not take, or an extra is missing.
    """
    useless = sorted(set(options.given()) - set(kind.takes))
    if useless:
        raise UsageError(f"--{useless[0]} means nothing for the format {kind.name}; leave it out")
    return kind.open(path, options, contract)


def forbids_commerce(license_: str) -> bool:
    """Whether a licence's name says that it is non-commercial."""
    return re.search(r"\bNC\b|non-?commercial", license_, re.IGNORECASE) is not None
