"""A folder that one process at a time writes to."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eqrt.core.errors import EqrtError


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Make `folder`, and keep other processes that claim it away while the block runs.

    The claim leaves no file and ends with the process, whatever ends that. A folder that was made
    for nothing is removed. Raises EqrtError if it cannot be made, or another process has it.
    """
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise EqrtError(f"{folder}: cannot be written ({error.strerror})") from error
    try:
        _lock(folder, descriptor)
        yield
    finally:
        if is_new:
            with contextlib.suppress(OSError):  # something is in it
                folder.rmdir()
        os.close(descriptor)


def _lock(folder: Path, descriptor: int) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise EqrtError(
            f"{folder}: another process is writing to it; wait until it has ended, or choose "
            "another --out"
        ) from error
    except OSError:
        pass  # a file system without locks, such as some of a network
