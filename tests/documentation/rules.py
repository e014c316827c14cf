"""What a test does differently from a reader, each with its reason; the rest is run as it stands.

A command that is not `eqrt` or one of `HARMLESS` and that no rule names fails the test: nobody can
add one that is never tried without saying so here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

HARMLESS = ("cp", "ls", "python", "python3")
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
    NotRun(
        r"", r"make ", "sets up environments; CI makes its targets; here make says how it would"
    ),
    NotRun(r"", r"python3 -m venv .venv ", "makes an environment; tests/packaging installs eqrt"),
    NotRun(r"deploy/README", r"sudo ", "changes the machine; vcan.sh is tried in tests/socketcan"),
    NotRun(r"output", r"sudo ", "changes the machine"),
    NotRun(r"reliability", r"echo .* \| sudo tee ", "changes the machine"),
    NotRun(r"deploy/README", r"journalctl ", "needs a running systemd"),
    NotRun(r"deploy/README", r"docker ", "needs docker and a network"),
    NotRun(r"deploy/examples/README", r"", "`make conformance` runs this page, command by command"),
    NotRun(r"benchmarks", r"eqrt bench .*--budget ", "start-budget.md has the same, and it is run"),
    NotRun(r"reliability", r".* -m socketcan ", "boots a kernel with CAN: tests/socketcan does it"),
    NotRun(r"", r"eqrt top$", "needs a terminal; tests/view/test_top.py gives it one"),
    NotRun(r"training", r"torchrun ", "tests/training/test_ranks.py runs two processes"),
    NotRun(r"model", r"eqrt simulate acosta", "SUMO's Bologna scenarios are not in the repository"),
    NotRun(r"evaluation", r"eqrt eval .* --scheduler ", "needs a cluster; see test_evaluation.py"),
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
        r"^/opt/eqrt/bin/eqrt ",
        r"^/opt/eqrt/bin/eqrt doctor --config /etc/eqrt/",
        "eqrt doctor --can can0 --config deploy/",
        "eqrt is not installed there, nor is its configuration",
    ),
    Change(
        r"^eqrt (serve|doctor|bench) ",
        r"(--can (?:\w+=)?)(v?can\d)",
        r"\1docs-\2",
        "a channel of our own, which no other test is on",
    ),
    Change(
        r"^eqrt (serve|doctor|bench) .*--can ",
        r"$",
        " --can-interface eqrt_local",
        "there is no CAN in a test's kernel",
    ),
    Change(r"^eqrt play ", r"$", " --speed 0", "no waiting"),
    Change(
        r"^eqrt play ",
        r"--can vcan0",
        "--can docs-play --can-interface eqrt_local",
        "there is no CAN in a test's kernel",
    ),
    Change(
        r"^eqrt bridge --to plotjuggler",
        r"$",
        " --datagrams 127.0.0.1:47391",
        "a service that runs here speaks to the usual address",
    ),
    Change(
        r"^eqrt bridge --to zenoh",
        r"--datagrams 127.0.0.1:47311",
        "--datagrams 127.0.0.1:47392 --listen tcp/127.0.0.1:47393",
        "the usual addresses may be taken",
    ),
    Change(
        r"^eqrt view$",
        r"$",
        " --datagrams 127.0.0.1:47394 --port 0",
        "the usual addresses may be taken",
    ),
    Change(
        r"^eqrt train .*eqrt-small",
        r"--data data/ngsim( --data data/bologna)?",
        "--data data/av1",
        "two of NGSIM's recordings leave none to hold out",
    ),
    Change(r"^eqrt train ", r"( --steps \d+)?$", " --steps 2", "two steps instead of thousands"),
    Change(
        r"^eqrt bench(?! --service)(?!.*--budget)",
        r"( --seconds \d+)?$",
        " --seconds 0.3",
        "a third of a second; such a report is INVALID, and says so",
    ),
    Change(
        r"^eqrt bench(?! --service)(?!.* --targets)",
        r"$",
        " --targets 1",
        "one case instead of two or three",
    ),
    Change(r"^eqrt bench .*--budget ", r"$", " --seconds 2", "as many as a median needs"),
    Change(
        r"^eqrt bench --service(?!.*--budget)",
        r"$",
        " --seconds 1",
        "a second instead of minutes",
    ),
    Change(
        r"^eqrt bench --service(?!.*--log)",
        r"( --objects [\d,]+)?$",
        " --objects 1",
        "one case instead of three or four",
    ),
    Change(r"-m load.run", r"--seconds 10", "--seconds 1", "a second instead of ten"),
    Change(r"reader_speed.py speed ", r"100$", "3", "three rounds instead of a hundred"),
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

ENDINGS = (
    (r"^eqrt bench .*--(baseline|budget) ", (0, 3), "the machine that runs tests is busy"),
    (r".* -m load.run ", (0, 1), "as the page says: at such a rate messages are lost"),
    (r"^eqrt doctor ", (0, 1), "a machine need not be fit for a car"),
    (r"^eqrt replay .*--diff-model ", (1,), "another model says something else"),
)
"""Command -> exit statuses that it may have, other than 0 alone, and why."""
