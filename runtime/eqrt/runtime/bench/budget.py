"""A file of limits, and which of them a report breaks (deploy/budgets.toml)."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bench.percentiles import PERCENTILES
from eqrt.runtime.bench.report import (
    BACK_TO_BACK,
    MODEL,
    NOUNS,
    SCHEDULES,
    SERVICE,
    Case,
    Report,
    Settings,
    counted,
)


def _percentile_ms(name: str, case: Case) -> float | None:
    estimate = case.judged.total.percentiles.get(name)
    return None if estimate is None else estimate.value_ns / 1e6


START_LIMITS: Mapping[str, Callable[[Report], float]] = {
    "cold_start_s": lambda report: report.cold_start.total_s,
    "rss_mib": lambda report: report.cold_start.rss_mib,
    "rss_over_bare_mib": lambda report: report.cold_start.rss_mib - report.cold_start.rss_bare_mib,
}
"""Key of the table [start] -> what it limits."""
CASE_LIMITS: Mapping[str, Callable[[Case], float | None]] = {
    **{f"{name}_ms": partial(_percentile_ms, name) for name in PERCENTILES},
    "cpu_ms": lambda case: case.judged.cpu_mean_ns / 1e6,
    "rss_peak_mib": lambda case: case.resources.rss_peak_mib,
    "rss_slope_kib_per_s": lambda case: case.resources.rss_slope_kib_per_s,
    "deadline_misses": lambda case: case.punctuality.misses if case.punctuality else None,
}
"""Key of a table [targets.N] -> what it limits; None = was not measured."""
_KEYS = ("schedule", "rate_hz", "threads", "start", "targets", SERVICE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Limits for one schedule; the most that is allowed."""

    path: Path
    schedule: str
    rate_hz: float | None
    threads: int
    benchmark: str
    """What `start` and `targets` are limits of: `model` or `service`."""
    start: dict[str, float]
    targets: dict[int, dict[str, float]]


def load_budget(path: Path, benchmark: str = MODEL) -> Budget:
    """Read the part of a budget that is for the model, or for the service.

    Raises EqrtError if it cannot be read or has a key that nothing stands for.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors begin with a mark
        values = tomllib.loads(text)
    except OSError as error:
        raise EqrtError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:  # neither TOML nor UTF-8, or far too deep
        raise EqrtError(f"{path}: not TOML ({error})") from error
    _known(path, "", values, _KEYS)
    parts: dict[str, Mapping[str, Any]] = {
        MODEL: {key: values[key] for key in ("start", "targets") if key in values},
        SERVICE: _table(path, SERVICE, values.get(SERVICE, {})),
    }
    _known(path, f"{SERVICE}.", parts[SERVICE], ("start", "objects"))
    prefix = {MODEL: "", SERVICE: f"{SERVICE}."}
    limits = {
        name: _part(path, prefix[name], f"{NOUNS[name]}s", part) for name, part in parts.items()
    }
    start, cases = limits[benchmark]
    return Budget(
        path=path,
        schedule=_schedule(path, values),
        rate_hz=_rate(path, values),
        threads=int(_number(path, "threads", values.get("threads", 1))),
        benchmark=benchmark,
        start=start,
        targets=cases,
    )


def _part(
    path: Path, prefix: str, counts: str, values: Mapping[str, Any]
) -> tuple[dict[str, float], dict[int, dict[str, float]]]:
    """The limits of the start, and of each number of targets or objects."""
    cases = _table(path, f"{prefix}{counts}", values.get(counts, {}))
    start = _limits(path, f"{prefix}start", values.get("start", {}), START_LIMITS)
    return start, {
        _count(path, f"{prefix}{counts}", key): _limits(
            path, f"{prefix}{counts}.{key}", table, CASE_LIMITS
        )
        for key, table in cases.items()
    }


def check_duty(budget: Budget, settings: Settings) -> None:
    """Before measuring: will this run measure what the budget names? Raises UsageError if not."""
    wanted = (budget.schedule, budget.rate_hz, budget.threads)
    if wanted != (settings.schedule, settings.rate_hz, settings.threads):
        rate = "" if budget.rate_hz is None else f" --rate {budget.rate_hz:g}"
        raise UsageError(
            f"{budget.path} is for --schedule {budget.schedule}{rate} --threads {budget.threads}; "
            "measure that, or give another budget"
        )
    noun = NOUNS[budget.benchmark]
    if not budget.start and not budget.targets:
        raise UsageError(f"{budget.path} has no limits for the {budget.benchmark}; give another")
    missing = sorted(set(budget.targets) - set(settings.targets))
    if missing:
        raise UsageError(
            f"{budget.path} has limits for {','.join(map(str, missing))} {noun}s, which are not "
            f"measured; add them to --{noun}s"
        )


def broken(budget: Budget, report: Report) -> list[str]:
    """A line for each limit that is broken: what, found, allowed.

    Raises EqrtError if the report lacks something the budget names, such as a percentile for which
    there are too few samples.
    """
    return [*_broken_start(budget, report), *_broken_cases(budget, report)]


def _broken_start(budget: Budget, report: Report) -> Iterator[str]:
    for key, allowed in budget.start.items():
        yield from _line("start", key, START_LIMITS[key](report), allowed)


def _broken_cases(budget: Budget, report: Report) -> Iterator[str]:
    cases = {case.targets: case for case in report.cases}
    for targets, limits in budget.targets.items():
        what = counted(targets, budget.benchmark)
        for key, allowed in limits.items():
            found = CASE_LIMITS[key](cases[targets]) if targets in cases else None
            if found is None:
                raise EqrtError(
                    f"{budget.path}: {key} of {what} was not measured; measure for longer "
                    "(--seconds), or take it out of the budget"
                )
            yield from _line(what, key, found, allowed)


def _line(what: str, key: str, found: float, allowed: float) -> Iterator[str]:
    if not found <= allowed:
        name, unit = (key, "") if key == "deadline_misses" else _name_and_unit(key)
        yield f"{what}: {name} is {found:.4g}{unit}, allowed {allowed:.4g}{unit}"


def _name_and_unit(key: str) -> tuple[str, str]:
    for ending, unit in (("_kib_per_s", " KiB/s"), ("_ms", " ms"), ("_mib", " MiB"), ("_s", " s")):
        if key.endswith(ending):
            return key.removesuffix(ending), unit
    raise ValueError(f"no unit in {key!r}")


def _schedule(path: Path, values: Mapping[str, Any]) -> str:
    schedule = values.get("schedule")
    if schedule not in SCHEDULES:
        raise EqrtError(f"{path}: schedule is {schedule!r}, expected one of {', '.join(SCHEDULES)}")
    return str(schedule)


def _rate(path: Path, values: Mapping[str, Any]) -> float | None:
    if values["schedule"] == BACK_TO_BACK:
        return None
    return _number(path, "rate_hz", values.get("rate_hz"))


def _count(path: Path, where: str, key: str) -> int:
    if not key.isdecimal() or int(key) < 1:
        noun = where.rpartition(".")[2]
        raise EqrtError(f"{path}: [{where}.{key}]: {key!r} is no number of {noun}")
    return int(key)


def _limits(path: Path, where: str, table: Any, known: Mapping[str, Any]) -> dict[str, float]:
    values = _table(path, where, table)
    _known(path, f"{where}.", values, known)
    return {key: _number(path, f"{where}.{key}", value) for key, value in values.items()}


def _known(path: Path, where: str, values: Mapping[str, Any], known: Any) -> None:
    for key in values:
        if key not in known:
            raise EqrtError(f"{path}: {where}{key} is not known; known are {', '.join(known)}")


def _table(path: Path, where: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise EqrtError(f"{path}: {where} is {value!r}, expected a table")
    return value


def _number(path: Path, where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not value >= 0.0:
        raise EqrtError(f"{path}: {where} is {value!r}, expected a number, 0 or more")
    return float(value)
