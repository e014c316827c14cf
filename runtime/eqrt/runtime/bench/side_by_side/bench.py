"""Measures several models side by side: in every turn each of them predicts, then physics does.

Who begins changes from turn to turn, so that nobody always meets the caches of the same other.
"""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bench.cold_start import measure_cold_start
from eqrt.runtime.bench.environment import read_environment
from eqrt.runtime.bench.measure import warm_up
from eqrt.runtime.bench.model import Say, identity, load_noticed, measure_case
from eqrt.runtime.bench.percentiles import samples_needed
from eqrt.runtime.bench.predictors import PHYSICS, ModelWorkload, TimedPredictor, physics
from eqrt.runtime.bench.report import Case, Settings
from eqrt.runtime.bench.scenes import ScenePool, record_scenes
from eqrt.runtime.bench.side_by_side.accuracy import Accuracy, EvalReport, from_card, match
from eqrt.runtime.bench.side_by_side.report import SCHEMA, ComparedModel, SideBySide, markdown
from eqrt.runtime.bench.table import case_lines, duty, machine
from eqrt.runtime.bench.verdict import WANTED
from eqrt.runtime.bench.workload import Workload
from eqrt.runtime.signals import until_told_to_stop
from eqrt.runtime.verify.info import describe


def bench_side_by_side(
    folders: Sequence[Path],
    evals: Sequence[EvalReport],
    settings: Settings,
    say: Say,
    *,
    stretch: bool,
) -> SideBySide:
    """Measure every case; `stretch`: for as long as the percentile that is wanted takes.

    Raises EqrtError if an artifact cannot be used, two are the same, a report of an evaluation is
    of another model, or not a single case was measured.
    """
    environment = read_environment()
    say([duty(settings), *machine(environment)])
    predictors = [load_noticed(folder, settings.threads) for folder in folders]
    names = _names(folders, predictors)
    ids = {name: loaded.model_id for name, loaded in zip(names, predictors, strict=True)}
    known = match(evals, ids)
    pools = _pools(folders, predictors)
    models = [
        _compared(folder, name, loaded, known.get(name), settings.threads)
        for folder, name, loaded in zip(folders, names, predictors, strict=True)
    ]
    cases: list[Case] = []
    with until_told_to_stop() as should_stop:
        for targets in settings.targets:
            loads = _loads(names, predictors, pools, targets)
            asked = _stretched(settings, loads) if stretch else settings
            case = measure_case(targets, loads, asked, environment, should_stop, rotating=True)
            if case is None:
                break
            cases.append(case)
            say(case_lines(case))
    if not cases:
        raise EqrtError("stopped before anything was measured")
    report = SideBySide(
        schema=SCHEMA,
        measured_at=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        settings=settings,
        environment=environment,
        models=tuple(models),
        physics=_physics(folders[0], names[0], evals),
        cases=tuple(cases),
    )
    say(["", *markdown(report).splitlines()])
    return report


def _names(folders: Sequence[Path], predictors: Sequence[TimedPredictor]) -> list[str]:
    """Of the contracts; with their folders where two are called alike. Raises UsageError."""
    plain = [predictor.contract.name for predictor in predictors]
    count = Counter([*plain, *PHYSICS])
    names = [
        name if count[name] == 1 else f"{name} ({folder.resolve().name})"
        for name, folder in zip(plain, folders, strict=True)
    ]
    twice = [name for name, times in Counter(names).items() if times > 1]
    same = [one for one, times in Counter(p.model_id for p in predictors).items() if times > 1]
    if twice or same:
        raise UsageError(
            f"--compare: {(twice or same)[0]} is given twice; compare different models, in folders "
            "of different names"
        )
    return names


def _compared(
    folder: Path, name: str, loaded: TimedPredictor, known: EvalReport | None, threads: int
) -> ComparedModel:
    facts = describe(folder)
    return ComparedModel(
        name=name,
        folder=str(folder),
        identity=identity(loaded),
        file_bytes=facts["file_bytes"],
        parameters=facts["parameters"],
        nodes=facts["nodes"],
        cold_start=measure_cold_start(folder, threads),
        accuracy=from_card(facts["metrics"], name) if known is None else known.model,
    )


def _pools(folders: Sequence[Path], predictors: Sequence[TimedPredictor]) -> list[ScenePool]:
    """Of each model; those that are given the same inputs share one."""
    inputs = [
        replace(
            predictor.contract,
            name="",
            version="",
            num_modes=1,
            horizon_steps=1,
            covariances=False,
        )
        for predictor in predictors
    ]
    recorded: dict[ModelContract, ScenePool] = {}
    for folder, asked in zip(folders, inputs, strict=True):
        if asked not in recorded:
            recorded[asked] = record_scenes(folder)
    return [recorded[asked] for asked in inputs]


def _loads(
    names: Sequence[str],
    predictors: Sequence[TimedPredictor],
    pools: Sequence[ScenePool],
    targets: int,
) -> list[Workload]:
    """Physics predicts what the first model does."""
    models = [
        ModelWorkload(predictor, pool, targets, name)
        for name, predictor, pool in zip(names, predictors, pools, strict=True)
    ]
    return [*models, *physics(predictors[0].contract, pools[0], targets)]


def _stretched(settings: Settings, loads: Sequence[Workload]) -> Settings:
    needed_s = 1.1 * samples_needed(WANTED) * warm_up(loads)
    return replace(settings, seconds=max(settings.seconds, float(round(needed_s))))


def _physics(first: Path, name: str, evals: Sequence[EvalReport]) -> dict[str, Accuracy]:
    """From the first report; without any, constant velocity from the first model's card."""
    if evals:
        return dict(evals[0].physics)
    course = from_card(describe(first)["metrics"], name, column=2)
    return {} if course is None else {"constant velocity": course}
