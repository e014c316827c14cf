"""A SocketCAN channel that cannot be used ends a command in one line, by every command alike."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from socketcan.conftest import RunOnVcan

REASONS = {"vcan7": "there is no CAN channel", "vcan2": "is down", "lo": "not a CAN channel"}


@pytest.mark.parametrize("command", ["play one.log", "serve --profile ars408"])
def test_a_channel_that_cannot_be_used_is_refused(
    command: str, run_on_vcan: RunOnVcan, tmp_path: Path
) -> None:
    """vcan7 does not exist, vcan2 is down, and lo is no CAN channel."""
    (tmp_path / "one.log").write_text("(1.000000) can0 123#00\n")
    each = "; ".join(f"{sys.executable} -m eqrt {command} --can {c}; echo $?" for c in REASONS)
    done = run_on_vcan(["sh", "-c", each], 60.0)
    assert done.stdout.split() == ["1"] * len(REASONS)
    assert len(done.stderr.splitlines()) == len(REASONS)
    for line, (channel, reason) in zip(done.stderr.splitlines(), REASONS.items(), strict=True):
        assert line.startswith("eqrt: ")
        assert channel in line
        assert reason in line
