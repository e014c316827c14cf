"""How far off the systems are: what was measured once, after training, and is kept beside the page.

Files that `make systems-table` exports have random weights, and so no errors of their own.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eqrt.runtime.bench.side_by_side.accuracy import Accuracy, EvalReport
from source_tree import ROOT

ERRORS = ROOT / "docs" / "argoverse1-errors.toml"


@dataclass(frozen=True, slots=True)
class Errors:
    """Of every system and of physics, all on the same targets."""

    models: Mapping[str, Accuracy]
    """By the name of the configuration."""
    physics: Mapping[str, Accuracy]
    rows: Mapping[str, Accuracy]
    """By what begins their rows on docs/results.md."""

    def report(self, config: str, model_id: str) -> EvalReport:
        """As if the file of that id had been evaluated: it is the network that was."""
        return EvalReport(
            path=ERRORS, model_id=model_id, model=self.models[config], physics=self.physics
        )


def read_errors(path: Path = ERRORS) -> Errors:
    """Read the file."""
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    read = {
        group: {name: _accuracy(tables, row) for name, row in tables[group].items()}
        for group in ("models", "physics")
    }
    rows = {row["row"]: read[group][name] for group in read for name, row in tables[group].items()}
    return Errors(read["models"], read["physics"], rows)


def _accuracy(tables: Mapping[str, Any], row: Mapping[str, Any]) -> Accuracy:
    return Accuracy(
        source=tables["targets"],
        horizon_s=tables["horizon_s"],
        ade_m=row["ade_m"],
        fde_m=row["fde_m"],
        min_ade_m=None,
        min_fde_m=None,
    )
