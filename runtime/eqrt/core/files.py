"""Files that others wrote, read up to the size that such a file can have; our own, whole or not at
all.
"""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path


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
    """A file that appears when it is whole, and stays what it was if it cannot be; what is no file
    (a device, a pipe) is written as it is. Raises OSError.
    """
    if not may_be_file(path) and path.exists():
        path.write_bytes(content)
        return
    part = path.parent / f"{path.name}.part"
    try:
        part.write_bytes(content)
        part.replace(path)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
