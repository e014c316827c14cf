"""Files that others wrote, read up to the size that such a file can have."""

from __future__ import annotations

import errno
import os
from pathlib import Path


def read_at_most(max_bytes: int, path: Path) -> bytes:
    """The whole file. Raises OSError (EFBIG) if it is larger, before anything of it is read."""
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > max_bytes:
            text = f"{size:,} bytes, and no such file has more than {max_bytes:,}"
            raise OSError(errno.EFBIG, text, str(path))
        return stream.read()
