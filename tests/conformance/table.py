"""The support table of docs/conformance.md, made from a run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from source_tree import ROOT

PAGE = ROOT / "docs/conformance.md"
BEGIN, END = "<!-- made by `make conformance-table` -->\n", "<!-- end -->\n"


@dataclass(frozen=True, slots=True)
class Row:
    """A runtime, and how far the worst position of each artifact was off."""

    runtime: str
    version: str
    how: str
    worst_mm: Sequence[float]
    good: bool


def render(artifacts: Sequence[str], rows: Sequence[Row]) -> str:
    """Markdown."""
    head = ["runtime", "version", "how", *(f"{name}, mm" for name in artifacts), "verdict"]
    lines = [head, ["---"] * len(head)]
    lines += [
        [row.runtime, row.version, row.how, *(f"{mm:.3f}" for mm in row.worst_mm), _verdict(row)]
        for row in rows
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def stored(page: Path = PAGE) -> str:
    """The table that the page has."""
    return page.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0]


def store(table: str, page: Path = PAGE) -> None:
    """Put the table into the page, in place of the one there."""
    before, begin, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"{page}: no {BEGIN.strip()} ... {END.strip()}")
    page.write_text(before + begin + table + end + after, encoding="utf-8")


def without_figures(table: str) -> str:
    """The table without deviations, which differ a little from one kind of CPU to another."""
    return re.sub(r"\| \d+\.\d{3} (?=\|)", "| ", table)


def _verdict(row: Row) -> str:
    return "ok" if row.good else "**does not agree**"
