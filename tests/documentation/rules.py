"""What a test does differently from a reader, each with its reason; the rest is run as it stands.

A command that is not `eqrt` or one of `HARMLESS` and that no rule names fails the test: nobody can
add one that is never tried without saying so here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

HARMLESS = ("cp", "ls", "python3")
"""Programs that are run as they are, in the world's own folder."""


@dataclass(frozen=True, slots=True)
class NotRun:
    """Commands that are only read: programs must be known, files named must be there, and options
    of `eqrt` must be accepted by its parser."""

    page: str
    """Pattern of the page's name."""
    command: str
    """Pattern that the command begins with."""
    reason: str


NOT_RUN = (
    NotRun(r"", r"make ", "make sets up environments; its targets are what CI runs"),
    NotRun(r"", r"pip install ", "would change the environment that runs the tests"),
    NotRun(r"deploy/README", r"sudo ", "needs root; vcan.sh is tried in tests/socketcan"),
    NotRun(r"deploy/README|reliability", r"echo .* \| sudo tee ", "needs root"),
    NotRun(r"deploy/README", r"/opt/eqrt/", "is installed as root; README.md has eqrt doctor"),
    NotRun(r"deploy/README", r"journalctl ", "needs systemd"),
    NotRun(r"deploy/README", r"docker ", "needs docker and a network"),
    NotRun(r"deploy/examples/README", r"", "`make conformance` runs this page, command by command"),
    NotRun(r"benchmarks", r"eqrt bench( --service)?$", "README.md has the same"),
    NotRun(r"benchmarks", r"eqrt bench --json ", "start-budget.md has the same"),
    NotRun(r"benchmarks", r"eqrt bench --compare", "a minute; test_side_by_side.py runs it"),
    NotRun(r"reliability", r"PYTHONPATH=", "load over minutes, and SocketCAN: tests/socketcan"),
    NotRun(r"bridges", r"eqrt bridge ", "runs until it is told to end; see test_live_bridges.py"),
    NotRun(r"", r"eqrt (view|top)$", "run until they are told to end; tests/view runs them"),
    NotRun(
        r"recording",
        r"eqrt (replay|convert|play) ",
        "need what a service has recorded of a drive: test_recording.py, test_bridges.py",
    ),
    NotRun(r"training", r"torchrun ", "tests/training/test_ranks.py runs two processes"),
    NotRun(r"model", r"eqrt simulate acosta", "SUMO's Bologna scenarios are not in the repository"),
    NotRun(r"evaluation", r"eqrt eval .* --scheduler ", "needs a cluster; see test_evaluation.py"),
    NotRun(r"", r"eqrt bench .*--budget ", "minutes: a p99 needs 662 samples; see test_budgets.py"),
    NotRun(
        r"", r"eqrt bench .*--seconds 60", "a minute; the same options are tried in tests/runtime"
    ),
    NotRun(r"", r"eqrt bench --operators", "12 s; tests/runtime/bench/test_operators.py runs it"),
    NotRun(
        r"benchmarks", r"eqrt bench --service .*vcan0", "needs CAN; tests/socketcan/test_bench.py"
    ),
    NotRun(
        r"benchmarks",
        r"eqrt bench --service --(schedule|log)",
        "tests/runtime/bench/test_service.py",
    ),
)


@dataclass(frozen=True, slots=True)
class Change:
    """A command that is run, but not quite as it stands."""

    command: str
    """Pattern somewhere in the command."""
    old: str
    new: str
    reason: str

    def applied(self, text: str) -> str:
        """The text, changed if this is for it."""
        return re.sub(self.old, self.new, text) if re.search(self.command, text) else text


CHANGES = (
    Change(
        r"^eqrt (serve|doctor) ",
        r"(--can (?:\w+=)?)(v?can\d)",
        r"\1docs-\2",
        "a channel of our own, which no other test is on",
    ),
    Change(
        r"^eqrt (serve|doctor) ",
        r"$",
        " --can-interface eqrt_local",
        "there is no CAN in a test's kernel",
    ),
    Change(
        r"^eqrt play ",
        r"--can vcan0",
        "--can docs-play --can-interface eqrt_local --speed 0",
        "no CAN in a test's kernel, and no waiting",
    ),
    Change(r"^eqrt train ", r"( --steps \d+)?$", " --steps 2", "two steps instead of thousands"),
    Change(
        r"^eqrt bench(?! --service)",
        r"$",
        " --seconds 0.3 --targets 1",
        "a third of a second; such a report is INVALID, and says so",
    ),
    Change(
        r"^eqrt bench --service", r"$", " --seconds 1 --objects 1", "a second instead of minutes"
    ),
    Change(r"^eqrt eval .*--jobs 8", r"--jobs 8", "--jobs 2", "two small files need no more"),
    Change(r"^eqrt plot ", r"--worst 12 --sample 12", "--worst 1 --sample 1", "two pictures"),
)


@dataclass(frozen=True, slots=True)
class Likewise:
    """What a page tells its reader to do "likewise" is not repeated but copied."""

    page: str
    before: str
    """Pattern of the command that needs the copies."""
    original: str
    copies: tuple[str, ...]


LIKEWISE = (
    Likewise(
        "docs/results.md",
        r"eqrt compare runs/ablation/small runs/ablation/small-25",
        "runs/ablation/small-25",
        tuple(
            f"runs/ablation/small-{name}"
            for name in ("5", "translated", "translated-25", "translated-5")
        ),
    ),
)

MAY_END_WITH_3 = r"^eqrt bench .*--baseline "
"""It compares times, and the machine that runs tests is busy."""
