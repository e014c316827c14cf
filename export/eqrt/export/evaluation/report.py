"""The outcome of an evaluation: as a table to read, and as JSON with every number in full."""

from __future__ import annotations

import json
import os
import tempfile
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from eqrt.core.errors import EqrtError
from eqrt.core.metrics import horizons_s
from eqrt.export.evaluation.measure import MODEL, PUBLISHED, REFUSED, DataCard, Measured, Settings
from eqrt.export.evaluation.predictors import ModelCard
from eqrt.export.evaluation.tally import GROUPS, Tally, mode_counts
from eqrt.training.dataset.store import license_notice
from eqrt.training.recordings.recording import Source

SCHEMA = 1
"""Version of the JSON's layout."""
WIDTH = 100
"""Columns of the table, where paths are not longer."""
BASELINES = ("constant velocity", "constant turn rate")
"""Those that stand beside the model in every row; the table of all targets has the others too."""
SHORT = {"constant velocity": "const. vel.", "constant turn rate": "const. turn"}
_NAME = 19  # columns of a row's name
_INDENT = 12  # columns of what stands above the table


def total(parts: Sequence[Measured]) -> Tally:
    """All datasets together."""
    tally = Tally()
    for part in parts:
        tally.merge(part.tally)
    return tally


def as_json(parts: Sequence[Measured], settings: Settings) -> str:
    """Everything, numbers in full precision, keys always in the same order."""
    model, tally = parts[0].model, total(parts)
    report: dict[str, Any] = {
        "schema": SCHEMA,
        "model": asdict(model),
        "settings": _settings(settings),
        "targets": int(tally.counts[0]),
        "left_out": sum(part.data.left_out for part in parts),
        "data": [asdict(part.data) | {"errors": part.tally.means(0)} for part in parts],
        "groups": [
            {"by": by, "group": name, "targets": int(count), "errors": tally.means(index)}
            for index, ((by, name), count) in enumerate(zip(GROUPS, tally.counts, strict=True))
        ],
    }
    return json.dumps(report, indent=2) + "\n"


def write_json(path: Path, text: str) -> None:
    """Put the file in its place at once: a reader sees the old one or the new one, never half."""
    partial = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=path.parent, prefix=f".{path.name}-", delete=False
        ) as file:
            partial = Path(file.name)
            file.write(text)
        partial.chmod(0o644)  # a temporary file's own mode lets nobody else read
        os.replace(partial, path)
    except OSError as error:
        if partial is not None:
            partial.unlink(missing_ok=True)
        raise EqrtError(f"{path}: cannot be written ({error.strerror})") from error


def as_text(parts: Sequence[Measured], settings: Settings) -> str:
    """What `eqrt eval` prints, at most 100 columns wide."""
    model, tally = parts[0].model, total(parts)
    lines = _model_lines(model)
    for part in parts:
        lines += _data_lines(part.data) + _warnings(part.data)
    lines.append(_settings_line(settings))
    lines += _license_lines(model, [part.data.source for part in parts])
    lines += ["", *_overall(model, tally), *_end(model, tally)]
    lines += [*_best_of(model, tally), *_calibration(model, tally)]
    lines += ["", *_by_group(model, tally)]
    if len(parts) > 1:
        lines += ["", *_by_dataset(model, parts)]
    return "\n".join(lines) + "\n"


def _settings(settings: Settings) -> dict[str, Any]:
    choice = settings.choice
    return {
        "split": choice.split,
        "targets": choice.targets or "default",
        "stride": choice.stride,
        "reader": choice.reader_options.given(),
        "rotate_deg": settings.rotate_deg,
        "batch": settings.batch,
        "threads": settings.threads,
    }


def _model_lines(model: ModelCard) -> list[str]:
    modes = "1 mode" if model.modes == 1 else f"{model.modes} modes"
    name = f"{model.name} {model.version}".rstrip()
    what = f"{name} ({model.kind}, id {model.model_id}, {modes})"
    return [_head("model", what), _head("", model.path)]


def _data_lines(data: DataCard) -> list[str]:
    left = f"{data.left_out:,} left out (gaps in history or future)"
    return [
        _head("data", f"{data.source.name}, {data.recordings:,} recordings"),
        _head("", data.path),
        _head("targets", f"{data.evaluated:,} ({data.targets}), {left}"),
    ]


def _warnings(data: DataCard) -> list[str]:
    if not data.trained_on:
        return []
    many = f"{data.trained_on:,} of its {data.recordings:,} recordings"
    return [_head("warning", f"the model was trained on the vehicles of {many}, by their names")]


def _settings_line(settings: Settings) -> str:
    rotated = f", turned by {settings.rotate_deg:g} degrees" if settings.rotate_deg else ""
    return _head("split", f"{settings.choice.split}{rotated}")


def _license_lines(model: ModelCard, sources: Sequence[Source]) -> list[str]:
    """Said only where a licence forbids commercial use."""
    said = [f"model licence: {model.license}, non-commercial"] if model.non_commercial else []
    notices = [license_notice(source) for source in dict.fromkeys(sources)]
    said += [notice for notice in notices if notice is not None]
    return [line for text in said for line in textwrap.wrap(text, WIDTH, subsequent_indent="  ")]


def _head(name: str, text: str) -> str:
    return f"{name:<{_INDENT}}{text}".rstrip()


def _overall(model: ModelCard, tally: Tally) -> list[str]:
    """All targets: a predictor per row, its most probable trajectory."""
    times = [f"{seconds:g}s" for seconds in horizons_s(model.dt_s, model.horizon_steps)]
    errors = [f"{kind}_{time}" for time in times for kind in ("ade", "fde")]
    titles = [f"{kind} {time}" for time in times for kind in ("ADE", "FDE")]
    head = f"{'all targets':<{_NAME}}{'targets':>9}" + "".join(f"{t:>9}" for t in titles)
    lines = [head + f"{'missed':>9}"]
    means, count = tally.means(0), int(tally.counts[0])
    refused = means[PUBLISHED][REFUSED]
    for predictor, table in means.items():
        if predictor != PUBLISHED or refused:
            row = f"{_called(predictor, model):<{_NAME}}{count:>9,}"
            cells = (_cell(error, table[error]) for error in (*errors, "miss_rate"))
            lines.append(row + "".join(f"{cell:>9}" for cell in cells))
    if refused:
        lines.append(
            f"as published: the service's guard refuses {round(refused * count):,} "
            f"({refused:.1%}) for constant turn rate"
        )
    return lines


def _end(model: ModelCard, tally: Tally) -> list[str]:
    """Is it the speed or the way that is predicted wrongly?"""
    table = tally.means(0)[MODEL]
    side = "far" if table["ahead"] > 0.0 else "short"
    return [
        f"{f'where it ends, {_horizon(model)}':<{_NAME}}{int(tally.counts[0]):>9,}"
        f"   along the way {table['along']:.3f}   across {table['across']:.3f}"
        f"   on average {abs(table['ahead']):.3f} too {side}"
    ]


def _best_of(model: ModelCard, tally: Tally) -> list[str]:
    """The best of several modes, where there are several."""
    table = tally.means(0)[MODEL]
    lines = []
    for modes in mode_counts(model.modes):
        lines += [
            f"{f'best of {modes} modes':<{_NAME}}{int(tally.counts[0]):>9,}"
            f"   minADE {table[f'min_ade_{modes}']:.3f}   minFDE {table[f'min_fde_{modes}']:.3f}"
            f"   missed {table[f'miss_rate_{modes}']:.1%}"
            f"   brier-minFDE {table[f'brier_min_fde_{modes}']:.3f}",
            f"{'  of any of them':<{_NAME + 9}}   least ADE {table[f'least_ade_{modes}']:.3f}",
        ]
    return lines


def _calibration(model: ModelCard, tally: Tally) -> list[str]:
    """How well the model knows its errors, where it says so."""
    if not model.covariances:
        return []
    table = tally.means(0)[MODEL]
    return [
        f"{f'uncertainty, {_horizon(model)}':<{_NAME}}{int(tally.counts[0]):>9,}"
        f"   NLL {table['nll']:.3f} nats   inside the 50 % ellipse {table['inside_50']:.1%}"
        f", the 90 % {table['inside_90']:.1%}"
    ]


def _by_group(model: ModelCard, tally: Tally) -> list[str]:
    """By speed and by manoeuvre: errors at the horizon."""
    lines = _comparison_head(model)
    titles = {"all": "", "speed": "by speed now", "manoeuvre": "by manoeuvre"}
    for by, title in titles.items():
        lines += [title] if title else []
        lines += [
            _comparison(name, int(tally.counts[g]), tally.means(g), model)
            for g, (kind, name) in enumerate(GROUPS)
            if kind == by
        ]
    return lines


def _by_dataset(model: ModelCard, parts: Sequence[Measured]) -> list[str]:
    return ["by data"] + [
        _comparison(Path(p.data.path).name, p.data.evaluated, p.tally.means(0), model)
        for p in parts
    ]


def _comparison_head(model: ModelCard) -> list[str]:
    """Two lines: whose, and what."""
    columns = _columns(model)
    blocks = [(_called(MODEL, model), len(columns)), *((SHORT[name], 2) for name in BASELINES)]
    titles = [title for _, title in columns] + ["ADE", "FDE"] * len(BASELINES)
    above = "".join(f"  {f' {name} ':-^{8 * width - 2}}" for name, width in blocks)
    below = f"{_horizon(model):<{_NAME}}{'targets':>9}" + "".join(f"{t:>8}" for t in titles)
    return [" " * (_NAME + 9) + above, below]


def _comparison(
    name: str, count: int, means: Mapping[str, Mapping[str, float]], model: ModelCard
) -> str:
    """One row: the model's errors at the horizon, then the baselines' beside them."""
    columns = [error for error, _ in _columns(model)]
    wanted = [(MODEL, e) for e in columns] + [(b, e) for b in BASELINES for e in columns[:2]]
    cells = [_cell(e, means[p][e]) if means else "-" for p, e in wanted]
    return f"{_shortened('  ' + name):<{_NAME}}{count:>9,}" + "".join(f"{c:>8}" for c in cells)


def _cell(error: str, value: float) -> str:
    """A share as a percentage; metres to the millimetre, as long as the column holds them."""
    if error.startswith("miss"):
        return f"{value:.1%}"
    return f"{value:.3f}" if value < 1e3 else f"{value:.0f}" if value < 1e7 else f"{value:.0e}"


def _columns(model: ModelCard) -> list[tuple[str, str]]:
    """The model's errors in a comparison, and their titles."""
    time = _horizon(model).replace(" ", "")
    columns = [(f"ade_{time}", "ADE"), (f"fde_{time}", "FDE")]
    if counts := mode_counts(model.modes):
        modes = counts[0]
        columns += [(f"min_ade_{modes}", f"mADE{modes}"), (f"min_fde_{modes}", f"mFDE{modes}")]
        return [*columns, (f"miss_rate_{modes}", f"miss{modes}")]
    return [*columns, ("miss_rate", "missed")]


def _horizon(model: ModelCard) -> str:
    return f"{horizons_s(model.dt_s, model.horizon_steps)[-1]:g} s"


def _called(predictor: str, model: ModelCard) -> str:
    names = {MODEL: model.name, PUBLISHED: "  as published"}
    return _shortened(names.get(predictor, predictor))


def _shortened(name: str) -> str:
    return name if len(name) < _NAME else name[: _NAME - 2] + "."
