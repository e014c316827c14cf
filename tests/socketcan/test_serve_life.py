"""`eqrt serve` outlives its channel."""

from __future__ import annotations

import json
from pathlib import Path

from drives import DRIVES, first_seconds
from socketcan.conftest import RunOnVcan
from socketcan.vcan import program


def test_a_service_outlives_its_channel_and_says_so(run_on_vcan: RunOnVcan, tmp_path: Path) -> None:
    """It comes late, goes down, comes back, and is unplugged: a line each, and none in between.

    With no sockets but those that deploy/eqrt.service leaves it.
    """
    (tmp_path / "part.log").write_text(first_seconds(DRIVES["ars408"].log, 2.0))
    done = run_on_vcan(program("serve_life.py", "part.log"), 120.0)
    assert done.status == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["first"] > 10
    assert found["second"] > 10
    assert found["alive"]
    assert found["status"] == 0
    assert found["ended_s"] < 5.0
    said = [line.removeprefix("eqrt serve: vcan5 is ") for line in found["errors"].splitlines()]
    assert said[0].startswith("eqrt serve: waiting for vcan5: there is no CAN channel 'vcan5'")
    assert "(found: vcan0, vcan1, vcan2)" in said[0]
    assert [line.partition(" after ")[0] for line in said[1:4]] == [
        "there",
        "lost: network is down",
        "back",
    ]
    # A device that is removed goes down first; which of both is read is a matter of moments.
    assert said[4] in ("lost: network is down", "lost: no such device")
    assert len(said) == 5
    lines = found["output"].splitlines()
    for line in said[1:]:  # the log has it too, and once
        assert sum(one.endswith(f"vcan5 is {line}") for one in lines) == said[1:].count(line)
    assert any(line.startswith("eqrt serve: ars408 on vcan5") for line in lines)
    assert sum("  vcan5 down for " in line for line in lines) >= 2
    assert lines[-1].endswith("; vcan5: lost 2x")
