"""What an artifact is, on one screen. Runs nothing, so it can be asked of any model file."""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import Any

from eqrt.core.contract import ModelContract
from eqrt.core.files import read_at_most
from eqrt.runtime.prediction.artifact_limits import MAX_MODEL_BYTES, MAX_TEXT_BYTES
from eqrt.runtime.prediction.model_file import ModelFile, read_model_file
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.prediction.stored_vectors import vector_folders
from eqrt.runtime.verify.form import read_contract

Table = list[list[str]]

WIDTH = 100
"""Columns that the text takes at most."""
_MAX_DIGITS = 20  # of a count of parameters on a model card
_INDENT = 10  # columns of what a line is about


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`eqrt info [DIR]`."""
    parser.add_argument(
        "artifact",
        nargs="?",
        type=Path,
        default=DEFAULT_ARTIFACT,
        metavar="DIR",
        help="an artifact's folder (default: the model that comes with eqrt)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Print what the artifact is."""
    facts = describe(args.artifact)
    print(json.dumps(facts, indent=2) if args.json else render(facts))
    return 0


def describe(folder: Path) -> dict[str, Any]:
    """What the artifact says of itself, ready for JSON.

    Raises ContractError if there is no model file in `folder`, or none of this contract.
    """
    path = folder / "model.onnx"
    model = read_model_file(path)
    contract = read_contract(model, folder)
    card = _card(folder)
    digest = hashlib.sha256(read_at_most(MAX_MODEL_BYTES, path)).hexdigest()
    return {
        "artifact": str(folder),
        "model_id": digest[:8],
        "as_listed": _listed(folder) == digest,
        "file_bytes": path.stat().st_size,
        "producer": model.producer,
        "ir_version": model.ir_version,
        "opsets": model.opsets,
        "nodes": model.nodes,
        "parameters": _parameters(card, model),
        "license": model.metadata.get("license", ""),
        "non_commercial": model.metadata.get("non_commercial") == "true",
        "data": model.metadata.get("data", ""),
        "contract": asdict(contract),
        "inputs": model.inputs,
        "outputs": model.outputs,
        "test_vectors": len(vector_folders(folder)),
        "metrics": next((table for table in card if table[0][0] == "metric"), []),
    }


def render(facts: dict[str, Any]) -> str:
    """`describe`'s facts as text."""
    contract = ModelContract(**facts["contract"])
    parameters = f"{facts['parameters']:,} parameters, " if facts["parameters"] else ""
    opset = ", ".join(f"{name} {number}".strip() for name, number in facts["opsets"].items())
    listed = "as" if facts["as_listed"] else "NOT as"
    rows = {
        "model": f"{contract.name} {contract.version} (id {facts['model_id']})",
        "licence": facts["license"] or "not stated",
        "data": facts["data"] or "not stated",
        "size": f"{parameters}{facts['nodes']} nodes, {facts['file_bytes'] / 1e6:.2f} MB",
        "file": f"ONNX opset {opset}, IR {facts['ir_version']}, by {facts['producer'] or '?'}, "
        f"{listed} SHA256SUMS lists it",
        "predicts": f"{contract.horizon_steps * contract.dt_s:g} s in {contract.num_modes} "
        f"{'mode' if contract.num_modes == 1 else 'modes'}, from "
        f"{contract.history_steps * contract.dt_s:g} s",
        "sizes": f"N {contract.num_agents}, T {contract.history_steps}, "
        f"Q {contract.num_centerlines}, L {contract.centerline_points}, "
        f"H {contract.horizon_steps}, K {contract.num_modes}, dt {contract.dt_s:g} s",
        "lanes": f"{contract.lane_choice}",
        "vectors": f"{facts['test_vectors']} test vectors; `eqrt verify` runs them",
    }
    if facts["non_commercial"]:
        rows["licence"] += " -- NON-COMMERCIAL: not for commercial use"
    lines = [line for name, text in rows.items() for line in _wrapped(f"{name:<{_INDENT}}{text}")]
    for side in ("inputs", "outputs"):
        tensors = [[name, *map(_text, spec)] for name, spec in facts[side].items()]
        lines += ["", *_columns([[side, "", ""], *tensors])]
    if facts["metrics"]:
        lines += ["", "what its model card says of held-out recordings, metres"]
        lines += _columns(facts["metrics"])
    return "\n".join(lines)


def _wrapped(line: str) -> list[str]:
    return textwrap.wrap(line, WIDTH, subsequent_indent=" " * _INDENT, break_on_hyphens=False)


def _card(folder: Path) -> list[Table]:
    """The tables of the model card, rows of cells; none without a card."""
    try:
        text = read_at_most(MAX_TEXT_BYTES, folder / "README.md").decode("utf-8", "replace")
    except OSError:
        return []
    tables: list[Table] = []
    before = ""
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("|") and not before.startswith("|"):
            tables.append([])
        if line.startswith("|") and not re.fullmatch(r"[|\s:-]+", line):
            tables[-1].append(cells)
        before = line
    return [table for table in tables if table]


def _parameters(card: list[Table], model: ModelFile) -> int:
    """As the card counts them, else the floating-point numbers in the file."""
    stated = [row[1] for table in card for row in table if row[0] == "parameters" and len(row) > 1]
    digits = stated[0].replace(",", "") if stated else ""
    counted = digits.isascii() and digits.isdigit() and len(digits) < _MAX_DIGITS
    return int(digits) if counted else model.parameters


def _listed(folder: Path) -> str:
    """The model file's sum in SHA256SUMS; empty if there is none."""
    try:
        text = read_at_most(MAX_TEXT_BYTES, folder / "SHA256SUMS").decode("utf-8", "replace")
    except OSError:
        return ""
    return next((line[:64] for line in text.split("\n") if line[66:] == "model.onnx"), "")


def _columns(rows: Table) -> list[str]:
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(max(map(len, rows)))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=False)).rstrip()
        for row in rows
    ]


def _text(part: str | tuple[int | str, ...]) -> str:
    return part if isinstance(part, str) else f"({', '.join(map(str, part))})"
