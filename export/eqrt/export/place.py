"""The place of an artifact: nothing but an artifact is replaced, and one is whole at any moment.

The old one is moved aside, the new one moved in, and then the old one deleted. Whoever was killed
in between left the old one beside its place, whole; the next export puts it back.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from eqrt.core.errors import EqrtError

SUMS = "SHA256SUMS"
_PAGES = ("contract.json", SUMS)
"""An artifact has both (docs/artifact.md)."""


def claim(folder: Path) -> None:
    """See that an artifact may be put at `folder`: nothing is there, or nothing but an artifact.

    What a killed export left aside is put back, or deleted where the new one is in place. Raises
    EqrtError that names what is there.
    """
    if not folder.name:
        raise EqrtError(f"{folder}: no place for an artifact; give --out a folder with a name")
    _settle(folder)
    if not folder.exists():
        return
    if not folder.is_dir():
        raise EqrtError(f"{folder}: not a folder; choose another --out")
    if not any(folder.iterdir()):
        return
    if not all((folder / page).is_file() for page in _PAGES):
        raise EqrtError(f"{folder}: not empty, and not an artifact; choose another --out")
    foreign = sorted(_files(folder) - _listed(folder / SUMS) - {SUMS})
    if foreign:
        raise EqrtError(
            f"{folder}: holds {foreign[0]}, which is no part of the artifact there and would be "
            "deleted with it; move it away, or choose another --out"
        )


def put(draft: Path, folder: Path) -> None:
    """Move the folder `draft` to `folder`, which is claimed; what was there is deleted."""
    if folder.exists():
        folder.rename(_aside(folder))
    try:
        draft.rename(folder)
    finally:
        _settle(folder)


def _settle(folder: Path) -> None:
    old = _aside(folder)
    if not old.exists():
        return
    if folder.exists():
        shutil.rmtree(old)
    else:
        old.rename(folder)


def _aside(folder: Path) -> Path:
    """Where the old artifact waits: on the same disk, under a name that nothing else has."""
    return folder.with_name(f".{folder.name}.replaced-by-eqrt-export")


def _files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}


def _listed(sums: Path) -> set[str]:
    """The names in a file as `sha256sum` writes it: 64 digits, two characters, a name."""
    return {line[66:] for line in sums.read_text(encoding="utf-8", errors="replace").splitlines()}
