"""`eqrt doctor`: what it finds good, what it finds bad, and what it says to do."""

from __future__ import annotations

import json
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import can
import pytest

from drives import DRIVES, TILE, first_seconds
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.doctor.bus import (
    Traffic,
    judge_ids,
    judge_link,
    judge_load,
    judge_room,
    parse_link,
    room_of,
)
from eqrt.runtime.doctor.finding import Finding, Verdict
from eqrt.runtime.doctor.parts import check_profile
from eqrt.runtime.operation.endpoint import Endpoint
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from processes import eqrt


def examined(*arguments: str, status: int = 0) -> dict[str, Finding]:
    """By check, what the command found."""
    done = eqrt("doctor", "--json", "--listen", "1", *arguments)
    assert (done.returncode, done.stderr) == (status, "")
    found = [
        Finding(**{**one, "verdict": Verdict(one["verdict"])}) for one in json.loads(done.stdout)
    ]
    assert len({finding.check for finding in found}) == len(found)
    assert all(finding.found for finding in found)
    assert all(finding.advice for finding in found if finding.verdict is Verdict.WARN)
    return {finding.check: finding for finding in found}


@contextmanager
def radar_on(channel: str) -> Iterator[None]:
    """The recorded radar, played again and again."""
    lines = first_seconds(DRIVES["ars408"].log, 1.0).splitlines()
    messages = [candump_message(line) for line in lines]
    ended = threading.Event()

    def play() -> None:
        with open_bus(channel, LOCAL) as bus:
            while not ended.is_set():
                for message in messages:
                    bus.send(message)
                    time.sleep(0.002)
                bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"x"))

    player = threading.Thread(target=play)
    player.start()
    try:
        yield
    finally:
        ended.set()
        player.join()


def test_a_machine_without_can_is_examined_all_the_same() -> None:
    found = examined()
    for check in ("software", "processor", "clock", "disk", "model", "tile", "governor"):
        assert found[check].verdict is not Verdict.FAIL
    assert "checksum and test vector are right" in found["model"].found
    assert "onnxruntime " in found["software"].found
    assert found["profile"].verdict is found["channels"].verdict is Verdict.WARN


def test_a_radar_that_sends_is_heard_and_known() -> None:
    channel = f"doctor-{time.monotonic_ns()}"
    options = ["--can", channel, "--can-interface", LOCAL]
    with radar_on(channel):
        found = examined(*options, "--profile", "ars408", "--tile", str(TILE))
        other = examined(*options, "--profile", "generic")
    assert found[f"channel {channel}"].verdict is Verdict.OK
    traffic = found[f"traffic {channel}"]
    assert traffic.verdict is Verdict.OK
    assert 50 < float(traffic.found.split()[0]) < 600
    ids = found[f"ids {channel}"]
    assert (ids.verdict, ids.found.split(" of the profile's ")[0] > "0") == (Verdict.OK, True)
    assert "lanes" in found["tile"].found
    assert other[f"ids {channel}"].verdict is Verdict.WARN
    assert "generic is not for what is on this channel" in other[f"ids {channel}"].advice


def test_two_buses_that_were_swapped_are_a_warning() -> None:
    """The service would use nothing of what comes."""
    profile = load_profile("toyota-rav4")
    traffic = Traffic(1.0)
    for number in (0xAA, 0x24):
        traffic.add(can.Message(arbitration_id=number, is_extended_id=False))
    right = judge_ids("ids can0", traffic, profile, ["car"])
    assert (right.verdict, right.found) == (
        Verdict.OK,
        "2 of the profile's 3 for car heard; not 0x3bc",
    )
    swapped = judge_ids("ids can0", traffic, profile, ["radar"])
    assert swapped.verdict is Verdict.WARN
    assert swapped.found == "0 of the profile's 16 for radar heard, but of those for car"
    assert judge_ids("ids can0", traffic, profile, ["car", "radar"]).verdict is Verdict.OK


def test_a_map_that_the_profile_has_no_poses_for_is_a_warning() -> None:
    without = examined("--profile", "ars408", "--tile", str(TILE))["tile"]
    assert (without.verdict, "lanes" in without.found) == (Verdict.WARN, True)
    assert "'ars408' gives no poses" in without.advice
    assert examined("--profile", "generic", "--tile", str(TILE))["tile"].verdict is Verdict.OK


def test_what_a_profile_gives_is_told() -> None:
    """A map needs a pose, predictions speed and yaw rate."""
    known = {
        "ars408": "ars408: 1 sensor, speed, yaw rate, no pose; 6 CAN ids",
        "sbg-ins": "sbg-ins: no sensors, speed, yaw rate, pose; 5 CAN ids",
        "srr520": "srr520: 1 sensor, speed, yaw rate, no pose; 2 CAN ids",
    }
    for name, found in known.items():
        assert check_profile(name)[1].found.startswith(found)


def test_a_silent_channel_is_a_warning() -> None:
    channel = f"doctor-{time.monotonic_ns()}"
    found = examined("--can", channel, "--can-interface", LOCAL, "--profile", "ars408")
    assert found[f"channel {channel}"].verdict is Verdict.OK
    assert found[f"traffic {channel}"].verdict is Verdict.WARN
    assert "nothing heard in 1 s" in found[f"traffic {channel}"].found


def test_what_would_keep_the_service_from_starting_fails(tmp_path: Path) -> None:
    """Each with the words that the service itself would use."""
    model, tile = tmp_path / "model", tmp_path / "bad.tile"
    shutil.copytree(DEFAULT_ARTIFACT, model)
    content = bytearray((model / "model.onnx").read_bytes())
    content[1000] ^= 1
    (model / "model.onnx").write_bytes(content)
    tile.write_bytes(TILE.read_bytes()[:-1])
    found = examined(
        "--can", "x=y", "--can-interface", "usbcan", "--profile", "ars408",
        "--metrics", "1.2.3.4:5", "--tile", str(tile), "--model", str(model), status=1,
    )  # fmt: skip
    assert {name for name, one in found.items() if one.verdict is Verdict.FAIL} == {
        "model", "tile", "channels", "channel y", "metrics",
    }  # fmt: skip
    assert "SHA-256" in found["model"].found
    assert "there is no CAN interface 'usbcan'" in found["channel y"].found
    assert "--metrics-anywhere" in found["metrics"].found


def test_where_the_service_could_not_write_or_send_fails(tmp_path: Path) -> None:
    """Everything that `eqrt serve` would open, though nobody listens there."""
    channel = f"doctor-{time.monotonic_ns()}"
    found = examined(
        "--can", channel, "--can-interface", LOCAL, "--profile", "ars408",
        "--out-id", "0x7ff", "--record", "/proc/nothing", "--datagrams", "nohost.invalid:1",
        "--metrics", "192.0.2.7:9464", "--metrics-anywhere",
        "--realtime-cpus", "1000", "--realtime-strict", status=1,
    )  # fmt: skip
    assert {name for name, one in found.items() if one.verdict is Verdict.FAIL} == {
        "output", "recording", "datagrams", "metrics", "cores",
    }  # fmt: skip
    found = examined("--can", "vcan0", "--out-can", "nowhere0", "--profile", "ars408", status=1)
    assert found["channel nowhere0"].verdict is Verdict.FAIL
    found = examined("--can", channel, "--can-interface", LOCAL, "--out-can", "none", status=1)
    assert "the predictions would go nowhere" in found["output"].found
    folder = tmp_path / "not" / "yet"
    options = ["--can", channel, "--can-interface", LOCAL, "--record", str(folder)]
    found = examined(*options, "--datagrams", "127.0.0.1:9", "--out-id", "0x100")
    for check in ("output", "recording", "datagrams"):
        assert found[check].verdict is Verdict.OK
    assert not folder.parent.exists(), "looking leaves nothing behind"


@pytest.mark.parametrize(("seconds", "status"), [("0", 0), ("-1", 2), ("nan", 2), ("inf", 2)])
def test_it_listens_for_no_less_than_no_time(seconds: str, status: int) -> None:
    channel = f"doctor-{time.monotonic_ns()}"
    done = eqrt("doctor", "--can", channel, "--can-interface", LOCAL, "--listen", seconds)
    assert done.returncode == status
    assert done.stderr.count("\n") == (1 if status else 0)
    assert "Traceback" not in done.stderr
    assert f"traffic {channel}" not in done.stdout


def test_a_port_in_use_may_be_the_service_itself() -> None:
    with Endpoint("127.0.0.1:0") as endpoint:
        assert examined("--metrics", endpoint.address)["metrics"].verdict is Verdict.WARN
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    assert examined("--metrics", address)["metrics"].found == f"{address} is free"


def test_the_report_is_for_people_unless_asked_otherwise(tmp_path: Path) -> None:
    """From a configuration, as the service would read it; a profile that is missing fails."""
    config = tmp_path / "eqrt.toml"
    config.write_text('[serve]\nprofile = "no.toml"\n')
    done = eqrt("doctor", "--config", str(config))
    assert (done.returncode, done.stderr) == (1, "")
    lines = done.stdout.splitlines()
    assert any(line.startswith("FAIL  profile        there is no profile '") for line in lines)
    assert str(tmp_path / "no.toml") in done.stdout
    assert any(line.strip().startswith("-> ") for line in lines)
    assert lines[-1].endswith(" 1 FAIL")


# --- a real adapter, as `ip -json -details link show dev can0` tells of it


LINK = """[{"ifname":"can0","flags":["NOARP","UP"],"mtu":72,"operstate":"UP","linkinfo":{
"info_kind":"can","info_data":{"ctrlmode":["FD"],"state":"%s","restart_ms":0,
"bittiming":{"bitrate":500000,"sample_point":"0.875"},
"data_bittiming":{"bitrate":2000000,"sample_point":"0.750"}}}}]"""


def test_state_and_bitrates_of_an_adapter_are_told() -> None:
    well = judge_link("channel can0", parse_link(LINK % "ERROR-ACTIVE"), True)
    assert (well.verdict, well.found) == (
        Verdict.OK,
        "open, CAN FD, can, 500000 bit/s, data 2000000 bit/s",
    )
    ill = judge_link("channel can0", parse_link(LINK % "BUS-OFF"), True)
    assert ill.verdict is Verdict.FAIL
    assert ill.found.endswith(", BUS-OFF")


def test_a_bus_that_is_nearly_full_is_a_warning() -> None:
    """111 bits a classic message of 8 bytes: 4,000 of them a second are 89 % of 500 kbit/s."""

    def full(rate_hz: int) -> Finding:
        traffic = Traffic(1.0)
        for _ in range(rate_hz):
            traffic.add(can.Message(arbitration_id=1, is_extended_id=False, data=bytes(8)))
        return judge_load("traffic can0", traffic, 500_000)

    assert (full(2000).verdict, full(4000).verdict) == (Verdict.OK, Verdict.WARN)
    assert "89% of the bitrate" in full(4000).found


def test_an_interface_that_takes_less_than_a_cycle_is_a_warning() -> None:
    """10 messages unless told otherwise; a virtual one may have no queue at all."""
    found = judge_room("room can0", "can0", 10)
    assert found.verdict is Verdict.WARN
    assert found.advice == "sudo ip link set can0 txqueuelen 1000"
    assert [judge_room("room can0", "can0", room).verdict for room in (0, 1000)] == [Verdict.OK] * 2
    assert isinstance(room_of("lo"), int)
    assert room_of("nowhere0") is None


def test_error_frames_are_a_warning() -> None:
    traffic = Traffic(1.0)
    traffic.add(can.Message(arbitration_id=1))
    traffic.add(can.Message(arbitration_id=4, is_error_frame=True))
    found = judge_load("traffic can0", traffic, None)
    assert (found.verdict, "1 error frames" in found.found) == (Verdict.WARN, True)
