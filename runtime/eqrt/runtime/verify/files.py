"""The folder: every file as SHA256SUMS lists it, none besides, nothing of the exporting machine."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path, PurePosixPath

from eqrt.core.files import read_at_most
from eqrt.runtime.prediction.artifact_limits import MAX_MODEL_BYTES, MAX_TEXT_BYTES
from eqrt.runtime.verify.check import Check, check_of

REQUIRED = ("model.onnx", "contract.json")
"""Beside SHA256SUMS and the test vectors; a README.md (model card) is good manners."""
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")  # as `sha256sum` writes it
_HOST_PATH = re.compile(rb"(?<![\w.-])/(?:home|root|Users)/[\w.]|\b[A-Za-z]:\\+Users\\")


def check_files(folder: Path) -> Check:
    """Whether the folder holds what SHA256SUMS lists, with these sums, and nothing else."""
    try:
        text = read_at_most(MAX_TEXT_BYTES, folder / "SHA256SUMS").decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text"
        return check_of(
            "files", [f"{folder / 'SHA256SUMS'}: {reason}"], "none listed", "all as listed"
        )
    listed, failures = _listed(text)
    for name, digest in listed:
        failures += _compare(folder, name, digest)
    names = {name for name, _ in listed}
    failures += [
        f"{folder / name}: required, but not listed" for name in REQUIRED if name not in names
    ]
    present = {
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()
    }
    extra = sorted(present - names - {"SHA256SUMS"})
    failures += [f"{folder / name}: there, but not listed in SHA256SUMS" for name in extra]
    figure = f"{len(listed)} listed, {len(extra)} others"
    return check_of("files", failures, figure, "all as listed, 0 others")


def check_host_paths(folder: Path) -> Check:
    """Whether no file tells of the machine that it was made on."""
    failures = []
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        try:
            found = _HOST_PATH.search(read_at_most(MAX_MODEL_BYTES, path))
        except OSError as error:
            failures.append(f"{path}: {error.strerror}")
            continue
        if found:
            failures.append(f"{path}: holds the path of a machine, {found[0].decode()}...")
    return check_of("host paths", failures, f"{len(failures)} files with one", "0")


def _listed(text: str) -> tuple[list[tuple[str, str]], list[str]]:
    """(name, digest) of every line, and what is wrong with the others."""
    listed, failures = [], []
    if not text.endswith("\n"):
        failures.append("SHA256SUMS: does not end with a newline; it is cut short")
    for number, line in enumerate(text.removesuffix("\n").split("\n"), 1):
        match = _LINE.fullmatch(line)
        if match is None:
            failures.append(f"SHA256SUMS, line {number}: {line[:80]!r} is not a sum and a name")
        else:
            listed.append((match[2], match[1]))
    return listed, failures


def _compare(folder: Path, name: str, digest: str) -> list[str]:
    path = folder / name
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        return [f"SHA256SUMS: {name!r} lies outside the folder"]
    try:
        found = hashlib.sha256(read_at_most(MAX_MODEL_BYTES, path)).hexdigest()
    except (OSError, ValueError) as error:  # ValueError: a name with a null byte
        return [f"{str(path)!r}: {getattr(error, 'strerror', None) or error}, but listed"]
    if found == digest:
        return []
    return [f"{path}: its SHA-256 is {found[:12]}..., SHA256SUMS says {digest[:12]}..."]
