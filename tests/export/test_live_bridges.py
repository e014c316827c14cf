"""What a running service says, read back by other programs' own libraries."""

from __future__ import annotations

import contextlib
import json
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from bridging import bridge
from eqrt.cli import main
from eqrt.export.bridges.bridge import DEFAULT_LISTEN
from eqrt.export.bridges.to_plotjuggler import MAX_BYTES, encode_cycle, encode_status
from eqrt.runtime.output.datagrams import (
    Datagram,
    DatagramPublisher,
    decode_datagram,
    encode_datagrams,
)
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from forecast_sets import many, nobody, one_car
from plotjuggler import plotjuggler_server, series
from processes import PATIENCE_S, environment
from source_tree import ROOT
from viewing import free_udp_port

STATUS = ServiceStatus(
    time_s=1001.0,
    uptime_s=60.0,
    seconds=2.0,
    eqrt="0.1.0",
    profile="generic",
    model="m",
    model_id="0123456789ab",
    tile="",
    tile_id="",
    mode=1,
    mode_s=3.0,
    objects=1,
    messages=1200,
    latencies_s=[0.010, 0.012, 0.050],
    stages_s={"infer": 0.005},
    totals={"can_failed": 4, "decoder_messages": 9},
)


def ended(process: subprocess.Popen[str], by: signal.Signals) -> tuple[int, str, str]:
    process.send_signal(by)
    stdout, stderr = process.communicate(timeout=PATIENCE_S)
    return process.returncode, stdout, stderr


# --- PlotJuggler


@pytest.fixture
def plotjuggler() -> Iterator[socket.socket]:
    """Where PlotJuggler would listen."""
    with plotjuggler_server() as (server, _):
        yield server


def plotted_of(payload: bytes) -> dict[str, float]:
    """The series of a datagram."""
    assert len(payload) <= MAX_BYTES
    return dict(series(msgpack.unpackb(payload)))


def test_plotjuggler_is_sent_cycles_and_status(plotjuggler: socket.socket) -> None:
    """Through real sockets and a process that ends with SIGTERM."""
    send = f"127.0.0.1:{plotjuggler.getsockname()[1]}"
    with (
        bridge("--to", "plotjuggler", "--send", send) as (process, datagrams),
        DatagramPublisher([datagrams]) as service,
    ):
        service.send(b"nothing of ours")
        service.publish(one_car())
        service.report(STATUS)
        cycle, status = (plotted_of(plotjuggler.recv(65_535)) for _ in range(2))
        status_code, stdout, stderr = ended(process, signal.SIGTERM)
    assert cycle == {
        "/timestamp": 1000.0,
        "/mode": 1,
        "/cycle/number": 300,
        "/cycle/objects": 1,
        "/cycle/fallbacks": 0,
        "/cycle/input_age_ms": pytest.approx(12.0),
        "/cycle/oldest_ms": pytest.approx(50.0),
        "/cycle/compute_ms": pytest.approx(8.1),
        "/ego/x": 100.0,
        "/ego/y": 200.0,
        "/ego/yaw": pytest.approx(np.pi / 2),
        "/ego/speed": 8.0,
        "/track_65537/mode": 3,
        "/track_65537/object": 17,
        "/track_65537/age_ms": pytest.approx(50.0),
        "/track_65537/speed": pytest.approx(10.0),
        "/track_65537/probability": 0.75,
        "/track_65537/x": pytest.approx(20.0),
        "/track_65537/y": pytest.approx(0.0, abs=1e-6),
        "/track_65537/range": pytest.approx(20.0),
        "/track_65537/x_1s": pytest.approx(30.0, abs=1e-4),
        "/track_65537/y_1s": pytest.approx(0.0, abs=1e-4),
        "/track_65537/x_2s": pytest.approx(40.0, abs=1e-4),
        "/track_65537/y_2s": pytest.approx(0.0, abs=1e-4),
        "/track_65537/x_3s": pytest.approx(50.0, abs=1e-4),
        "/track_65537/y_3s": pytest.approx(0.0, abs=1e-4),
    }
    assert status["/timestamp"] == 1001.0
    assert status["/status/messages_per_s"] == 600.0
    assert status["/status/latency_median_ms"] == pytest.approx(12.0)
    assert status["/status/latency_worst_ms"] == pytest.approx(50.0)
    assert status["/status/stages/infer_ms"] == pytest.approx(5.0)
    assert status["/status/drops/can_failed"] == 4
    assert status["/status/drops/datagrams_failed"] == 0
    assert (status_code, stdout) == (0, "eqrt bridge: ended; 1 cycles in 2 datagrams\n")
    assert stderr.startswith("eqrt bridge: not passed on: not a datagram of eqrt")


def test_left_and_right_are_those_of_the_ego_vehicle() -> None:
    """It faces north: 3 m to the west of it are 3 m to its left."""
    car = replace(one_car(), position=np.array([[97.0, 210.0]]))
    (payload,) = encode_cycle(car)
    plotted = plotted_of(payload)
    assert (plotted["/track_65537/x"], plotted["/track_65537/y"]) == pytest.approx((10.0, 3.0))


def test_a_large_cycle_is_split_by_tracks_each_with_its_time() -> None:
    forecasts = many(12)
    datagrams = [plotted_of(payload) for payload in encode_cycle(forecasts)]
    assert len(datagrams) == 3
    assert [one["/timestamp"] for one in datagrams] == [50.0, 50.0, 50.0]
    assert ["/cycle/objects" in one for one in datagrams] == [True, False, False]
    ranges = {name: v for one in datagrams for name, v in one.items() if name.endswith("/range")}
    assert set(ranges) == {f"/track_{number}/range" for number in forecasts.track_id}
    ego = forecasts.map_from_ego
    assert ego is not None
    far = np.linalg.norm(forecasts.position - (ego.x_m, ego.y_m), axis=-1)
    np.testing.assert_allclose(list(ranges.values()), far)


def test_what_is_not_known_is_not_plotted() -> None:
    blind = replace(one_car(), ego_speed_mps=np.nan, velocity=np.full((1, 2), np.nan))
    (payload,) = encode_cycle(blind)
    plotted = plotted_of(payload)
    assert {name for name in plotted if name.startswith("/track_")} == {
        "/track_65537/mode",
        "/track_65537/object",
        "/track_65537/age_ms",
        "/track_65537/probability",
    }
    assert not any(name.startswith("/ego/") for name in plotted)
    (payload,) = encode_cycle(nobody())
    assert plotted_of(payload)["/cycle/objects"] == 0
    assert plotted_of(payload)["/timestamp"] == 1000.012  # silence goes on in time
    quiet = replace_status(latencies_s=[], seconds=0.0)
    assert not {"/status/latency_worst_ms", "/status/messages_per_s"} & set(plotted_of(quiet))


def replace_status(**changes: Any) -> bytes:
    """The datagram of a changed status."""
    fields = {name: getattr(STATUS, name) for name in STATUS.__struct_fields__}
    return encode_status(ServiceStatus(**(fields | changes)), lost_cycles=0)


# --- zenoh


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextlib.contextmanager
def subscriber(endpoint: str, *, mode: str = "client") -> Iterator[Callable[[], dict[str, Any]]]:
    """A program of its own: gives `newest()`, key -> last sample, of all that came."""
    config = zenoh.Config()
    role = "connect" if mode == "client" else "listen"
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5(f"{role}/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    seen: dict[str, Any] = {}
    with zenoh.open(config) as session:
        heard = session.declare_subscriber("**")

        def newest() -> dict[str, Any]:
            while (sample := heard.try_recv()) is not None:
                seen[str(sample.key_expr)] = sample
            return seen

        yield newest


def heard_of(
    publisher: DatagramPublisher, newest: Callable[[], dict[str, Any]], forecasts: ForecastSet
) -> dict[str, Any]:
    """Say it until both keys have come: nobody waits for a subscriber to be known."""
    end_s = time.monotonic() + PATIENCE_S
    while len(newest()) < 2:
        assert time.monotonic() < end_s, newest()
        publisher.publish(forecasts)
        publisher.report(STATUS)
        time.sleep(0.05)
    return newest()


def test_zenoh_has_datagrams_as_they_are_and_status_as_json() -> None:
    endpoint = free_endpoint()
    with (
        bridge("--to", "zenoh", "--listen", endpoint, "--key", "car/7") as (process, datagrams),
        DatagramPublisher([datagrams]) as service,
        subscriber(endpoint) as newest,
    ):
        samples = heard_of(service, newest, one_car())
        status_code, stdout, stderr = ended(process, signal.SIGTERM)
    assert set(samples) == {"car/7/forecasts", "car/7/status"}
    forecasts, status = samples["car/7/forecasts"], samples["car/7/status"]
    assert str(forecasts.encoding) == "application/msgpack"
    assert forecasts.payload.to_bytes() == next(encode_datagrams(one_car()))
    heard = decode_datagram(forecasts.payload.to_bytes())
    assert isinstance(heard, Datagram)
    assert msgpack.unpackb(forecasts.payload.to_bytes())["cycle"] == heard.forecasts.cycle == 300
    assert status.encoding == zenoh.Encoding.APPLICATION_JSON
    assert json.loads(status.payload.to_string())["totals"] == STATUS.totals
    assert (status_code, stderr) == (0, "")
    assert stdout.startswith("eqrt bridge: ended; ")


def test_the_pages_example_hears_the_bridge() -> None:
    """docs/bridges.md, at another endpoint."""
    endpoint = free_endpoint()
    found = re.search(r"```python\n(.*?)```", (ROOT / "docs/bridges.md").read_text(), re.DOTALL)
    assert found is not None
    example = found[1].replace("tcp/127.0.0.1:7447", endpoint)
    assert endpoint in example
    with (
        bridge("--to", "zenoh", "--listen", endpoint) as (_, datagrams),
        DatagramPublisher([datagrams]) as service,
        subprocess.Popen(
            [sys.executable, "-u", "-c", example],
            stdout=subprocess.PIPE,
            text=True,
            env=environment(),
        ) as reader,
    ):
        assert reader.stdout is not None
        try:
            end_s = time.monotonic() + PATIENCE_S
            while not select.select([reader.stdout], [], [], 0.05)[0]:
                assert time.monotonic() < end_s
                service.publish(many(5))
            assert reader.stdout.readline() == "5\n"
        finally:
            reader.kill()


def test_zenoh_connects_where_it_is_told() -> None:
    """With --connect it listens nowhere itself; SIGINT ends it too."""
    endpoint = free_endpoint()
    with (
        subscriber(endpoint, mode="router") as newest,
        bridge("--to", "zenoh", "--connect", endpoint) as (process, datagrams),
        DatagramPublisher([datagrams]) as service,
    ):
        samples = heard_of(service, newest, nobody())
        status_code, _, stderr = ended(process, signal.SIGINT)
    assert set(samples) == {"eqrt/forecasts", "eqrt/status"}
    assert (status_code, stderr) == (0, "")


def test_nothing_leaves_the_machine_unless_it_is_told_to() -> None:
    """The bridge's sockets, as the kernel lists them: UDP for the datagrams, one port for zenoh."""
    assert DEFAULT_LISTEN.startswith("tcp/127.0.0.1:")
    endpoint = free_endpoint()
    with bridge("--to", "zenoh", "--listen", endpoint) as (process, datagrams):
        assert sockets_of(process.pid, "udp") == {datagrams}
        assert sockets_of(process.pid, "udp6") == set()
        assert sockets_of(process.pid, "tcp") == {endpoint.removeprefix("tcp/")}
        assert sockets_of(process.pid, "tcp6") == set()


def test_who_may_listen_from_outside_is_said() -> None:
    port = free_endpoint().rpartition(":")[2]
    with bridge("--to", "zenoh", "--listen", f"tcp/0.0.0.0:{port}") as (process, _):
        _, _, stderr = ended(process, signal.SIGTERM)
    assert stderr == "eqrt bridge: everybody who can reach 0.0.0.0 can listen\n"


def test_a_configuration_of_zenohs_own_is_used(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    file = tmp_path / "session.json5"
    scouting = "scouting: {multicast: {enabled: false}}"
    file.write_text(f'{{mode: "router", listen: {{endpoints: ["{endpoint}"]}}, {scouting}}}')
    with (
        bridge("--to", "zenoh", "--zenoh-config", str(file)) as (process, datagrams),
        DatagramPublisher([datagrams]) as service,
        subscriber(endpoint) as newest,
    ):
        assert set(heard_of(service, newest, nobody())) == {"eqrt/forecasts", "eqrt/status"}
        assert ended(process, signal.SIGTERM)[0] == 0


def sockets_of(pid: int, protocol: str) -> set[str]:
    """Local addresses of a process's sockets, from /proc (proc(5)); IPv6 ones as they stand."""
    links = []
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            links.append(str(descriptor.readlink()))
    found = set()
    for line in Path(f"/proc/{pid}/net/{protocol}").read_text().splitlines()[1:]:
        fields = line.split()
        if f"socket:[{fields[9]}]" in links:
            found.add(dotted(fields[1]))
    return found


def dotted(address: str) -> str:
    host, _, port = address.partition(":")
    if len(host) > 8:
        return address
    return f"{socket.inet_ntoa(bytes.fromhex(host)[::-1])}:{int(port, 16)}"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "zenoh", "--key", "a//b"], "no beginning of a zenoh key"),
        (["--to", "zenoh", "--key", "eqrt/*"], "no beginning of a zenoh key"),
        (["--to", "zenoh", "--listen", "nonsense"], "endpoints are like tcp/"),
        (["--to", "zenoh", "--zenoh-config", "not-there.json5"], "not-there.json5"),
        (["--to", "zenoh", "--send", "127.0.0.1:9"], "--send is for --to plotjuggler"),
        (["--to", "plotjuggler", "--zenoh-config", "x"], "--zenoh-config is for --to zenoh"),
        (["--to", "plotjuggler", "--send", "nowhere"], "cannot send datagrams to 'nowhere'"),
    ],
)
def test_wrong_use_is_said_in_one_line(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bridge", "--datagrams", f"127.0.0.1:{free_udp_port()}", *arguments]) == 2
    captured = capsys.readouterr().err
    assert words in captured
    assert captured.count("\n") == 1
    assert ".rs:" not in captured


def test_a_port_that_is_taken_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        datagrams = f"127.0.0.1:{free_udp_port()}"
        command = ["bridge", "--to", "zenoh", "--listen", endpoint, "--datagrams", datagrams]
        assert main(command) == 2
    assert "choose another endpoint with --listen" in capsys.readouterr().err
