"""`make conformance`: every shipped artifact in every runtime that we say it runs in, for real.

The commands of deploy/examples/README.md are run first: they build the examples, and the examples
check the artifacts. Then the support table in docs/conformance.md must be what was found.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from conformance import table
from conformance.artifacts import DAMAGES, damaged, other_sizes, shipped, swapped
from conformance.environments import FOLDER, MissingError, need
from conformance.readme import README, run_all
from conformance.runtimes import Outcome, Runtime, all_runtimes, verify_with_the_oldest

T = TypeVar("T")

SAME_M = 0.02
"""What examples print of the same scene differs by rounding only."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run everything; 0 if all is as it should be."""
    parser = argparse.ArgumentParser(prog="make conformance", description=__doc__)
    parser.add_argument("--write", action="store_true", help="put a table of a good run into docs")
    args = parser.parse_args(argv)
    trial = Trial()
    try:
        found = table.render([_title(artifact) for artifact in trial.artifacts], trial.rows())
    except MissingError as error:
        print(f"make conformance: {error}", file=sys.stderr)
        return 1
    if args.write and trial.failed == 0:
        table.store(found)
    trial.expect("docs/conformance.md", _compare_with_stored, found)
    print(f"{trial.passed} passed, {trial.failed} failed")
    return 0 if trial.failed == 0 else 1


class Trial:
    """What is tried, and what came of it so far."""

    def __init__(self) -> None:
        self.passed = self.failed = 0
        self.artifacts = shipped()
        folder = FOLDER / "artifacts"
        made = other_sizes(folder)
        self._every = [*self.artifacts, made]
        self._swapped = swapped(made, folder)
        self._damaged = [damaged(made, damage, folder) for damage in DAMAGES]
        self._scenes: dict[Path, list[float]] = {}
        """By artifact, the numbers that the first example printed of the recorded scene."""

    def expect(self, name: str, check: Callable[..., T], *arguments: object) -> T | None:
        """Count and print what a check says, or why it failed."""
        started_s = time.monotonic()
        said: T | None = None
        try:
            said = check(*arguments)
            self.passed += 1
            line = f"ok      {name}: {said}"
        except (RuntimeError, ValueError) as error:
            self.failed += 1
            line = f"FAILED  {name}: {error}"
        print(f"{time.monotonic() - started_s:6.1f} s  {line}", flush=True)
        return said

    def rows(self) -> list[table.Row]:
        """Try everything: the README, every runtime, and eqrt with what is oldest."""
        need("cmake", "g++", "node", "npm")
        if self.expect("deploy/examples/README.md", _readme_works) is None:
            return []  # it would have built what the runtimes are tried with
        rows = [self._row(runtime) for runtime in all_runtimes()]
        for artifact in self.artifacts:
            self.expect("eqrt verify, oldest dependencies", _verified, artifact)
        return rows

    def _row(self, runtime: Runtime) -> table.Row:
        name = f"{runtime.name} {runtime.version}"
        found = [self.expect(name, _agreement, runtime, artifact) for artifact in self._every]
        sure = [self.expect(name, _notices, runtime, artifact) for artifact in self._damaged]
        sure.append(self.expect(name, _forgives, runtime, self._swapped))
        if runtime.show is not None:
            for artifact in self._every:
                self.expect(name, self._shows, runtime.show, artifact)
        return table.Row(
            runtime.name,
            runtime.version,
            runtime.how,
            [o.worst_mm if o else math.nan for o in found[: len(self.artifacts)]],
            all(found) and all(sure),
        )

    def _shows(self, show: Callable[[Path], str], artifact: Path) -> str:
        """All examples say the same of the recorded scene; the page says the mean only."""
        printed = show(artifact)
        numbers = [float(number) for number in re.findall(r"-?\d+\.\d+", printed)]
        missed_m = [float(number) for number in re.findall(r"(-?\d+\.\d+) m away", printed)]
        first = self._scenes.setdefault(artifact, [statistics.mean(missed_m), *numbers])
        if abs(statistics.mean(missed_m) - first[0]) > SAME_M:
            raise ValueError(f"targets are missed by {missed_m}, in another runtime by {first[0]}")
        if len(missed_m) > 1 and not np.allclose(numbers, first[1:], rtol=0, atol=SAME_M):
            raise ValueError("the scene's prediction is not what another runtime printed")
        return f"{artifact.name}, recorded scene: {statistics.mean(missed_m):.2f} m away at the end"


def _readme_works() -> str:
    return f"its commands printed {len(run_all(README).splitlines())} lines"


def _agreement(runtime: Runtime, artifact: Path) -> Outcome:
    outcome = runtime.check(artifact)
    if not outcome.good:
        raise ValueError(outcome)
    return outcome


def _notices(runtime: Runtime, artifact: Path) -> str:
    outcome = runtime.check(artifact)
    if outcome.good:
        raise ValueError(f"{artifact.name} is not found: {outcome}")
    return f"{artifact.name}: found"


def _forgives(runtime: Runtime, artifact: Path) -> str:
    outcome = runtime.check(artifact)
    if not outcome.good:
        raise ValueError(f"modes as probable as each other may change places: {outcome}")
    return f"{artifact.name} modes: as good"


def _verified(artifact: Path) -> str:
    line = verify_with_the_oldest(artifact)
    if not line.startswith("verified: "):
        raise ValueError(f"{artifact.name}: {line}")
    return f"{artifact.name} {line}"


def _compare_with_stored(found: str) -> str:
    if table.without_figures(found) != table.without_figures(table.stored()):
        raise ValueError(f"its table is not what was found; make conformance-table\n{found}")
    return "its table is what was found"


def _title(artifact: Path) -> str:
    contract = json.loads((artifact / "contract.json").read_text(encoding="utf-8"))
    return f"{contract['name']} {contract['version']}"


if __name__ == "__main__":
    sys.exit(main())
