"""Programs in a network namespace of their own: no route, and loopback is down."""

from __future__ import annotations

import os
import subprocess

import pytest

_UNSHARE = ["unshare", "--user", "--map-root-user", "--net"]


def own_network() -> list[str]:
    """What to write before a command. Skips where the kernel gives none; CI must."""
    if subprocess.run([*_UNSHARE, "true"], capture_output=True, check=False).returncode:
        said = "this machine gives no network namespaces"
        if os.environ.get("CI"):
            pytest.fail(said)
        pytest.skip(said)
    return _UNSHARE
