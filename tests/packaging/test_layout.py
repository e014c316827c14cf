"""Who may import whom, and that the checks of it would notice."""

from __future__ import annotations

import ast
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from source_tree import ROOT, SOURCE_ROOTS, WORKSTATION_PACKAGES, modules_of_the_car

FORBIDDEN = [  # a file, and what must not be imported in it
    ("runtime/eqrt/core/frames.py", "torch"),
    ("runtime/eqrt/core/frames.py", "can"),
    ("runtime/eqrt/core/frames.py", "eqrt.runtime"),
    ("runtime/eqrt/runtime/decoding/detections.py", "eqrt.training"),
    ("runtime/eqrt/cli.py", "onnx"),
    ("runtime/eqrt/runtime/serve.py", "rich"),
    ("runtime/eqrt/runtime/serve.py", "eqrt.runtime.view"),
    ("training/eqrt/training/__init__.py", "eqrt.runtime"),
    ("export/eqrt/export/__init__.py", "eqrt.cli"),
]


@pytest.fixture(scope="session")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources to plant errors in."""
    copy = tmp_path_factory.mktemp("checkout")
    shutil.copy(ROOT / "pyproject.toml", copy)
    for root in SOURCE_ROOTS:
        shutil.copytree(ROOT / root, copy / root, ignore=_all_but_python)
    return copy


def _all_but_python(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if Path(folder, name).is_file() and not name.endswith(".py")]


def run_tool(code: str, checkout: Path) -> subprocess.CompletedProcess[str]:
    """Run a checker on the copy; without `site`, which would put the real sources on the path."""
    path = [*(str(checkout / root) for root in SOURCE_ROOTS), sysconfig.get_path("purelib")]
    return subprocess.run(
        [sys.executable, "-S", "-c", code],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path), "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(("file", "module"), FORBIDDEN)
def test_a_forbidden_import_breaks_a_contract(checkout: Path, file: str, module: str) -> None:
    path = checkout / file
    clean = path.read_text()
    path.write_text(f"{clean}\nimport {module}\n")
    done = run_tool("import importlinter.cli; importlinter.cli.lint_imports_command()", checkout)
    path.write_text(clean)
    assert done.returncode == 1
    assert f"is not allowed to import {module}:" in done.stdout


def test_types_are_checked_in_every_source_root_and_in_the_tests(tmp_path: Path) -> None:
    """A namespace package makes it easy to check one portion only and to hear that all is well."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    planted = [tmp_path / root / "eqrt" / root / "planted.py" for root in SOURCE_ROOTS]
    planted += [tmp_path / "runtime/eqrt/core/planted.py", tmp_path / "tests/core/test_planted.py"]
    planted.append(tmp_path / "deploy/examples/python/planted.py")
    for path in planted:
        path.parent.mkdir(parents=True)
        path.write_text('steps: int = "three"\n')
    said = run_tool("import mypy.__main__ as m; m.console_entry()", tmp_path).stdout
    for path in planted:
        assert f"{path.relative_to(tmp_path)}:1: error: Incompatible types" in said


def imported_names(folder: Path, without: Path | None = None) -> Iterator[str]:
    """The first word of every absolute import in a folder, wherever in a file it stands."""
    for path in folder.rglob("*.py"):
        if without is not None and path.is_relative_to(without):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                yield (node.module or "").partition(".")[0]


def test_core_needs_numpy_and_the_standard_library_only() -> None:
    third_party = set(imported_names(ROOT / "runtime/eqrt/core")) - sys.stdlib_module_names
    assert third_party == {"eqrt", "numpy"}


def required() -> set[str]:
    """The distributions that the wheel depends on without any extra."""
    lines = importlib.metadata.requires("eqrt") or []
    return {re.split(r"[\[<>=!~; ]", line)[0] for line in lines if "extra ==" not in line}


def distributions(names: set[str]) -> set[str]:
    """What brings these modules; the standard library and eqrt itself left out."""
    providers = importlib.metadata.packages_distributions()
    return {dist for name in names - sys.stdlib_module_names - {"eqrt"} for dist in providers[name]}


def test_the_car_imports_what_the_wheel_depends_on_and_nothing_else() -> None:
    imported = set(imported_names(ROOT / "runtime", without=ROOT / "runtime/eqrt/runtime/view"))
    assert distributions(imported) == required()


def test_the_viewer_imports_what_its_extra_brings_besides() -> None:
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    brought = {re.split(r"[<>=]", line)[0] for line in extra["optional-dependencies"]["view"]}
    imported = distributions(set(imported_names(ROOT / "runtime/eqrt/runtime/view")))
    assert imported - required() == brought


def test_eqrt_is_a_namespace_that_no_source_root_owns() -> None:
    assert [root for root in SOURCE_ROOTS if (ROOT / root / "eqrt" / "__init__.py").exists()] == []


def test_importing_the_runtime_loads_nothing_of_the_workstation() -> None:
    """Even here, where torch and onnx are installed."""
    names = modules_of_the_car()
    code = (
        f"import importlib, sys\nfor name in {names}: importlib.import_module(name)\n"
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert WORKSTATION_PACKAGES & set(done.stdout.split()) == set()
