"""Files that others wrote, read up to the size that such a file can have."""

from __future__ import annotations

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
