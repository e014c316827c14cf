"""`/metrics` and `/health` over HTTP, served by the service's own loop in steps that cannot wait.

Nothing here may delay a prediction, so there are no threads to share Python with and nothing
blocks: at most every 20 ms a few sockets that are ready are read from or written to. A request has
1 KiB and two seconds; if too many are connected, the oldest is cut off. That it is the loop that
answers is a feature: a loop that hangs is not healthy.
"""

from __future__ import annotations

import ipaddress
import json
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from eqrt.core.errors import AddressError, UsageError
from eqrt.runtime.operation.metrics import CONTENT_TYPE, Latencies, render
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.output.status import ServiceStatus

DEFAULT_ADDRESS = "127.0.0.1:9464"
MAX_CLIENTS = 8
MAX_REQUEST_BYTES = 1024
REQUEST_S = 2.0
"""For a request to come and its answer to go."""
_STEP_S = 0.02
_STEPS_AT_ONCE = 4
_STALE_S = 3.0  # a status is made every second
_JSON = "application/json"


@dataclass(slots=True)
class _Client:
    """One connection: its request as far as it came, or its answer as far as it has not gone."""

    socket: socket.socket
    ends_s: float
    request: bytes = b""
    answer: bytes = b""


class Endpoint:
    """Hears every status (`service.Observer`), answers between cycles (`service.Chore`)."""

    def __init__(
        self,
        address: str,
        *,
        anywhere: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`address`: `HOST:PORT`; port 0 = any that is free. `anywhere`: not only loopback.

        Raises UsageError if that is no address, or not loopback and may not be; AddressError if
        the system does not let it listen there, which may change.
        """
        self._clock = clock
        self._listener = _listener(address, anywhere)
        self._poll = select.poll()
        self._poll.register(self._listener, select.POLLIN)
        self._clients: dict[int, _Client] = {}
        self._due_s = 0.0
        self._status: ServiceStatus | None = None
        self._latencies = Latencies()
        self._page: bytes | None = None

    @property
    def address(self) -> str:
        """Where it listens, `HOST:PORT`."""
        host, port = self._listener.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def observe(self, status: ServiceStatus) -> None:
        """Take another second."""
        self._status, self._page = status, None
        self._latencies.add(status.latencies_s)

    def __call__(self) -> None:
        """A few steps, if it is time."""
        now_s = self._clock()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _STEP_S
        for number, _ in self._poll.poll(0)[:_STEPS_AT_ONCE]:
            if number == self._listener.fileno():
                self._accept(now_s)
            elif number in self._clients:
                self._step(self._clients[number])
        for client in [one for one in self._clients.values() if now_s >= one.ends_s]:
            self._close(client)

    def _accept(self, now_s: float) -> None:
        try:
            accepted, _ = self._listener.accept()
        except OSError:  # it has gone again, or there are no more descriptors
            return
        accepted.setblocking(False)
        if len(self._clients) >= MAX_CLIENTS:
            self._close(min(self._clients.values(), key=lambda client: client.ends_s))
        client = _Client(accepted, now_s + REQUEST_S)
        self._clients[accepted.fileno()] = client
        self._poll.register(accepted, select.POLLIN)
        self._step(client)  # mostly the request is there already

    def _step(self, client: _Client) -> None:
        try:
            if not client.answer:
                self._read(client)
            if client.answer:
                client.answer = client.answer[client.socket.send(client.answer) :]
                if not client.answer:
                    self._close(client)
        except BlockingIOError:
            pass
        except OSError:
            self._close(client)

    def _read(self, client: _Client) -> None:
        part = client.socket.recv(MAX_REQUEST_BYTES)
        client.request += part
        if b"\r\n\r\n" in client.request:
            client.answer = self._answer(client.request)
            self._poll.modify(client.socket, select.POLLOUT)
        elif not part or len(client.request) >= MAX_REQUEST_BYTES:
            self._close(client)

    def _close(self, client: _Client) -> None:
        if self._clients.pop(client.socket.fileno(), None) is not None:
            self._poll.unregister(client.socket)
            client.socket.close()

    def _answer(self, request: bytes) -> bytes:
        method, _, rest = request.partition(b" ")
        path = rest.partition(b" ")[0].partition(b"?")[0]
        if method not in (b"GET", b"HEAD"):
            status, kind, body = "405 Method Not Allowed", "text/plain", b"only GET\n"
        elif path == b"/metrics":
            status, kind, body = self._metrics()
        elif path == b"/health":
            is_well, told = health(self._status, self._clock())
            status = "200 OK" if is_well else "503 Service Unavailable"
            kind, body = _JSON, json.dumps(told).encode() + b"\n"
        else:
            status, kind, body = "404 Not Found", "text/plain", b"there are /metrics and /health\n"
        head = (
            f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
            f"Connection: close\r\n\r\n"
        ).encode()
        return head if method == b"HEAD" else head + body

    def _metrics(self) -> tuple[str, str, bytes]:
        if self._status is None:
            return "503 Service Unavailable", "text/plain", b"no second has passed yet\n"
        if self._page is None:
            self._page = render(self._status, self._latencies).encode()
        return "200 OK", CONTENT_TYPE, self._page

    def close(self) -> None:
        """Give the sockets back; leaving a `with` block does it too."""
        for client in list(self._clients.values()):
            self._close(client)
        self._listener.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def health(status: ServiceStatus | None, now_s: float) -> tuple[bool, dict[str, object]]:
    """Whether the service predicts, and what to say of it; `reason` is empty if it does."""
    if status is None:
        return False, {"status": "starting", "reason": "no second has passed yet"}
    reason = _reason(status, now_s)
    return not reason, {
        "status": "unavailable" if reason else "ok",
        "reason": reason,
        "mode": Mode(status.mode).name,
        "mode_seconds": round(status.mode_s, 3),
        "objects": status.objects,
        "uptime_seconds": round(status.uptime_s, 3),
        "model_id": status.model_id,
        "tile_id": status.tile_id,
    }


def _reason(status: ServiceStatus, now_s: float) -> str:
    if now_s - status.time_s > _STALE_S:
        return f"the service has been busy for {now_s - status.time_s:.0f} s"
    if not status.totals.get("pipeline_cycles"):
        return "no object cycle has come yet"
    if status.mode == Mode.SILENT:
        return f"no input for {status.mode_s:.0f} s"
    if not status.ego_known:
        return "no ego motion: nothing is predicted"
    return ""


def _listener(address: str, anywhere: bool) -> socket.socket:
    host, _, port = address.rpartition(":")
    try:
        if not host or not 0 <= int(port) < 65_536:
            raise ValueError("no host, or no port")
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
        family, _, _, _, target = found[0]
        if not anywhere and not ipaddress.ip_address(str(target[0])).is_loopback:
            raise UsageError(
                f"--metrics {address}: not on this machine's loopback, so others could read it; "
                f"if that is meant, say --metrics-anywhere"
            )
        listener = socket.create_server((str(target[0]), int(target[1])), family=family, backlog=16)
    except (OSError, ValueError) as error:
        kind = AddressError if isinstance(error, OSError) else UsageError
        raise kind(
            f"--metrics {address}: cannot listen there ({error}); give HOST:PORT, such as "
            f"{DEFAULT_ADDRESS}"
        ) from error
    listener.setblocking(False)
    return listener
