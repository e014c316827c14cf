"""Is this artifact what the contract promises? A table, and a verdict.

Needs what the car has: numpy and onnxruntime. Random choices follow from the seed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from eqrt.core.errors import ContractError, EqrtError, UsageError
from eqrt.core.files import write_whole
from eqrt.runtime.prediction.model_file import read_model_file
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.prediction.stored_vectors import StoredVector, read_vector, vector_folders
from eqrt.runtime.verify.behaviour import CHECKS, Trial
from eqrt.runtime.verify.check import Check, Result, check_of, not_run, passed
from eqrt.runtime.verify.files import check_files, check_host_paths
from eqrt.runtime.verify.form import check_contract, check_format, read_contract
from eqrt.runtime.verify.scenes import drawn_scenes, stored_scenes

SHOWN = 5
"""Failures of one check that are printed; `--json` has all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """What was found out about an artifact."""

    artifact: str
    name: str
    """Name and version, as far as the contract could be read."""
    model_id: str
    """Empty if it could not be loaded."""
    seed: int
    checks: tuple[Check, ...]

    @property
    def verified(self) -> bool:
        """Whether every check passed."""
        return passed(self.checks)

    def to_json(self) -> str:
        """Everything, and the verdict."""
        return json.dumps({"verified": self.verified, **asdict(self)}, indent=2)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`eqrt verify [DIR]`."""
    parser.add_argument(
        "artifact",
        nargs="?",
        type=Path,
        default=DEFAULT_ARTIFACT,
        metavar="DIR",
        help="an artifact's folder (default: the model that comes with eqrt)",
    )
    parser.add_argument("--seed", type=int, default=1, help="of the random scenes (default: 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the findings there, too")


def run(args: argparse.Namespace) -> int:
    """Print the findings; 0 if everything is as promised, else 1."""
    if args.seed < 0:
        raise UsageError(f"--seed is {args.seed}; give 0 or more")
    if not args.artifact.is_dir():
        raise ContractError(f"{args.artifact}: no such folder; an artifact is one")
    report = verify(args.artifact, args.seed)
    print(render(report))
    if args.json is not None:
        try:
            write_whole(args.json, f"{report.to_json()}\n".encode())
        except OSError as error:
            raise EqrtError(f"{args.json}: cannot be written ({error.strerror})") from error
    return 0 if report.verified else 1


def verify(folder: Path, seed: int = 1) -> Report:
    """Make all checks on an artifact. What depends on one that was refused is not run."""
    checks = [check_files(folder), check_host_paths(folder)]
    name = model_id = ""
    try:
        model = read_model_file(folder / "model.onnx")
        checks.append(check_format(model, folder / "model.onnx"))
        contract = read_contract(model, folder)
        name = f"{contract.name} {contract.version}"
        checks.append(check_contract(model, contract, folder))
        if not model.external:  # whose paths could lead anywhere
            predictor = Predictor.load(folder)
            model_id = predictor.model_id
            checks.append(check_of("loads", [], f"model {model_id}, {_engine()}", "it does"))
            checks += _tried(predictor, folder, seed)
    except ContractError as error:
        checks.append(check_of(_TABLE[len(checks)], [str(error)], "refused", ""))
    checks += [not_run(name, "because of the failures above") for name in _TABLE[len(checks) :]]
    return Report(
        artifact=str(folder), name=name, model_id=model_id, seed=seed, checks=tuple(checks)
    )


def render(report: Report) -> str:
    """The table, one line for every failure, and the verdict."""
    rows = [("check", "result", "found", "allowed")]
    rows += [(check.name, check.result, check.figure, check.limit) for check in report.checks]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [f"{report.name or 'no name'}: {report.artifact}", ""]
    lines += [
        "  ".join([*map(str.ljust, row[:3], widths), row[3]]).rstrip()  # the last needs no width
        for row in rows
    ]
    lines.append("")
    for check in report.checks:
        lines += [f"{check.name}: {failure}" for failure in check.failures[:SHOWN]]
        if len(check.failures) > SHOWN:
            lines.append(f"{check.name}: and {len(check.failures) - SHOWN} more (--json has all)")
    lines.append(_verdict(report))
    return "\n".join(lines)


_TABLE = ("files", "host paths", "format", "contract", "loads", *CHECKS)


def _verdict(report: Report) -> str:
    results = [check.result for check in report.checks]
    if report.verified:
        return f"verified: all {len(results)} checks passed (seed {report.seed})"
    failed, left = results.count(Result.FAILED), results.count(Result.NOT_RUN)
    more = f", {left} not run" if left else ""
    return f"NOT VERIFIED: {failed} of {len(results)} checks failed{more} (seed {report.seed})"


def _tried(predictor: Predictor, folder: Path, seed: int) -> list[Check]:
    """What it predicts. A check that onnxruntime stops has failed; the others go on."""
    rng = np.random.default_rng(seed)
    vectors: list[StoredVector] = []
    unreadable: list[str] = []
    for vector in vector_folders(folder):
        try:
            vectors.append(read_vector(vector, predictor.contract))
        except ContractError as error:
            unreadable.append(str(error))
    stored = stored_scenes(vectors)
    trial = Trial(
        predictor=predictor,
        twin=Predictor.load(folder, threads=2),
        vectors=vectors,
        unreadable=tuple(unreadable),
        scenes=stored | drawn_scenes(stored, rng),
        rng=rng,
    )
    return [_made(name, check, trial) for name, check in CHECKS.items()]


def _made(name: str, check: Callable[[Trial], Check], trial: Trial) -> Check:
    try:
        return check(trial)
    except ContractError as error:
        return check_of(name, [str(error)], "refused", "")


def _engine() -> str:
    """Known to have been imported by the Predictor, the only module that knows it."""
    return f"onnxruntime {getattr(sys.modules.get('onnxruntime'), '__version__', '')}"
