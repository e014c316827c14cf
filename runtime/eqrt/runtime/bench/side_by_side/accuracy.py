"""How far off models are: from reports of `eqrt eval`, or from the models' own cards."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.predictors import PHYSICS

_EVAL_SCHEMA = 1
_BEST_OF = 6  # modes that the field compares at


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Mean errors of one predictor on one set of targets, metres."""

    source: str
    """Where it stands: a report, or the model's card."""
    horizon_s: float
    ade_m: float
    """Of the most probable trajectory."""
    fde_m: float
    min_ade_m: float | None
    """Of the best of the 6 most probable ones (or all, of fewer); None where it is not said."""
    min_fde_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class EvalReport:
    """What `eqrt eval --json` said."""

    path: Path
    model_id: str
    model: Accuracy
    physics: Mapping[str, Accuracy]
    """Of those that were evaluated beside it."""


def read_eval(path: Path) -> EvalReport:
    """Read a report. Raises EqrtError if it cannot be read or is none."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["schema"] != _EVAL_SCHEMA:
            raise EqrtError(
                f"{path}: schema {values['schema']} of eqrt eval is not supported (this eqrt reads "
                f"{_EVAL_SCHEMA}); evaluate again"
            )
        model = values["model"]
        horizon_s = round(float(model["horizon_steps"]) * float(model["dt_s"]), 6)
        errors = values["groups"][0]["errors"]
        said = ", ".join(Path(one["path"]).name for one in values["data"])
        source = f"{path.name}: {values['targets']:,} targets of {said}"
        physics = {
            name: _errors(errors[name], horizon_s, source) for name in PHYSICS & errors.keys()
        }
        return EvalReport(
            path=path,
            model_id=str(model["model_id"]),
            model=_errors(errors["model"], horizon_s, source),
            physics=physics,
        )
    except OSError as error:
        raise EqrtError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise EqrtError(
            f"{path}: not a report of an evaluation ({type(error).__name__}: {error}); give a file "
            "of eqrt eval --json"
        ) from error


def match(reports: Sequence[EvalReport], model_ids: Mapping[str, str]) -> dict[str, EvalReport]:
    """Model's name -> its report. `model_ids`: name -> first digits of the file's SHA-256.

    Raises EqrtError for a report of another model, and for two of the same.
    """
    names = {model_id: name for name, model_id in model_ids.items()}
    found: dict[str, EvalReport] = {}
    for report in reports:
        name = names.get(report.model_id)
        if name is None:
            known = ", ".join(f"{model_id} ({name})" for name, model_id in model_ids.items())
            raise EqrtError(
                f"{report.path}: evaluates the model {report.model_id}, which is not compared; "
                f"compared are {known}"
            )
        if name in found:
            raise EqrtError(f"{report.path} and {found[name].path} both evaluate {name}; give one")
        found[name] = report
    return found


def from_card(metrics: Sequence[Sequence[str]], name: str, column: int = 1) -> Accuracy | None:
    """From the table of a model card; None without one. Column 2 is constant velocity's."""
    values: dict[str, float] = {}
    for row in metrics[1:]:
        if len(row) > column and re.fullmatch(r"\d+(\.\d+)?", row[column]):
            values[row[0]] = float(row[column])
    horizons = [float(found[1]) for name in values if (found := re.fullmatch(r"ADE (\S+) s", name))]
    if not horizons:
        return None
    end = f"{max(horizons):g} s"
    if f"FDE {end}" not in values:
        return None
    best = column == 1
    return Accuracy(
        source=f"the model card of {name}",
        horizon_s=max(horizons),
        ade_m=values[f"ADE {end}"],
        fde_m=values[f"FDE {end}"],
        min_ade_m=values.get("minADE") if best else None,
        min_fde_m=values.get("minFDE") if best else None,
    )


def _errors(table: Mapping[str, Any], horizon_s: float, source: str) -> Accuracy:
    counts = [int(name.rpartition("_")[2]) for name in table if name.startswith("min_fde_")]
    modes = _BEST_OF if _BEST_OF in counts else max(counts, default=0)
    return Accuracy(
        source=source,
        horizon_s=horizon_s,
        ade_m=float(table[f"ade_{horizon_s:g}s"]),
        fde_m=float(table[f"fde_{horizon_s:g}s"]),
        min_ade_m=float(table[f"min_ade_{modes}"]) if modes else None,
        min_fde_m=float(table[f"min_fde_{modes}"]) if modes else None,
    )
