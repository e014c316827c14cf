"""What ships to the car: the wheel's files, and that they work without the workstation's packages.

The wheel is built from the sdist, as pip and distributors do, and installed into one fresh
environment whose other packages pip resolves.
"""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from source_tree import ROOT, SOURCE_ROOTS, WORKSTATION_PACKAGES, modules_of_the_car


@dataclass(frozen=True)
class Installed:
    """An environment with the wheel and what pip brought along, and nothing else."""

    environment: Path
    folder: Path
    """Where commands are run: outside the checkout, whose sources must not be found."""

    def run(self, command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command of the environment with no other variables than a home."""
        return subprocess.run(
            [str(self.environment / "bin" / command), *arguments],
            cwd=self.folder,
            env={"HOME": str(self.folder)},
            capture_output=True,
            text=True,
            check=False,
        )

    def python(self, code: str) -> object:
        """The value, as JSON, that this code prints."""
        done = self.run("python", "-c", code)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    assert len(list(folder.glob("eqrt-*.tar.gz"))) == 1
    return next(folder.glob("eqrt-*.whl"))


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    folder = tmp_path_factory.mktemp("installed")
    environment = folder / "environment"
    venv.create(environment)
    pip = [sys.executable, "-m", "pip", "--python", str(environment), "install", "--quiet"]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True)
    return Installed(environment, folder)


def contents(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_the_wheel_holds_the_package_and_its_metadata_only(wheel: Path) -> None:
    version = importlib.metadata.version("eqrt")
    folders = {name.partition("/")[0] for name in contents(wheel)}
    assert folders == {"eqrt", f"eqrt-{version}.dist-info"}


def test_the_wheel_holds_every_source_and_data_file(wheel: Path) -> None:
    """Profiles, DBCs, models and tiles too: what the checkout has, the car has."""
    expected = {
        path.relative_to(ROOT / root).as_posix()
        for root in SOURCE_ROOTS
        for path in (ROOT / root / "eqrt").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {name for name in contents(wheel) if name.startswith("eqrt/")} == expected


def test_the_wheel_carries_the_licence_and_the_credits(wheel: Path) -> None:
    licences = {Path(name).name for name in contents(wheel) if "/licenses/" in name}
    assert licences == {"LICENSE", "NOTICE"}


def test_every_package_tells_type_checkers_that_it_is_typed(wheel: Path) -> None:
    packages = ("core", "runtime", "training", "export")
    assert {f"eqrt/{package}/py.typed" for package in packages} <= contents(wheel)


def test_the_car_gets_none_of_the_workstations_packages(installed: Installed) -> None:
    names = installed.python(
        "import json, pkgutil; print(json.dumps([m.name for m in pkgutil.iter_modules()]))"
    )
    assert isinstance(names, list)
    assert "onnxruntime" in names
    assert WORKSTATION_PACKAGES & set(names) == set()


def test_every_module_of_the_car_imports_from_the_wheel(installed: Installed) -> None:
    names = modules_of_the_car()
    files = installed.python(
        "import importlib, json\n"
        f"print(json.dumps([importlib.import_module(name).__file__ for name in {names}]))"
    )
    assert isinstance(files, list)
    assert len(files) > 5
    assert all(Path(file).is_relative_to(installed.environment) for file in files)


def test_the_command_tells_its_version_and_help(installed: Installed) -> None:
    version = importlib.metadata.version("eqrt")
    assert installed.run("eqrt", "--version").stdout == f"eqrt {version}\n"
    assert installed.run("eqrt", "--help").returncode == 0


@pytest.mark.parametrize(
    ("command", "extra"), [("train", "train"), ("view", "view"), ("top", "view")]
)
def test_a_command_that_needs_an_extra_names_it(
    installed: Installed, command: str, extra: str
) -> None:
    done = installed.run("eqrt", command)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"pip install 'eqrt[{extra}]'" in done.stderr


def test_the_installed_command_plays_its_demo(installed: Installed, tmp_path: Path) -> None:
    """Model, tile, profiles, DBCs and recordings are in the wheel, and work from there."""
    done = installed.run("eqrt", "demo", "--part", "rav4", "--seconds", "2", "--out", str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    assert "NO_MAP" in done.stdout
