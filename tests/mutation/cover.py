"""`make coverage`: the tests of the modules in modules.toml reach every line and branch of them."""

from __future__ import annotations

import subprocess
import sys

from mutation.run import modules
from source_tree import ROOT

_COVERAGE = [sys.executable, "-m", "coverage"]


def main() -> int:
    """Run the tests, print the table; not 0 if a line or branch is left out."""
    chosen = modules()
    tests = sorted({f"tests/{test}" for several in chosen.values() for test in several})
    include = ",".join(f"runtime/eqrt/{module}" for module in chosen)
    ran = subprocess.run(
        [*_COVERAGE, "run", "--branch", f"--include={include}", "-m", "pytest", "-q", *tests],
        cwd=ROOT,
        check=False,
    )
    reported = subprocess.run(
        [*_COVERAGE, "report", "--show-missing", "--fail-under=100"], cwd=ROOT, check=False
    )
    return ran.returncode or reported.returncode


if __name__ == "__main__":
    sys.exit(main())
