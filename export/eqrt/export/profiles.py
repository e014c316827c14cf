"""Sensor profiles as what a run was made with: where they lie, and what is in them."""

from __future__ import annotations

import hashlib
from pathlib import Path


def absolute_profile(profile: str) -> str:
    """A profile's file by its absolute path; a built-in profile by its name."""
    path = Path(profile)
    is_file = path.suffix == ".toml" or path.name != profile
    return str(path.resolve() if is_file else profile)


def profile_id(profile: str) -> str:
    """A built-in profile's name; that of a file, with a hash of it and of the DBCs beside it."""
    path = Path(profile)
    if not path.is_file():
        return profile
    digest = hashlib.sha256()
    for file in (path, *sorted(path.parent.glob("*.dbc"))):
        digest.update(file.read_bytes())
    return f"{path.name} {digest.hexdigest()}"
