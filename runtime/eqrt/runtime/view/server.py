"""Pages and their sockets, on one port.

Every page has a queue of its own, of `QUEUE` updates: one that reads too slowly gets fewer updates,
the newest ones, and one that reads nothing is let go after a while. Nobody waits for a page.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import deque
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Protocol

import msgspec
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from eqrt.core.errors import UsageError
from eqrt.runtime.view.guests import PAGE_HEADERS, is_our_name, is_our_page

PAGE = Path(__file__).parent / "page"
SOCKET_PATH = "/stream"
SERVER_ID = secrets.token_hex(8)
"""By which a page that comes back tells whether this is the server that it knew."""
QUEUE = 4
MAX_PAGES = 16
STUCK_S = 20.0
"""How long a page may read nothing; then its connection is cut."""
_PING_S = 10.0
_FAREWELL_S = 1.5
_MAX_ASKED_BYTES = 1_000
_WRITE_BYTES = 1 << 16  # beyond what the kernel buffers, an update more or less
AT_ONCE = 100
"""Updates that a page may ask for."""
_ASKED = 8  # times that it may ask before it is answered; more, and the first is forgotten


class Outbox:
    """What one page has not been sent yet."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._updates: deque[bytes] = deque()
        self._past: deque[Iterator[str | bytes]] = deque(maxlen=_ASKED)
        self._filled = asyncio.Event()
        self.skipped = 0
        """Updates that were dropped because the page was too slow."""

    def tell(self, kind: str, text: str) -> None:
        """A text; a newer one of the same kind replaces it."""
        self._texts.pop(kind, None)
        self._texts[kind] = text
        self._filled.set()

    def show(self, update: bytes) -> None:
        """A new cycle; when the queue is full, the oldest is dropped."""
        self._updates.append(update)
        while len(self._updates) > QUEUE:
            self._updates.popleft()
            self.skipped += 1
        self._filled.set()

    def fill_in(self, past: Iterator[str | bytes]) -> None:
        """Earlier cycles, for when there is nothing newer to send."""
        self._past.append(past)
        self._filled.set()

    async def next(self) -> str | bytes:
        """The most urgent."""
        while True:
            if self._texts:
                return self._texts.pop(next(iter(self._texts)))
            if self._updates:
                return self._updates.popleft()
            while self._past:
                if (update := next(self._past[0], None)) is not None:
                    return update
                self._past.popleft()
            self._filled.clear()
            await self._filled.wait()


class Wanted(msgspec.Struct):
    """What a page may ask of a file: the updates `first` to `last - 1`."""

    first: int
    last: int
    lanes: int = -1
    """Number of the lanes that the page has."""


class Source(Protocol):
    """What pages are told; one of `live.Live` and `playback.Playback`."""

    def greet(self, outbox: Outbox) -> None:
        """Tell a new page what it needs to know."""

    def find(self, wanted: Wanted) -> Iterator[str | bytes]:
        """What a page asks for."""


class ViewServer:
    """Serves pages of one source, until the end of its `async with` block."""

    def __init__(self, source: Source, *, host: str, port: int) -> None:
        """`port`: 0 = any that is free."""
        self._source = source
        self._host, self._port = host, port
        self._outboxes: dict[ServerConnection, Outbox] = {}
        self._server: Server | None = None

    @property
    def address(self) -> str:
        """Of the page, for a browser."""
        assert self._server is not None
        port = next(iter(self._server.sockets)).getsockname()[1]
        name = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{name}:{port}/"

    @property
    def pages(self) -> int:
        """Open ones."""
        return len(self._outboxes)

    @property
    def skipped(self) -> int:
        """Updates that open pages were too slow for."""
        return sum(outbox.skipped for outbox in self._outboxes.values())

    def tell(self, kind: str, text: str) -> None:
        """A text for every page."""
        for outbox in self._outboxes.values():
            outbox.tell(kind, text)

    def show(self, update: bytes) -> None:
        """A new cycle for every page."""
        for outbox in self._outboxes.values():
            outbox.show(update)

    async def __aenter__(self) -> ViewServer:
        log = logging.getLogger("eqrt.view")
        log.setLevel(logging.CRITICAL)  # who was refused, and why, the browser is told
        try:
            self._server = await serve(
                self._attend,
                self._host,
                self._port,
                process_request=self._answer,
                compression=None,
                ping_interval=_PING_S,
                ping_timeout=_PING_S,
                close_timeout=1.0,
                max_size=_MAX_ASKED_BYTES,
                write_limit=_WRITE_BYTES,
                server_header=None,
                logger=log,
            )
        except OSError as error:
            raise UsageError(
                f"cannot serve the view at {self._host}:{self._port} "
                f"({error.strerror or error}); give --port another number, or 0 for any"
            ) from error
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._server is None:
            return
        self._server.close()
        try:
            async with asyncio.timeout(_FAREWELL_S):
                await self._server.wait_closed()
        except TimeoutError:  # a page that does not read takes no farewell either
            for connection in list(self._outboxes):
                connection.transport.abort()
            await self._server.wait_closed()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """None = go on and open the socket."""
        host = request.headers.get("Host", "")
        if not is_our_name(host, self._host):
            return _response(HTTPStatus.MISDIRECTED_REQUEST, b"This is eqrt view, at localhost.\n")
        path = request.path.partition("?")[0]
        if path != SOCKET_PATH:
            return page_file(path)
        if not is_our_page(request.headers.get("Origin"), host):
            return _response(HTTPStatus.FORBIDDEN, b"Not from this page.\n")
        if len(self._outboxes) >= MAX_PAGES:
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, b"Too many pages are open.\n")
        del connection
        return None

    async def _attend(self, connection: ServerConnection) -> None:
        """One page, until it goes."""
        outbox = Outbox()
        self._outboxes[connection] = outbox
        self._source.greet(outbox)
        sending = asyncio.create_task(_send(connection, outbox))
        try:
            async for asked in connection:
                wanted = msgspec.json.decode(asked, type=Wanted)
                wanted.last = min(wanted.last, wanted.first + AT_ONCE)
                outbox.fill_in(self._source.find(wanted))
        except (ConnectionClosed, msgspec.MsgspecError):
            pass  # a page that asks for what we do not know is none of ours
        finally:
            self._outboxes.pop(connection, None)
            sending.cancel()


async def _send(connection: ServerConnection, outbox: Outbox) -> None:
    """Until it goes, or does not take a message for `STUCK_S`."""
    try:
        while True:
            message = await outbox.next()
            async with asyncio.timeout(STUCK_S):
                await connection.send(message)
    except TimeoutError:
        connection.transport.abort()
    except ConnectionClosed:
        pass


def page_file(path: str) -> Response:
    """A file of the page, or that there is none."""
    name = path.removeprefix("/") or "index.html"
    known = {file.name: file for file in PAGE.iterdir() if file.is_file()}
    if name not in known:
        return _response(HTTPStatus.NOT_FOUND, b"There is no such page; the view is at /\n")
    kind = _KINDS.get(known[name].suffix, "application/octet-stream")
    return _response(HTTPStatus.OK, known[name].read_bytes(), kind)


_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


def _response(status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> Response:
    headers = Headers(PAGE_HEADERS)
    headers["Content-Type"] = kind
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
