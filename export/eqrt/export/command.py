"""`eqrt export`: turn a checkpoint into an artifact."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from eqrt.export.artifact import write_artifact
from eqrt.training.checkpoint import load_checkpoint


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt export`."""
    parser.add_argument("checkpoint", type=Path, help="model.safetensors of `eqrt train`")
    parser.add_argument("--out", type=Path, required=True, help="folder of the artifact")
    parser.add_argument(
        "--model-version", type=_version, default="1.0.0", help="one word, default 1.0.0"
    )
    parser.add_argument(
        "--changes", metavar="TEXT", help="what this version changes, for its CHANGELOG.md"
    )


def run(args: argparse.Namespace) -> int:
    """Export, verify, and say what was written."""
    checkpoint = load_checkpoint(args.checkpoint)
    model, card = checkpoint.network, checkpoint.card
    contract = checkpoint.config.contract(card.name, args.model_version)
    error = write_artifact(model, contract, card, args.out, args.changes)
    size = (args.out / "model.onnx").stat().st_size
    print(f"artifact       {args.out}")
    print(f"model          {contract.name} {contract.version}, {card.parameters} parameters")
    print(f"model.onnx     {size / 1e6:.2f} MB")
    print(f"verified       PyTorch and the file agree within {1e3 * error:.3f} mm on every vector")
    limits = ", non-commercial" if card.non_commercial else ""
    print(f"licence        {card.license}{limits}")
    return 0


def _version(text: str) -> str:
    """A word, as the titles in CHANGELOG.md are; argparse turns the error into a usage message."""
    if not re.fullmatch(r"\S+", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not one word, such as 1.1.0")
    return text
