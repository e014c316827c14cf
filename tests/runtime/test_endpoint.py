"""/metrics and /health: what they say, and that nobody who asks can delay the loop."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families

from drives import TILE, Car, cycle, shipped_predictor
from eqrt.core.errors import AddressError, UsageError
from eqrt.core.frames import Pose2
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.links import opener
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.operation.endpoint import (
    MAX_CLIENTS,
    MAX_REQUEST_BYTES,
    REQUEST_S,
    Endpoint,
    health,
)
from eqrt.runtime.operation.metrics import BUCKETS_S, METRICS, Latencies, render
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.output.status import BusStatus, ServiceStatus, SourceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.status_book import StatusBook
from no_channels import NoChannels
from processes import PATIENCE_S, Serving, eqrt
from source_tree import ROOT

STATES = ("UP", "ERROR_PASSIVE", "BUS_OFF", "DOWN")
EGO_MOTION = 0x5A0  # of the generic object list
SAMPLE = re.compile(r'^(\w+)(?:\{((?:\w+="(?:[^"\\\n]|\\[\\"n])*",?)+)\})? (\S+)$')


@pytest.fixture
def status() -> ServiceStatus:
    """Of a service that has just begun, with everything that a status can have."""
    pipeline = Pipeline(load_profile("ars408"), shipped_predictor())
    channel = f"status-{time.monotonic_ns()}"
    with Receiver(opener(LOCAL, fd=None), {channel: None}, lambda _: None) as receiver:
        made = StatusBook(pipeline, receiver, []).close(time.monotonic() + 1.0)
    return msgspec.structs.replace(
        made,
        mode=int(Mode.RUN),
        ego_known=True,
        tile='/a "b"\\c\nd',
        latencies_s=[0.004, 0.005, 0.012, 9.0],
        totals=made.totals | {"pipeline_cycles": 7},
        buses=[BusStatus(channel="can0", state="BUS_OFF", since_s=1.0, losses=2, overflow=3)],
        sources=[SourceStatus(name="radar", valid=False, reason="x", since_s=1.0)],
    )


def samples(text: str) -> dict[tuple[str, str], float]:
    """Name and labels -> value, of every line that is no comment; fails for one of another form."""
    found = {}
    for line in text.splitlines():
        if line.startswith("#"):
            assert re.fullmatch(r"# (HELP \w+ .+|TYPE \w+ (gauge|counter|histogram))", line), line
            continue
        parts = SAMPLE.match(line)
        assert parts is not None, line
        assert (parts[1], parts[2] or "") not in found
        found[parts[1], parts[2] or ""] = float(parts[3])
    return found


# --- what is said


def test_metrics_say_what_the_status_says(status: ServiceStatus) -> None:
    latencies = Latencies()
    latencies.add(status.latencies_s)
    latencies.add([0.5])
    text = render(status, latencies)
    assert text.endswith("\n")
    found = samples(text)
    assert found["eqrt_mode", 'mode="RUN"'] == 1.0
    assert sum(found["eqrt_mode", f'mode="{mode.name}"'] for mode in Mode) == 1.0
    assert found["eqrt_pipeline_cycles_total", ""] == 7
    assert found["eqrt_bus_up", 'channel="can0"'] == 0.0
    assert found["eqrt_bus_losses_total", 'channel="can0"'] == 2.0
    assert found["eqrt_bus_overflow_messages_total", 'channel="can0"'] == 3.0
    assert found["eqrt_source_valid", 'source="radar"'] == 0.0
    assert 20e6 < found["process_resident_memory_bytes", ""] < 20e9
    buckets = [found["eqrt_latency_seconds_bucket", f'le="{le}"'] for le in (*BUCKETS_S, "+Inf")]
    assert buckets[:4] == [0, 2, 2, 3]  # 0.005 is in the bucket that ends there
    assert buckets[-2:] == [4, 5]
    assert found["eqrt_latency_seconds_count", ""] == 5
    assert found["eqrt_latency_seconds_sum", ""] == pytest.approx(9.521)
    (info,) = (labels for name, labels in found if name == "eqrt_info")
    assert r'tile="/a \"b\"\\c\nd"' in info


def test_metrics_are_named_as_prometheus_wants_them(status: ServiceStatus) -> None:
    """Counters end in _total, nothing else does; every metric says its help and type, once."""
    text = render(status, Latencies())
    types = re.findall(r"^# TYPE (\w+) (\w+)$", text, re.MULTILINE)
    names = [name for name, _ in types]
    assert len(names) == len(set(names))
    assert re.findall(r"^# HELP (\w+) ", text, re.MULTILINE) == names
    for name, kind in types:
        assert (kind == "counter") == name.endswith("_total")
        assert re.fullmatch(r"(eqrt|process)_[a-z0-9_]+", name)
    with_samples = {name.removesuffix("_bucket") for name, _ in samples(text)}
    assert set(names) <= with_samples


def test_prometheus_own_reader_reads_them(status: ServiceStatus) -> None:
    latencies = Latencies()
    latencies.add(status.latencies_s)
    text = render(status, latencies)
    read = {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert len(read) == len(samples(text))
    (info,) = (dict(labels) for name, labels in read if name == "eqrt_info")
    assert info["tile"] == status.tile
    assert read["eqrt_latency_seconds_bucket", (("le", "+Inf"),)] == 4


def test_every_metric_is_one_family_with_one_type(status: ServiceStatus) -> None:
    """As the format demands; the counts of channels are said by channel and not once more."""
    text = render(status, Latencies())
    families = [family.name for family in text_string_to_metric_families(text)]
    assert len(families) == len(set(families))
    assert {"bus_not_up", "bus_losses", "bus_error_frames"} <= set(status.totals)
    losses = [line for line in text.splitlines() if line.startswith("eqrt_bus_losses_total")]
    assert losses == ['eqrt_bus_losses_total{channel="can0"} 2.0']
    assert "bus_not_up" not in text


@pytest.mark.parametrize(
    ("state", "is_up"), [("UP", 1), ("ERROR_PASSIVE", 1), ("BUS_OFF", 0), ("DOWN", 0)]
)
def test_a_channel_that_carries_messages_is_up(
    state: str, is_up: int, status: ServiceStatus
) -> None:
    bus = BusStatus(channel="can0", state=state, since_s=1.0)
    found = samples(render(msgspec.structs.replace(status, buses=[bus]), Latencies()))
    assert found["eqrt_bus_up", 'channel="can0"'] == is_up
    states = {one: found["eqrt_bus_state", f'channel="can0",state="{one}"'] for one in STATES}
    assert states == {one: float(one == state) for one in STATES}


def test_the_documentation_has_every_metric() -> None:
    text = (ROOT / "docs/operations.md").read_text(encoding="utf-8")
    for metric in METRICS:
        assert f"| `{metric.name}` | {metric.kind} | {metric.help}" in text


def test_health_says_why_not(status: ServiceStatus) -> None:
    now_s = status.time_s + 0.5
    is_well, told = health(status, now_s)
    assert (is_well, told["status"], told["reason"], told["mode"]) == (True, "ok", "", "RUN")
    for changed, reason in (
        (None, "no second has passed"),
        (msgspec.structs.replace(status, mode=int(Mode.SILENT), mode_s=7.2), "no input for 7 s"),
        (msgspec.structs.replace(status, totals={}), "no object cycle"),
        (msgspec.structs.replace(status, ego_known=False), "no ego motion"),
        (msgspec.structs.replace(status, time_s=now_s - 9.0), "busy for 9 s"),
    ):
        is_well, told = health(changed, now_s)
        assert not is_well
        assert reason in str(told["reason"])


@pytest.mark.parametrize("ego_moves", [True, False])
def test_a_service_without_ego_motion_is_not_well_one_without_a_place_in_the_map_is(
    *, ego_moves: bool
) -> None:
    """Both are in NO_POSE; but the latter predicts, without the map."""
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), load_tile(TILE))
    book = StatusBook(pipeline, NoChannels(), [])
    for message in cycle([Car(object_id=1, x_m=5.0, y_m=0.0)], 0.0):
        if ego_moves or message.arbitration_id != EGO_MOTION:
            for forecast in pipeline.feed(message, 0.0):
                book.published(forecast)
    now_s = time.monotonic() + 1.0
    is_well, told = health(book.close(now_s), now_s)
    reason = "" if ego_moves else "no ego motion: nothing is predicted"
    assert (is_well, told["mode"], told["objects"]) == (ego_moves, "NO_POSE", int(ego_moves))
    assert told["reason"] == reason


# --- who may ask, and how


@pytest.mark.parametrize("address", ["0.0.0.0:0", "[::]:0", ":9464", "127.0.0.1", "127.0.0.1:x"])
def test_another_place_than_loopback_must_be_allowed(address: str) -> None:
    with pytest.raises(UsageError, match=r"--metrics .*(--metrics-anywhere|give HOST:PORT)"):
        Endpoint(address)


def test_another_place_can_be_allowed() -> None:
    with Endpoint("0.0.0.0:0", anywhere=True) as endpoint:
        assert re.fullmatch(r"0\.0\.0\.0:\d+", endpoint.address)


def test_a_port_that_is_taken_is_refused_in_one_line() -> None:
    with Endpoint("127.0.0.1:0") as first, pytest.raises(AddressError, match="cannot listen there"):
        Endpoint(first.address)


def test_what_may_change_ends_a_service_so_that_it_is_started_again() -> None:
    """Status 1: a port that is taken, an address that is not up yet. 2 keeps the unit down."""
    serve = ["serve", "--can", f"port-{time.monotonic_ns()}", "--can-interface", LOCAL]
    serve += ["--profile", "ars408", "--metrics-anywhere", "--metrics"]
    with Endpoint("127.0.0.1:0") as taken:
        for address, status in ((taken.address, 1), ("192.0.2.7:9464", 1), ("nowhere", 2)):
            done = eqrt(*serve, address)
            assert (done.returncode, done.stderr.count("\n")) == (status, 1)
            assert f"--metrics {address}: cannot listen there" in done.stderr


@pytest.fixture
def endpoint(status: ServiceStatus) -> Iterator[Endpoint]:
    with Endpoint("127.0.0.1:0") as made:
        made.observe(status)
        yield made


def connected(endpoint: Endpoint) -> socket.socket:
    host, port = endpoint.address.split(":")
    return socket.create_connection((host, int(port)), timeout=PATIENCE_S)


def turned(endpoint: Endpoint, seconds: float) -> float:
    """Let the loop go round for so long; the longest turn, in seconds of processor time."""
    end_s, worst_s = time.monotonic() + seconds, 0.0
    while time.monotonic() < end_s:
        before_s = time.thread_time()
        endpoint()
        worst_s = max(worst_s, time.thread_time() - before_s)
        time.sleep(0.001)
    return worst_s


def answer(endpoint: Endpoint, request: bytes) -> bytes:
    with closing(connected(endpoint)) as client:
        client.sendall(request)
        turned(endpoint, 0.1)
        parts = []
        with contextlib.suppress(ConnectionResetError):  # cut off while still sending
            while part := client.recv(65_536):
                parts.append(part)
    return b"".join(parts)


@pytest.mark.parametrize(
    ("request_line", "status_line", "body"),
    [
        (b"GET /metrics HTTP/1.1", b"200 OK", b"eqrt_uptime_seconds"),
        (b"GET /metrics?x=1 HTTP/1.0", b"200 OK", b"eqrt_uptime_seconds"),
        (b"GET /health HTTP/1.1", b"200 OK", b'"status": "ok"'),
        (b"GET / HTTP/1.1", b"404 Not Found", b"/metrics"),
        (b"POST /metrics HTTP/1.1", b"405 Method Not Allowed", b"only GET"),
        (b"\x00\xff", b"405 Method Not Allowed", b"only GET"),
    ],
)
def test_requests_are_answered(
    request_line: bytes, status_line: bytes, body: bytes, endpoint: Endpoint
) -> None:
    head, _, content = answer(endpoint, request_line + b"\r\nHost: x\r\n\r\n").partition(
        b"\r\n\r\n"
    )
    assert head.startswith(b"HTTP/1.1 " + status_line)
    assert body in content
    assert f"Content-Length: {len(content)}".encode() in head


def test_head_has_no_body(endpoint: Endpoint) -> None:
    assert answer(endpoint, b"HEAD /health HTTP/1.1\r\n\r\n").endswith(b"\r\n\r\n")


def test_a_request_that_is_too_long_or_never_ends_is_cut_off(endpoint: Endpoint) -> None:
    assert answer(endpoint, b"GET /metrics HTTP/1.1\r\nX: " + b"x" * MAX_REQUEST_BYTES) == b""
    with closing(connected(endpoint)) as slow:
        slow.sendall(b"GET /metrics HT")
        turned(endpoint, REQUEST_S + 0.3)
        assert slow.recv(1) == b""


def test_many_who_are_slow_neither_delay_the_loop_nor_lock_others_out(endpoint: Endpoint) -> None:
    """Slow loris: connections that send a byte now and then, more than there is room for."""
    with ExitStack() as stack:
        slow = [stack.enter_context(closing(connected(endpoint))) for _ in range(MAX_CLIENTS + 4)]
        worst_s = 0.0
        for client in slow:
            client.send(b"G")
            worst_s = max(worst_s, turned(endpoint, 0.05))
        text = answer(endpoint, b"GET /health HTTP/1.1\r\n\r\n")
    assert text.startswith(b"HTTP/1.1 200 OK")
    assert worst_s < 0.02
    assert len(endpoint._clients) <= MAX_CLIENTS


def test_a_reader_that_does_not_read_gets_no_more_than_its_time(endpoint: Endpoint) -> None:
    """Its window is full; the answer waits beside the loop, not in it."""
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
    host, port = endpoint.address.split(":")
    client.connect((host, int(port)))
    client.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
    with closing(client):
        assert turned(endpoint, REQUEST_S + 0.3) < 0.05
    assert not endpoint._clients


# --- of a service in a process


def test_a_service_tells_its_health_and_its_metrics_while_it_predicts() -> None:
    """503 with a reason before the first cycle and on a silent bus, 200 while it predicts."""
    channel = f"endpoint-{time.monotonic_ns()}"
    options = ["--can", channel, "--can-interface", LOCAL, "--profile", "generic", "--quiet"]
    with (
        Serving(*options, "--metrics", "127.0.0.1:0") as service,
        open_bus(channel, LOCAL, receive_ids=[]) as bus,
    ):
        address = service.read_until(r"http://([\d.:]+)/metrics")
        steps = iter(range(10_000))

        def drive() -> None:
            step = next(steps)
            for message in cycle([Car(object_id=1, x_m=5.0, y_m=0.0)], step / 10, pose=Pose2()):
                bus.send(message)
            time.sleep(0.1)

        asked = asked_until(address, 503, lambda: time.sleep(0.05))
        assert asked["reason"] in {"no object cycle has come yet", "no second has passed yet"}
        asked = asked_until(address, 200, drive)
        assert (asked["mode"], asked["objects"]) == ("NO_MAP", 1)
        _, text = fetched(f"http://{address}/metrics")
        assert samples(text)["eqrt_objects", ""] == 1
        assert samples(text)["eqrt_latency_seconds_count", ""] > 3
        asked = asked_until(address, 503, lambda: time.sleep(0.05))
        assert (asked["mode"], str(asked["reason"])[:12]) == ("SILENT", "no input for")
        status, _, stderr = service.end()
    assert (status, stderr) == (0, "")


def asked_until(address: str, code: int, meanwhile: Callable[[], None]) -> dict[str, object]:
    give_up_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up_s:
        found, text = fetched(f"http://{address}/health")
        if found == code:
            told: dict[str, object] = json.loads(text)
            return told
        meanwhile()
    raise AssertionError(text)


def fetched(url: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(url, timeout=PATIENCE_S) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()
