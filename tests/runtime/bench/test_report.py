"""The report as JSON, as a table, and as a page."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench_reports import MS, case, documented_keys, report
from eqrt.core.errors import EqrtError
from eqrt.runtime.bench.baseline import compare
from eqrt.runtime.bench.json_form import parse, read_json, to_json
from eqrt.runtime.bench.measure import distribution
from eqrt.runtime.bench.page import render_page
from eqrt.runtime.bench.report import SCHEMA, Punctuality, Report
from eqrt.runtime.bench.table import (
    WIDTH,
    case_lines,
    closing_lines,
    comparison_lines,
    heading_lines,
)
from eqrt.runtime.drawing.axes import log_ticks, round_ticks

KEPT = Punctuality(ticks=700, misses=1, skipped=0, wake_up=distribution(np.full(700, MS // 20)))
NOISY = np.random.default_rng(3).lognormal(15.0, 1.0, 7_000).astype(np.int64).tolist()
FULL = report(
    case(1, NOISY, punctuality=KEPT),
    replace(case(32, [150 * MS] * 20), reasons=("20 samples, a p99 needs 662",)),
    schedule="periodic",
    rate_hz=10.0,
)


# --- JSON


def test_a_report_comes_back_from_json_as_it_went(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text(to_json(FULL))
    assert read_json(Report, path, SCHEMA) == FULL
    assert to_json(read_json(Report, path, SCHEMA)) == to_json(FULL)


def test_keys_stand_in_the_documented_order() -> None:
    assert list(json.loads(to_json(FULL))) == [
        "schema",
        "measured_at",
        "settings",
        "environment",
        "model",
        "cold_start",
        "cases",
    ]


def test_every_key_is_documented() -> None:
    text = (Path(__file__).parents[3] / "docs/benchmarks.md").read_text(encoding="utf-8")
    names = {"constant velocity", "first", "second"}  # of the workloads and stages made up here
    assert [
        key for key in documented_keys(json.loads(to_json(FULL))) - names if key not in text
    ] == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"schema": 2}, "schema 2 is not supported"),
        ({"schema": None}, "schema None is not supported"),
        ({"cases": 3}, "cases is 3, expected"),
        ({"model": {"name": "x"}}, "model.version is missing"),
        ({"measured_at": True}, "measured_at is True, expected str"),
        ({"cold_start": None}, "cold_start is None, expected ColdStart"),
    ],
)
def test_a_file_that_is_no_report_is_refused_in_one_line(
    tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    path = tmp_path / "report.json"
    path.write_text(json.dumps(json.loads(to_json(FULL)) | change))
    with pytest.raises(EqrtError, match=said) as error:
        read_json(Report, path, SCHEMA)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff\xfe", b"3"])
def test_any_other_file_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "report.json"
    path.write_bytes(content)
    with pytest.raises(EqrtError, match=r"not JSON|schema None"):
        read_json(Report, path, SCHEMA)


def test_a_truth_value_is_no_number() -> None:
    values = json.loads(to_json(FULL))
    values["cases"][0]["targets"] = True
    with pytest.raises(ValueError, match=r"cases\[0\].targets is True, expected int"):
        parse(Report, values)


# --- the terminal


def test_no_line_is_wider_than_100_columns() -> None:
    heading = heading_lines(FULL.settings, FULL.environment, FULL.model, FULL.cold_start)
    lines = [*heading, *(line for one in FULL.cases for line in case_lines(one))]
    slower = report(case(1, [value * 1000 for value in NOISY]), case(32))
    lines += [*closing_lines(FULL), *comparison_lines(compare(FULL, slower))]
    assert max(map(len, lines)) <= WIDTH
    assert all(line == line.rstrip() for line in lines)


def test_a_percentile_without_samples_enough_is_a_dash() -> None:
    row = next(line for line in case_lines(FULL.cases[1]) if line.startswith("model"))
    assert row.split()[1:6] == ["150.0", "-", "-", "-", "150.0"]


def test_the_verdict_names_the_cases_it_is_about() -> None:
    assert closing_lines(FULL)[1].startswith("INVALID: targets 32")
    assert closing_lines(report(case()))[1] == "VALID"
    ended = report(case())
    ended = replace(ended, settings=replace(ended.settings, targets=(1, 8)))
    assert closing_lines(ended)[1].startswith("INVALID: 1 cases not measured")


# --- the page


class Page(HTMLParser):
    """Counts tags, and collects what would be fetched."""

    VOID = frozenset({"meta", "line", "rect", "polyline"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: Counter[str] = Counter()
        self.attributes: set[str] = set()
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes |= {name for name, _ in attrs}
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes |= {name for name, _ in attrs}

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_well_formed_and_fetches_nothing() -> None:
    text = render_page(FULL, compare(FULL, FULL))
    page = Page(text)
    assert page.open == []
    assert page.tags["svg"] == 3 * len(FULL.cases)
    assert not page.tags.keys() & {"script", "link", "img", "iframe", "a", "object", "use"}
    assert not page.attributes & {"src", "href", "srcset", "action", "xlink:href"}
    assert "://" not in text
    assert "url(" not in text
    assert "@import" not in text


def test_what_comes_from_outside_is_escaped() -> None:
    text = render_page(FULL)
    assert "A &lt;fast&gt; processor" in text
    assert "<fast>" not in text


def test_the_page_has_a_dark_theme_and_fits_a_phone() -> None:
    text = render_page(FULL)
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport" content="width=device-width' in text


def test_nothing_is_drawn_outside_its_chart() -> None:
    for total in ([1], [MS] * 11, [MS, 2 * MS], NOISY):
        text = render_page(report(case(totals_ns=total)))
        assert "nan" not in text
        assert "inf" not in text.replace("infer", "").replace("info", "")


@pytest.mark.parametrize(("low", "high"), [(0.5, 1e6), (0.1, 0.11), (1.0, 9.0), (0.5, 24.7)])
def test_logarithmic_axes_have_two_to_six_ticks(low: float, high: float) -> None:
    ticks = log_ticks(low, high)
    assert 2 <= len(ticks) <= 6
    assert all(low * 0.99 <= tick <= high * 1.01 for tick in ticks)


def test_linear_axes_have_round_ticks() -> None:
    assert round_ticks(0.0, 20.0) == [0.0, 5.0, 10.0, 15.0, 20.0]
    assert round_ticks(0.0, 70.0) == [0.0, 20.0, 40.0, 60.0]
