"""`eqrt` in processes of its own, which start fast: PyTorch is imported once, before they fork."""

from __future__ import annotations

import contextlib
import glob
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from itertools import takewhile
from multiprocessing.process import BaseProcess
from pathlib import Path

from source_tree import ROOT, SOURCE_ROOTS

_WARM = ["eqrt.cli", "eqrt.export.command", "eqrt.export.evaluation.command", "eqrt.training.train"]
_READY = {"serve": "eqrt serve: ", "view": "eqrt view: http", "bridge": "eqrt bridge: from "}
"""Command that runs until it is told to end -> what it says when it is ready."""
PATIENCE_S = 300.0  # for one command, on a machine that does much else
_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(_WARM)


def run(words: Sequence[str], folder: Path) -> tuple[int, str]:
    """Run a command in a folder to its end, or until it serves: exit status, what it printed."""
    expanded = [match for word in words for match in _expanded(word, folder)]
    if words[0] != "eqrt":
        return _run_program(expanded, folder)
    said = folder / "said.txt"
    said.write_text("")
    process = _FORKS.Process(target=_eqrt, args=(expanded[1:], folder, said))
    process.start()
    if words[1] in _READY:
        _stop_when_ready(process, said, _READY[words[1]])
    process.join(PATIENCE_S)
    if process.is_alive():
        process.kill()
        process.join()
        return 137, said.read_text() + f"\nstill running after {PATIENCE_S:.0f} s"
    return process.exitcode or 0, said.read_text()


def _expanded(word: str, folder: Path) -> list[str]:
    """File names for a pattern, as the shell has it."""
    if not glob.has_magic(word):
        return [word]
    return sorted(glob.glob(word, root_dir=folder)) or [word]


def _run_program(words: Sequence[str], folder: Path) -> tuple[int, str]:
    """Settings of the environment may stand before it, as in a shell."""
    settings = dict(word.split("=", 1) for word in takewhile(_is_setting, words))
    words = words[len(settings) :]
    program = sys.executable if words[0].startswith("python") else words[0]
    done = subprocess.run(
        [program, *words[1:]],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT if settings else folder,  # which speak of the checkout
        env=os.environ | settings,
    )
    return done.returncode, done.stdout + done.stderr


def _is_setting(word: str) -> bool:
    return re.match(r"[A-Z]+=", word) is not None


def _eqrt(argv: Sequence[str], folder: Path, said: Path) -> None:
    """The child: what `eqrt` does when a shell starts it."""
    from eqrt import cli

    os.chdir(folder)
    os.environ["PYTHONPATH"] = os.pathsep.join(str(ROOT / root) for root in SOURCE_ROOTS)
    with said.open("w") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    sys.argv = ["eqrt", *argv]
    sys.exit(cli.main())


def _stop_when_ready(process: BaseProcess, said: Path, ready: str) -> None:
    """Ctrl-C as soon as it says that it listens."""
    end_s = time.monotonic() + PATIENCE_S
    while process.is_alive() and time.monotonic() < end_s:
        with contextlib.suppress(OSError):
            if ready in said.read_text():
                assert process.pid is not None
                os.kill(process.pid, signal.SIGINT)
                return
        time.sleep(0.02)
