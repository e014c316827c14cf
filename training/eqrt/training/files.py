"""Files that others may read at any time: whole, or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eqrt.core.errors import EqrtError

UNFINISHED = ".unfinished-"
"""How names of what is not whole begin."""


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that, whatever happens, it holds all of `data` or what it held before."""
    beside = path.with_name(f"{UNFINISHED}{path.name}")
    try:
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # else a power cut may leave the new name on an empty file
        beside.replace(path)
    except OSError:
        beside.unlink(missing_ok=True)
        raise


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """While `path` is written: what the disk does not take is an EqrtError that names it."""
    try:
        yield
    except OSError as error:
        raise EqrtError(f"{path}: cannot be written ({error.strerror or error})") from error
