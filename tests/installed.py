"""Programs of the system that some tests need."""

from __future__ import annotations

import os
import shutil

import pytest


def needed(program: str, package: str) -> str:
    """Its path. Fails where tests must not be left out (CI is set), skips where it is missing."""
    path = shutil.which(program)
    if path is None:
        said = f"{program} is not installed: apt-get install {package}"
        if os.environ.get("CI"):
            pytest.fail(said)
        pytest.skip(said)
    return path
