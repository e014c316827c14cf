"""What was measured, as tables and as a plot of the documentation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from bench.systems.chosen import NAIVE, all_systems, short_name
from eqrt.runtime.bench.report import Case, counted
from eqrt.runtime.bench.side_by_side.pareto import picture, points_of
from eqrt.runtime.bench.side_by_side.report import ComparedModel, SideBySide, markdown, middle_ns
from eqrt.runtime.bench.table import ms
from source_tree import ROOT

DOCS = ROOT / "docs"
PLOT = DOCS / "systems-pareto.svg"
ALL = "benchmarks.md", "systems table"
EXPORTS = "systems.md", "naive exports"
"""Page and the name of its markers, between which a table is written."""


def write_tables(found: SideBySide) -> None:
    """Both tables into their pages."""
    tables = ((ALL, markdown(found) + left_out(found)), (EXPORTS, naive_table(found)))
    for (page, name), text in tables:
        path = DOCS / page
        path.write_text(between_markers(path, name, text), encoding="utf-8")


def left_out(found: SideBySide) -> str:
    """A paragraph that names the systems that this run was without; nothing if it had all."""
    measured = {model.name for model in found.models}
    missing = [name for name in all_systems() if name not in measured]
    return f"\nNot in this run: {'; '.join(missing)}.\n" if missing else ""


def between_markers(page: Path, name: str, text: str) -> str:
    """The page with `text` between its markers of that name. Raises ValueError if it has none."""
    whole = page.read_text(encoding="utf-8")
    begin, end = f"<!-- {name} -->", f"<!-- end of the {name} -->"
    if whole.count(begin) != 1 or whole.count(end) != 1:
        raise ValueError(f"{page} has no markers {begin} and {end}")
    before, _, rest = whole.partition(begin)
    _, _, after = rest.partition(end)
    return f"{before}{begin}\n{text.strip()}\n\n{end}{after}"


def naive_table(found: SideBySide) -> str:
    """Files of the same network: what `torch.onnx.export` alone makes, and `eqrt export`."""
    titles = ["nodes", "file MB", "start s"]
    titles += [f"{counted(case.targets)}, p50 ms" for case in found.cases]
    heads = [one for title in titles for one in (f"{title}: naive", "eqrt")]
    for place in range(len(found.cases)):
        heads.insert(2 * len(titles) - 2 * place, "naive / eqrt")  # behind its two columns
    lines = [["", *heads], ["---", *["---:"] * len(heads)], *_pairs(found)]
    where = f"{found.environment.cpu}, onnxruntime {found.environment.onnxruntime}, 1 thread"
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{table}\n\n{where}; {found.measured_at}. {verdict(found)}\n"


def _pairs(found: SideBySide) -> Iterator[list[str]]:
    places = {model.name: place for place, model in enumerate(found.models)}
    for name, place in places.items():
        if name + NAIVE in places:
            other = places[name + NAIVE]
            sides = found.models[other], found.models[place]
            cells = [_facts(side) for side in sides]
            facts = [one for pair in zip(*cells, strict=True) for one in pair]
            times = [one for case in found.cases for one in _times(case, other, place)]
            yield [name, *facts, *times]


def _facts(model: ComparedModel) -> list[str]:
    return [
        f"{model.nodes:,}",
        f"{model.file_bytes / 1e6:.2f}",
        f"{model.cold_start.total_s:.2f}",
    ]


def _times(case: Case, naive: int, ours: int) -> list[str]:
    """Medians of both, and their ratio."""
    slow, fast = (middle_ns(case.workloads[place]) for place in (naive, ours))
    return [ms(slow), ms(fast), f"{slow / max(fast, 1):.2f}"]


def verdict(found: SideBySide) -> str:
    """VALID, or what speaks against it."""
    bad = [f"{case.title}: {'; '.join(case.reasons)}" for case in found.cases if not case.valid]
    return f"INVALID: {'. '.join(bad)}." if bad else "VALID."


def plot(found: SideBySide) -> str:
    """Error over the time of the first case, as SVG; naive exports, equal but slower, left out."""
    points = points_of(replace(found, cases=found.cases[:1]))
    shown = [
        replace(point, name=short_name(point.name))
        for point in points
        if not point.name.endswith(NAIVE)
    ]
    return picture(shown, counted(found.cases[0].targets))
