"""What the writer is told before the first entry, and what its end tells."""

from __future__ import annotations

import msgspec

SAID_WHY = 3
"""Exit status of a writer that ended before its time, and said why in a line."""


class Attached(msgspec.Struct, frozen=True):
    """A file that travels in the recording."""

    name: str
    media_type: str
    content: bytes = b""
    path: str = ""
    """Where the writer is to read it, if not "": what is large is none of the service's work."""


class Description(msgspec.Struct, frozen=True, kw_only=True):
    """What a file of a recording says of itself."""

    identity: dict[str, str]
    attached: list[Attached]


class Order(msgspec.Struct, frozen=True, kw_only=True):
    """One run of the service, and the limits of its recording."""

    folder: str
    run: str
    """Eight hexadecimal digits, in the name of every file of this run."""
    description: Description
    schemas: dict[str, bytes]
    """Topic -> the JSON schema of its messages."""
    file_bytes: int
    """A new file is begun when one is as large,"""
    file_seconds: float
    """or as old."""
    total_bytes: int
    """What all recordings in the folder may have together."""
    free_bytes: int
    """What the file system must keep free."""
    delete_oldest: bool
    """Make room by deleting the oldest recordings; else recording ends when there is none."""
