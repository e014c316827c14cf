"""The commands that a README tells its readers to type, run as they would."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from conformance.environments import run
from source_tree import ROOT

README = ROOT / "deploy/examples/README.md"


def blocks(text: str) -> list[str]:
    """Every block of shell commands."""
    return re.findall(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def run_all(readme: Path) -> str:
    """Run all blocks one after the other in one shell, and give what they print.

    But for the one that ends in a server: `served` starts that.
    """
    script = "".join(block for block in blocks(readme.read_text()) if "http.server" not in block)
    return run(["bash", "-euo", "pipefail", "-c", script], cwd=ROOT, env=_environment())


@contextlib.contextmanager
def served(readme: Path) -> Iterator[str]:
    """The server that the README starts, from the README's folder: the URL of the page it names.

    On another port, because the README's may be taken.
    """
    text = readme.read_text()
    (command,) = (block for block in blocks(text) if "http.server" in block)
    page = re.search(r"http://127\.0\.0\.1:8000/\S*?/(?=`)", text)
    assert page is not None
    port = _free_port()
    words = [word.replace("8000", str(port)) for word in shlex.split(command)]
    with subprocess.Popen(
        words,
        cwd=readme.parent,
        env=_environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as server:
        try:
            _wait_until_open(port)
            yield page[0].replace("8000", str(port))
        finally:
            server.terminate()


def _wait_until_open(port: int) -> None:
    end_s = time.monotonic() + 20.0
    while True:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        if time.monotonic() > end_s:
            raise RuntimeError(f"the README's server does not answer at port {port}")
        time.sleep(0.05)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _environment() -> dict[str, str]:
    """Ours, with `python3` being the Python that runs this."""
    own = str(Path(sys.base_prefix) / "bin")
    return os.environ | {"PATH": f"{own}{os.pathsep}{os.environ['PATH']}"}
