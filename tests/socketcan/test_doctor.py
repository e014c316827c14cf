"""`eqrt doctor` on real SocketCAN channels."""

from __future__ import annotations

import sys

from socketcan.conftest import RunOnVcan


def test_channels_are_told_apart_as_the_service_would(run_on_vcan: RunOnVcan) -> None:
    """vcan0 is up and silent, vcan2 is down, vcan7 does not exist."""
    each = "; ".join(
        f"{sys.executable} -m eqrt doctor --can {channel} --profile ars408 --listen 0.5; echo $?"
        for channel in ("vcan0", "vcan2", "vcan7")
    )
    done = run_on_vcan(["sh", "-c", each], 120.0)
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert [line for line in lines if line in {"0", "1"}] == ["0", "1", "1"]
    (up,) = (line for line in lines if line.startswith("OK    channel vcan0"))
    assert "open, CAN FD" in up
    assert any(line.startswith("WARN  traffic vcan0  nothing heard in 0.5 s") for line in lines)
    assert any(line.startswith("FAIL  channel vcan2") and "is down" in line for line in lines)
    assert any(line.startswith("FAIL  channel vcan7") and "there is no" in line for line in lines)


def test_an_interface_with_room_for_ten_messages_is_a_warning(run_on_vcan: RunOnVcan) -> None:
    doctor = f"{sys.executable} -m eqrt doctor --can vcan0 --profile ars408 --listen 0.1"
    script = f"ip link set vcan0 txqueuelen 10 && {doctor}"
    lines = run_on_vcan(["sh", "-c", script], 120.0).stdout.splitlines()
    (place,) = (n for n, line in enumerate(lines) if line.startswith("WARN  room vcan0"))
    assert "takes 10 messages at once" in lines[place]
    assert lines[place + 1].endswith("-> sudo ip link set vcan0 txqueuelen 1000")
