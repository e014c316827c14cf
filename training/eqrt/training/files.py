"""What the disk does not take, said in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eqrt.core.errors import EqrtError


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """While `path` is written: what the disk does not take is an EqrtError that names it."""
    try:
        yield
    except OSError as error:
        raise EqrtError(f"{path}: cannot be written ({error.strerror or error})") from error
