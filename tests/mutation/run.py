"""`make mutation`: changes the code in every small way, and shows the changes that no test noticed.

mutmut wants one source folder named `src` and makes its mutants in the folder that it runs in, so
it is given a copy of this project, in .mutation/. Which modules and tests: modules.toml.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import os
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from source_tree import ROOT, SOURCE_ROOTS

FOLDER = ROOT / ".mutation"
_MUTMUT = [sys.executable, "-m", "mutmut"]
_KILLED = {"killed", "timeout", "caught by type check"}
_IGNORED = shutil.ignore_patterns("__pycache__", "models", "bench")
_SETTINGS = """\
[tool.mutmut]
source_paths = ["src"]
only_mutate = {mutated}
also_copy = ["runtime", "deploy", "docs"]
pytest_add_cli_args_test_selection = {tests}
pytest_add_cli_args = ["-p", "no:cacheprovider", "-p", "no:xdist"]

[tool.pytest.ini_options]
pythonpath = ["src", "tests"]
addopts = ["--import-mode=importlib", "--benchmark-disable"]
filterwarnings = ["error"]
"""
_HYPOTHESIS = """
from hypothesis import HealthCheck, settings

# mutmut runs the tests of a class more than once in one process, each time with new objects.
settings.register_profile("mutants", suppress_health_check=[HealthCheck.differing_executors])
settings.load_profile("mutants")
"""


def modules() -> dict[str, list[str]]:
    """Module -> the tests that must notice when it changes."""
    table: dict[str, list[str]] = _settings()["modules"]
    return table


def _settings() -> dict[str, Any]:
    return tomllib.loads((Path(__file__).parent / "modules.toml").read_text())


def main(argv: Sequence[str] | None = None) -> int:
    """Mutate; 0 if every mutant was noticed, or is explained in modules.toml."""
    known = modules()
    parser = argparse.ArgumentParser(prog="make mutation", description=__doc__)
    parser.add_argument("modules", nargs="*", help=f"of {', '.join(known)} (default: all)")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at a time (default: 1)")
    args = parser.parse_args(argv)
    if strange := ", ".join(sorted(set(args.modules) - set(known))):
        parser.error(f"not in tests/mutation/modules.toml: {strange}; it has {', '.join(known)}")
    unexplained = 0
    print("| module | mutants | noticed | explained | unexplained | seconds |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |", flush=True)
    for module in args.modules or known:
        began_s = time.monotonic()
        found = _mutate(module, known[module], args.jobs)
        seconds = time.monotonic() - began_s
        functions = _functions(module)
        alive = {
            name: _difference(functions, name)
            for name, state in sorted(found.items())
            if state not in _KILLED
        }
        open_ones = [name for name in alive if not _is_explained(module, alive[name])]
        counts = (len(found), len(found) - len(alive), len(alive) - len(open_ones), len(open_ones))
        print(f"| {module} | {' | '.join(map(str, counts))} | {seconds:.0f} |", flush=True)
        for name in open_ones:
            print(f"\n{name}: {found[name]}\n{alive[name]}", file=sys.stderr)
        unexplained += len(open_ones)
    return 1 if unexplained else 0


def _is_explained(module: str, difference: str) -> bool:
    """Whether modules.toml says why nobody can notice this change."""
    added = [line[2:].strip() for line in difference.splitlines() if line.startswith("+ ")]
    return any(
        known["module"] == module and added == [known["change"]]
        for known in _settings()["equivalent"]
    )


def _mutate(module: str, tests: Iterable[str], jobs: int) -> dict[str, str]:
    """Mutant -> what became of it."""
    _copy_project(module, [f"tests/{test}" for test in tests])
    done = subprocess.run(
        [*_MUTMUT, "run", "--max-children", str(jobs)],
        cwd=FOLDER,
        env=_environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    lines = [line.split(": ") for line in _said("results", "--all", "true").splitlines()]
    found = {line[0].strip(): line[1].strip() for line in lines if len(line) == 2}
    if not found or "not checked" in found.values():
        raise SystemExit(f"{module}: mutmut failed\n{done.stdout[-3000:]}{done.stderr}")
    return found


def _functions(module: str) -> dict[str, str]:
    """Name -> text; mutmut writes all mutants, and the originals, into one file."""
    lines = (FOLDER / "mutants/src/eqrt" / module).read_text().splitlines()
    return {
        node.name: "\n".join(lines[node.lineno - 1 : node.end_lineno])
        for node in ast.walk(ast.parse("\n".join(lines)))
        if isinstance(node, ast.FunctionDef)
    }


def _difference(functions: Mapping[str, str], mutant: str) -> str:
    """What the mutant changes."""
    name = mutant.rpartition(".")[2]
    original = f"{name.rpartition('_')[0]}_orig"
    before, after = (functions[one].replace(one, "", 1).splitlines() for one in (original, name))
    changed = difflib.ndiff(before, after)
    return "\n".join(line for line in changed if line[:2] in ("- ", "+ "))


def _said(*arguments: str) -> str:
    command = [*_MUTMUT, *arguments]
    return subprocess.run(
        command, cwd=FOLDER, env=_environment(), capture_output=True, text=True, check=False
    ).stdout


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def _copy_project(module: str, tests: list[str]) -> None:
    shutil.rmtree(FOLDER, ignore_errors=True)
    for root in SOURCE_ROOTS:
        shutil.copytree(ROOT / root / "eqrt", FOLDER / "src/eqrt", dirs_exist_ok=True)
    for name in ("tests", "runtime", "deploy", "docs"):
        ignore = shutil.ignore_patterns("__pycache__", "fuzz", "node_modules")
        shutil.copytree(ROOT / name, FOLDER / name, ignore=ignore)
    settings = _SETTINGS.format(mutated=[f"src/eqrt/{module}"], tests=tests)
    with (FOLDER / "tests/conftest.py").open("a") as conftest:
        conftest.write(_HYPOTHESIS)
    (FOLDER / "pyproject.toml").write_text(settings.replace("'", '"'))


if __name__ == "__main__":
    sys.exit(main())
