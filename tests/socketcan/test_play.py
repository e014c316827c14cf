"""`eqrt play` on a real SocketCAN bus, heard by a tool that is not ours."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

from socketcan.conftest import RunOnVcan
from source_tree import ROOT

LOG = ROOT / "tests/data/can/ars408/candump.log.gz"
NUM_MESSAGES = 1000  # 5.8 s of the recording


def test_a_played_log_is_on_the_bus_as_it_was_recorded(
    run_on_vcan: RunOnVcan, tmp_path: Path
) -> None:
    """candump hears every message, in order, with the bytes of the log."""
    with gzip.open(LOG, "rt") as log:
        recorded = [next(log) for _ in range(NUM_MESSAGES)]
    (tmp_path / "part.log").write_text("".join(recorded))
    listen = f"candump -L -n {NUM_MESSAGES} -T 20000 vcan0 > heard.log & sleep 0.3"
    play = f"{sys.executable} -m eqrt play part.log --can vcan0 --speed 2"
    done = run_on_vcan(["sh", "-c", f"{listen}; {play} || exit; wait"], 60.0)
    assert done.status == 0, done.stderr
    heard = (tmp_path / "heard.log").read_text().splitlines()
    assert [line.split()[2] for line in heard] == [line.split()[2] for line in recorded]
