"""What an exported file was made by, so that it is made again only when that has changed."""

from __future__ import annotations

import hashlib
import json
from importlib.metadata import version
from pathlib import Path

from source_tree import ROOT

_SOURCES = (
    "runtime/eqrt/core/contract.py",
    "training/eqrt/training/networks/*.py",
    "export/eqrt/export/to_onnx.py",
    "export/eqrt/export/folded/*.py",
    "tests/bench/systems/naive.py",
)
"""Networks, and what writes them."""


def is_made_by(origin: str, folder: Path) -> bool:
    """Whether the artifact is there, and of this origin."""
    path = _beside(folder)
    return path.exists() and path.read_text(encoding="utf-8") == origin


def note(origin: str, folder: Path) -> None:
    """Keep where the artifact, which is there now, is from."""
    _beside(folder).write_text(origin, encoding="utf-8")


def origin_of(name: str, config: Path) -> str:
    """What a file depends on: its configuration, the networks, the exporter, and their versions."""
    digest = hashlib.sha256(config.read_bytes())
    for path in sorted(path for pattern in _SOURCES for path in ROOT.glob(pattern)):
        digest.update(path.read_bytes())
    versions = {package: version(package) for package in ("torch", "onnxscript")}
    return json.dumps({"name": name, "sources": digest.hexdigest(), **versions})


def _beside(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.made-by")
