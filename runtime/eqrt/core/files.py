"""Files that others wrote, read up to the size that such a file can have; our own, whole or not at
all.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

PART = ".part"
"""How the hidden names of what `whole` has not yet finished end; a process that was killed leaves
them behind."""


def may_be_file(path: Path) -> bool:
    """Whether there is such a file; True where that cannot be told, because the folder may not be
    entered or the name is too long: reading it says why.
    """
    try:
        return path.is_file()
    except OSError:
        return True


def read_at_most(max_bytes: int, path: Path) -> bytes:
    """The whole file. Raises OSError (EFBIG) if it is larger, before anything of it is read."""
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > max_bytes:
            text = f"{size:,} bytes, and no such file has more than {max_bytes:,}"
            raise OSError(errno.EFBIG, text, str(path))
        return stream.read()


def write_whole(path: Path, content: bytes) -> None:
    """Write a file as `whole` does. Raises OSError."""
    with whole(path) as stream:
        stream.write(content)


@contextlib.contextmanager
def whole(path: Path) -> Iterator[BinaryIO]:
    """To write a file that appears when it is whole, and stays what it was if it cannot be.

    Links stay links. What is no file (a device, a pipe) is written as it is, and so is what our
    output goes to anyway, such as /dev/stdout. Raises OSError.
    """
    if (as_it_is := _open_as_it_is(path)) is not None:
        with as_it_is as stream:
            yield stream
        return
    place = Path(os.path.realpath(path))
    part = place.parent / f".{place.name}.{os.getpid()}{PART}"
    try:
        with part.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())  # else a power cut may leave the new name on an empty file
        part.replace(place)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _open_as_it_is(path: Path) -> BinaryIO | None:
    """None = another file may take its place, or there is none yet."""
    try:
        found = path.stat()
    except OSError:
        return None  # if it is there, but not to be seen, writing it says why
    for number in (1, 2):
        with contextlib.suppress(OSError):
            if os.path.samestat(found, os.fstat(number)):
                return os.fdopen(os.dup(number), "wb")
    return None if stat.S_ISREG(found.st_mode) else path.open("wb")
