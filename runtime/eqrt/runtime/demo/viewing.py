"""The demo in a browser: `eqrt view` beside it, if it is installed."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import sys
from collections.abc import Iterator

from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.demo.programs import eqrt, running

_USUAL_PORT = 47320  # of the page


@contextlib.contextmanager
def watched(wanted: bool | None) -> Iterator[list[str]]:
    """Serve the view until the end of the block; gives where it wants datagrams (none: no view).

    `wanted`: None = if it is installed. Opens a browser only where there is a person with a screen.
    """
    missing = importlib.util.find_spec("websockets") is None
    if missing and wanted:
        raise UsageError("--view needs the extra `view`: pip install 'eqrt[view]'")
    if missing or wanted is False:
        if missing:
            print("to watch it in a browser: pip install 'eqrt[view]'")
        yield []
        return
    datagrams = f"127.0.0.1:{_free_udp_port()}"
    port = _USUAL_PORT if _is_free(_USUAL_PORT) else 0
    command = [*eqrt("view"), "--port", str(port), "--datagrams", datagrams]
    if sys.stdout.isatty() and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        command.append("--open")
    with running(command) as view:
        assert view.stdout is not None
        line = view.stdout.readline().strip()
        if not line.startswith("eqrt view: http"):
            raise EqrtError(f"the view did not start: {line or 'it said nothing'}")
        print(f"watch it at {line.split()[2]}", flush=True)
        yield [datagrams]


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
