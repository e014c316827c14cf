"""The page's server: what it gives, whom it refuses, and that nobody waits for a slow page."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import os
import re
import signal
import socket
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from crowd import crowd
from eqrt.cli import main
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.view.guests import is_loopback, is_our_name, is_our_page
from eqrt.runtime.view.server import MAX_PAGES, PAGE, QUEUE, Outbox, ViewServer, Wanted
from eqrt.runtime.view.updates import decode_update
from viewing import Viewing

HOST = "127.0.0.1"
UPDATE = bytes(60_000)


class Fixed:
    """A source that knows three cycles."""

    def greet(self, outbox: Outbox) -> None:
        outbox.tell("hello", '{"kind": "hello"}')
        outbox.fill_in(iter([b"past 2", b"past 1"]))

    def find(self, wanted: Wanted) -> Iterator[str | bytes]:
        return (b"cycle %d" % number for number in range(wanted.first, wanted.last))


def with_server(test: Callable[[ViewServer], Awaitable[None]]) -> None:
    async def run() -> None:
        async with ViewServer(Fixed(), host=HOST, port=0) as server:
            await test(server)

    asyncio.run(asyncio.wait_for(run(), 60.0))


def stream_of(server: ViewServer) -> str:
    return server.address.replace("http", "ws") + "stream"


def get(host: str, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """A plain request with headers of our choice."""
    with contextlib.closing(http.client.HTTPConnection(host, timeout=20)) as connection:
        connection.request("GET", path, headers=headers)
        with connection.getresponse() as answer:
            return answer.status, dict(answer.getheaders()), answer.read()


def test_a_page_gets_what_is_new_before_what_is_past() -> None:
    async def test(server: ViewServer) -> None:
        async with connect(stream_of(server)) as page:
            assert await page.recv() == '{"kind": "hello"}'
            server.show(b"new")
            assert sorted([await page.recv() for _ in range(3)]) == [b"new", b"past 1", b"past 2"]
            await page.send('{"first": 5, "last": 7}')
            assert [await page.recv(), await page.recv()] == [b"cycle 5", b"cycle 6"]

    with_server(test)


def test_texts_go_first_and_a_newer_one_replaces_an_older_one() -> None:
    async def test() -> None:
        outbox = Outbox()
        outbox.show(b"cycle")
        outbox.tell("status", "old")
        outbox.tell("lanes", "lanes")
        outbox.tell("status", "new")
        assert [await outbox.next() for _ in range(3)] == ["lanes", "new", b"cycle"]

    asyncio.run(test())


def test_a_page_that_does_not_read_costs_a_few_updates_of_memory_and_the_others_nothing() -> None:
    async def test(server: ViewServer) -> None:
        async with (
            connect(stream_of(server), max_queue=1) as slow,
            connect(stream_of(server)) as quick,
        ):
            for _ in range(3):  # hello and the past
                await quick.recv()
            slow.transport.pause_reading()
            spent_s, got = 0.0, 0
            for number in range(500):
                started_s = time.perf_counter()
                server.show(number.to_bytes(4, "little") + UPDATE)
                spent_s += time.perf_counter() - started_s
                assert (await quick.recv())[:4] == number.to_bytes(4, "little")
                got += 1
            assert got == 500
            assert spent_s < 1.0  # nobody waits for the slow one
            assert server.skipped > 300  # the rest lies in buffers of the kernel
            assert max(len(outbox._updates) for outbox in server._outboxes.values()) <= QUEUE
            slow.transport.resume_reading()
            while (await slow.recv())[:4] != (499).to_bytes(4, "little"):
                pass  # what was under way, then the newest

    with_server(test)


async def read_nothing(server: ViewServer) -> ClientConnection:
    """A page that has stopped, with all buffers on the way to it full."""
    page = await connect(stream_of(server), max_queue=1)
    page.transport.pause_reading()
    for _ in range(300):
        server.show(UPDATE)
        await asyncio.sleep(0)
    return page


def test_a_page_that_reads_nothing_for_long_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eqrt.runtime.view.server.STUCK_S", 0.5)

    async def test(server: ViewServer) -> None:
        page = await read_nothing(server)
        while server.pages:
            server.show(UPDATE)
            await asyncio.sleep(0.01)
        page.transport.abort()

    with_server(test)


def test_a_page_that_reads_nothing_does_not_keep_the_server_from_ending() -> None:
    async def run() -> None:
        async with ViewServer(Fixed(), host=HOST, port=0) as server:
            page = await read_nothing(server)
        assert server.pages == 0
        page.transport.abort()

    asyncio.run(asyncio.wait_for(run(), 15.0))


def test_a_page_that_has_gone_is_forgotten() -> None:
    async def test(server: ViewServer) -> None:
        async with connect(stream_of(server)) as page:
            await page.recv()
            assert server.pages == 1
            page.transport.abort()
        while server.pages:
            await asyncio.sleep(0.01)

    with_server(test)


@pytest.mark.parametrize("asked", ["nonsense", '{"first": "a", "last": 2}', "x" * 5_000, b"\x00"])
def test_who_asks_for_what_we_do_not_know_is_let_go(asked: str | bytes) -> None:
    async def test(server: ViewServer) -> None:
        async with connect(stream_of(server)) as page:
            await page.send(asked)
            with contextlib.suppress(ConnectionClosed):
                async for _ in page:  # the greeting and the past, and then it is closed
                    pass
        while server.pages:
            await asyncio.sleep(0.01)

    with_server(test)


def test_no_page_is_too_many_until_many_are_open() -> None:
    async def test(server: ViewServer) -> None:
        pages: list[ClientConnection] = [await connect(stream_of(server)) for _ in range(MAX_PAGES)]
        with pytest.raises(InvalidStatus, match="503"):
            await connect(stream_of(server))
        for page in pages:
            await page.close()

    with_server(test)


@pytest.mark.parametrize(
    ("host", "ours"),
    [
        ("127.0.0.1:47320", True),
        ("localhost:9999", True),  # where ssh -L brings it to
        ("[::1]:47320", True),
        ("192.168.1.7:47320", True),  # an address cannot be made to resolve to another
        ("car7", True),  # what it was told to be served as
        ("evil.example", False),
        ("127.0.0.1.evil.example:47320", False),
        ("localhost.evil.example", False),
        ("", False),
        ("[", False),
    ],
)
def test_only_names_of_this_machine_are_answered(host: str, ours: bool) -> None:
    assert is_our_name(host, "car7") is ours


def test_only_the_page_itself_may_open_its_stream() -> None:
    assert is_our_page("http://localhost:47320", "localhost:47320")
    assert is_our_page(None, "localhost:47320")  # a program, which no browser runs for a stranger
    assert not is_our_page("http://localhost:3000", "localhost:47320")
    assert not is_our_page("http://evil.example", "localhost:47320")
    assert not is_our_page("null", "localhost:47320")


def test_loopback_is_told_from_the_rest() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "::1", "localhost", "127.1.2.3")))
    assert not any(map(is_loopback, ("0.0.0.0", "192.168.1.7", "car7")))


@pytest.fixture(scope="module")
def viewing() -> Iterator[Viewing]:
    with Viewing() as viewing:
        yield viewing


def test_the_page_is_served_whole_and_loads_nothing_from_elsewhere(viewing: Viewing) -> None:
    status, headers, body = get(viewing.host, "/")
    assert status == 200
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    names = set(re.findall(r'(?:src|href)="([^"]+)"', body.decode()))
    names |= {
        name.removeprefix("./")
        for file in PAGE.glob("*.mjs")
        for name in re.findall(r'from "([^"]+)"', file.read_text())
    }
    assert names | {"index.html"} == {file.name for file in PAGE.iterdir()}
    for name in names:
        assert get(viewing.host, f"/{name}")[0] == 200
    everything = "".join(file.read_text() for file in PAGE.iterdir())
    assert set(re.findall(r"https?://[^\s\"']+", everything)) == {"http://www.w3.org/2000/svg"}


@pytest.mark.parametrize("path", ["/../server.py", "/%2e%2e/server.py", "/nothing", "//etc/passwd"])
def test_nothing_but_the_page_is_served(viewing: Viewing, path: str) -> None:
    assert get(viewing.host, path)[0] == 404


def test_a_name_that_is_not_ours_and_a_page_that_is_not_ours_are_refused(viewing: Viewing) -> None:
    opening = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }
    assert get(viewing.host, "/", Host="evil.example")[0] == 421
    assert get(viewing.host, "/stream", Host="evil.example", **opening)[0] == 421
    assert get(viewing.host, "/stream", Origin="http://evil.example", **opening)[0] == 403
    same = {"Origin": f"http://{viewing.host}"}
    assert get(viewing.host, "/stream", **same, **opening)[0] == 101


def test_what_the_service_sends_reaches_a_page_with_the_minute_before(viewing: Viewing) -> None:
    async def listen() -> list[int]:
        with DatagramPublisher([viewing.datagrams]) as publisher:
            for cycle in range(15):
                publisher.publish(crowd(cycle, 9))
                await asyncio.sleep(0.01)
            async with connect(f"ws://{viewing.host}/stream") as page:
                seen: list[int] = []
                while len(seen) < 15:
                    message = await page.recv()
                    if isinstance(message, bytes):
                        seen.append(decode_update(message)[0]["cycle"])
                publisher.publish(crowd(15, 9))
                while not isinstance(message := await page.recv(), bytes):
                    pass
                return [*seen, decode_update(message)[0]["cycle"]]

    assert asyncio.run(asyncio.wait_for(listen(), 60.0)) == [*range(14, -1, -1), 15]


def test_what_is_no_datagram_of_ours_is_said_on_the_page(viewing: Viewing) -> None:
    async def trouble(page: ClientConnection) -> str:
        while True:
            message = await page.recv()
            if isinstance(message, str) and json.loads(message)["kind"] == "trouble":
                return str(json.loads(message)["words"])

    async def listen() -> tuple[str, str]:
        host, _, port = viewing.datagrams.rpartition(":")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"\x81\xa7version\x63", (host, int(port)))
        async with connect(f"ws://{viewing.host}/stream") as page:
            before = await trouble(page)
            with DatagramPublisher([viewing.datagrams]) as publisher:
                publisher.publish(crowd(0, 1))
            return before, await trouble(page)

    before, after = asyncio.run(asyncio.wait_for(listen(), 60.0))
    assert before == "datagram format 99, this version of eqrt reads format 2"
    assert after == ""  # when what comes can be read again


def test_a_file_is_told_cycle_by_cycle(tmp_path: Path) -> None:
    path = tmp_path / "some.jsonl"
    path.write_bytes(b"".join(json_lines(crowd(cycle, 5)) for cycle in range(120)))

    async def listen(host: str) -> list[int]:
        async with connect(f"ws://{host}/stream") as page:
            times_s: list[float] = []
            while len(times_s) < 120:
                message = await page.recv()
                if isinstance(message, str) and json.loads(message)["kind"] == "index":
                    times_s = json.loads(message)["times_s"]
            await page.send('{"first": 50, "last": 53}')
            seen: list[int] = []
            while len(seen) < 3:
                if isinstance(message := await page.recv(), bytes):
                    seen.append(decode_update(message)[0]["cycle"])
            return seen

    with Viewing(str(path)) as viewing:
        assert asyncio.run(asyncio.wait_for(listen(viewing.host), 60.0)) == [50, 51, 52]


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_when_told_to_also_while_a_page_is_open(by: signal.Signals) -> None:
    async def listen(viewing: Viewing) -> tuple[int, str, str]:
        async with connect(f"ws://{viewing.host}/stream") as page:
            await page.recv()
            return await asyncio.to_thread(viewing.end, by)

    with Viewing() as viewing:
        status, stdout, stderr = asyncio.run(listen(viewing))
    assert (status, stdout, stderr) == (0, "eqrt view: ended\n", "")


def test_a_port_that_is_taken_is_said_in_one_line(
    viewing: Viewing, capsys: pytest.CaptureFixture[str]
) -> None:
    port = viewing.host.rpartition(":")[2]
    assert main(["view", "--port", port, "--datagrams", "127.0.0.1:0"]) == 2
    assert "give --port another number" in capsys.readouterr().err
    assert main(["view", "--datagrams", viewing.datagrams]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "if another viewer does" in error


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--port", "70000"], "--port is 70000"),
        (["--datagrams", "nowhere"], "give HOST:PORT"),
        (["missing.jsonl"], "no such file"),
        ([str(PAGE)], "there is no recording of eqrt in it"),
        (["--tile", "missing.tile", "--datagrams", "127.0.0.1:0"], "no such tile file"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(
    argv: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", "--port", "0", *argv]) in {1, 2}
    error = capsys.readouterr().err
    assert error.startswith("eqrt: ")
    assert error.count("\n") == 1
    assert said in error


def test_a_wider_address_is_warned_about() -> None:
    with Viewing("--host", "0.0.0.0") as viewing:
        assert "everybody who can reach 0.0.0.0 can watch" in viewing.end()[2]


def test_over_ssh_it_says_how_to_reach_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "SSH_CONNECTION", "1.2.3.4 1 5.6.7.8 22")
    with Viewing() as viewing:
        port = viewing.host.rpartition(":")[2]
        assert f"ssh -L {port}:127.0.0.1:{port}" in viewing.ready
