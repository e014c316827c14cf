"""`make systems-table`: every system in one run, in turns, with what each is worth.

    python -m bench.systems.run [--write] [--only NAME ...] [--seconds 120] [--targets 1,32]

The paper's seven systems and our own, as `eqrt export` writes them, the shipped model, and the
naive export of some (`bench.systems.exports`), beside physics: measured as `eqrt bench --compare`
does it. `--write` puts the tables into docs/benchmarks.md and docs/systems.md, and the plot beside
them. Exporting takes minutes for each of the paper's systems, once: files are kept in `--models`
until what they are made by changes.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from bench.systems.accuracy import Errors, read_errors
from bench.systems.chosen import all_systems, config_name, folder_name
from bench.systems.origin import is_made_by, origin_of
from bench.systems.pages import PLOT, naive_table, plot, write_tables
from eqrt.runtime.bench.environment import allowed_cores
from eqrt.runtime.bench.json_form import to_json
from eqrt.runtime.bench.options import COMPARISON
from eqrt.runtime.bench.report import BACK_TO_BACK, Settings
from eqrt.runtime.bench.side_by_side.bench import bench_side_by_side
from eqrt.runtime.bench.side_by_side.report import SideBySide
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from source_tree import ROOT

CONFIGS, MODELS = ROOT / "training" / "configs", ROOT / ".systems"
SECONDS = 120.0
"""A case: over 662 turns with one target each, for a p99; some 30 with 32, for a median."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Export what is missing, measure, print, write."""
    args = _parser().parse_args(arguments)
    targets = tuple(int(count) for count in args.targets.split(","))
    export_all(args.only, CONFIGS, args.models)
    found = compare(args.only, args.models, read_errors(), settings(targets, args.seconds))
    print(f"\n{naive_table(found)}")
    if args.json is not None:
        args.json.write_text(to_json(found), encoding="utf-8")
    if args.write:
        write_tables(found)
        PLOT.write_text(plot(found), encoding="utf-8")
    return 0


def export_all(names: Sequence[str], configs: Path, models: Path) -> None:
    """Those that are not there, or made by other sources: as many at a time as there are cores.

    Each in a process of its own, so that this one never loads torch.
    """
    models.mkdir(parents=True, exist_ok=True)
    cores = len(allowed_cores())
    one_thread = os.environ | {"OMP_NUM_THREADS": "1"}

    def export(name: str) -> None:
        folder, config = models / folder_name(name), configs / f"{config_name(name)}.toml"
        if not is_made_by(origin_of(name, config), folder):
            print(f"exporting {name}", flush=True)
            module = [sys.executable, "-m", "bench.systems.exports"]
            order = [name, str(configs), str(folder)]
            subprocess.run([*module, *order], check=True, env=one_thread)

    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(export, names))


def compare(names: Sequence[str], models: Path, errors: Errors, asked: Settings) -> SideBySide:
    """Measure the shipped model and these."""
    folders = [models / folder_name(name) for name in names]
    configs = [config_name(name) for name in names]
    evals = [
        errors.report(config, Predictor.load(folder).model_id)
        for config, folder in zip(
            [DEFAULT_ARTIFACT.name, *configs], [DEFAULT_ARTIFACT, *folders], strict=True
        )
    ]
    return bench_side_by_side([DEFAULT_ARTIFACT, *folders], evals, asked, _say, stretch=False)


def settings(targets: tuple[int, ...], seconds: float) -> Settings:
    """One thread, one prediction after the other."""
    return Settings(
        benchmark=COMPARISON,
        targets=targets,
        seconds=seconds,
        schedule=BACK_TO_BACK,
        rate_hz=None,
        threads=1,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="all systems side by side")
    parser.add_argument("--write", action="store_true", help="put tables and plot into docs/")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=all_systems(),
        default=all_systems(),
        metavar="NAME",
        help=f"beside the shipped model, some of: {'; '.join(all_systems())} (default: all)",
    )
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, help=f"for each case (default: {SECONDS:g})"
    )
    parser.add_argument("--targets", default="1,32", help="a case each (default: 1,32)")
    parser.add_argument(
        "--models", type=Path, default=MODELS, help=f"folder of the files (default: {MODELS.name})"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report there")
    return parser


def _say(lines: Sequence[str]) -> None:
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
