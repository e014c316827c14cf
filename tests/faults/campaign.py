"""The fault campaign: what happens to eqrt when something goes wrong, as one table.

    python -m faults.campaign [--write]

Faults on messages go through the pipeline on a simulated clock; faults of the machine happen to
`eqrt serve`, `eqrt play` and a consumer as processes. In both, good traffic before and after, and
the promises of `faults.promises` hold all the while. Recovery is from the end of the fault until
every object is predicted by the model again, from a full history.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Iterable, Iterator

from eqrt.runtime.bench.environment import read_environment
from faults.machine import process_faults
from faults.messages import message_faults
from faults.outcome import Outcome, table
from source_tree import ROOT

PAGE = ROOT / "docs" / "reliability.md"
BEGIN, END = "<!-- fault campaign -->", "<!-- end of the fault campaign -->"


def main(arguments: Iterable[str] | None = None) -> int:
    """Run everything, print the table; 1 if a fault was not survived."""
    parser = argparse.ArgumentParser(description="the fault campaign")
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.name}")
    args = parser.parse_args(None if arguments is None else list(arguments))
    outcomes = []
    for outcome in _all():
        outcomes.append(outcome)
        print(outcome.line(), flush=True)
    if args.write:
        _write(table(outcomes))
    return 0 if all(outcome.survived for outcome in outcomes) else 1


def _all() -> Iterator[Outcome]:
    yield from message_faults()
    yield from process_faults()


def _write(text: str) -> None:
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    where = f"{time.strftime('%Y-%m-%d')}, {read_environment().cpu}, Linux {platform.release()}"
    PAGE.write_text(f"{before}{BEGIN}\n{where}:\n\n{text}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
