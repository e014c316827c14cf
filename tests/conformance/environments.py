"""Throw-away environments for runtimes that eqrt itself does not need, in a git-ignored folder."""

from __future__ import annotations

import glob
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

from source_tree import ROOT

FOLDER = ROOT / ".conformance"
Environment = Mapping[str, str]
_INSTALL = ("install", "-qq", "--disable-pip-version-check", "--no-compile")


class MissingError(Exception):
    """Something that this machine lacks, and how to get it."""


def python_with(name: str, packages: Sequence[str], version: str | None = None) -> Path:
    """The interpreter of an environment `name` with these packages, kept until they change.

    version: such as 3.11; None = the one that runs this.
    """
    folder, stamp = FOLDER / name, FOLDER / name / "packages.txt"
    python = folder / "bin" / "python"
    wanted = "\n".join(packages)
    if not stamp.exists() or stamp.read_text() != wanted:
        shutil.rmtree(folder, ignore_errors=True)
        run([str(find_python(version)), "-m", "venv", "--without-pip", str(folder)])
        run([sys.executable, "-m", "pip", "--python", str(python), *_INSTALL, *packages])
        stamp.write_text(wanted)
    return python


def find_python(version: str | None) -> Path:
    """An interpreter of that version, from this process, PATH or pyenv."""
    if version is None or version == f"{sys.version_info.major}.{sys.version_info.minor}":
        return Path(sys.executable)
    pattern = str(Path.home() / f".pyenv/versions/{version}.*/bin/python")
    for found in (shutil.which(f"python{version}"), *sorted(glob.glob(pattern))):
        if found and subprocess.run([found, "-c", ""], check=False).returncode == 0:
            return Path(found)
    raise MissingError(
        f"no Python {version} on this machine; install python{version} with its venv"
    )


def need(*programs: str) -> None:
    """Raise MissingError if one of the programs is not on this machine."""
    for program in programs:
        if shutil.which(program) is None:
            raise MissingError(f"no {program} on this machine; .ci/run installs what is needed")


def run(command: Sequence[str], cwd: Path | None = None, env: Environment | None = None) -> str:
    """What a command prints. Raises RuntimeError with what it said if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd, env=env)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: status {done.returncode}\n{done.stderr[-2000:]}")
    return done.stdout


def oldest_dependencies() -> list[str]:
    """What eqrt needs at run time, each in the oldest version that pyproject.toml allows."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [_oldest(requirement) for requirement in project["dependencies"]]


def _oldest(requirement: str) -> str:
    match = re.fullmatch(r"([\w.\[\],-]+)>=([\d.]+)", requirement)
    if match is None:
        raise ValueError(f"pyproject.toml: {requirement!r} has no oldest version")
    return f"{match[1]}=={match[2]}"
