"""Metrics lines, pictures of them, and what is shown while training."""

from __future__ import annotations

import io
import math
from pathlib import Path

import pytest
from rich.console import Console

from eqrt.training.plots import plot_metrics
from eqrt.training.progress import Bar, Lines, MetricsLog, new_display, read_lines


def test_lines_come_back_and_a_log_goes_on_where_the_state_is(tmp_path: Path) -> None:
    """A killed process has logged step 30, but left a state of step 20 and half a line."""
    path = tmp_path / "metrics.jsonl"
    first = MetricsLog(path, after=0)
    for step in (10, 20, 30):
        first.write({"step": step, "loss": 1.0 / step})
    first.close()
    with path.open("a", encoding="utf-8") as file:
        file.write('{"step": 40, "lo')
    again = MetricsLog(path, after=20)
    again.write({"step": 30, "loss": 0.5})
    again.close()
    assert [(line["step"], line["loss"]) for line in read_lines(path)] == [
        (10, 0.1),
        (20, 0.05),
        (30, 0.5),
    ]


def test_a_new_log_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n', encoding="utf-8")
    MetricsLog(path, after=0).close()
    assert path.read_text(encoding="utf-8") == ""


def test_a_terminal_gets_a_bar_with_the_loss_and_lines_above_it() -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    with Bar(40, console) as bar:
        bar.advance(10, 1.25, 800.0)
        bar.line("step     10 loss 1.250")
    shown = screen.getvalue()
    assert "10/40" in shown
    assert "loss 1.250" in shown
    assert "800 samples/s" in shown


def test_anything_else_gets_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    display = new_display(40)
    assert isinstance(display, Lines)
    with display:
        display.advance(10, 1.25, 800.0)
        display.line("step     10 [loss] 1.250")
    assert capsys.readouterr().out == "step     10 [loss] 1.250\n"


def test_pictures_show_what_there_is_and_are_the_same_for_the_same_log(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path / "metrics.jsonl", after=0)
    assert plot_metrics(tmp_path / "metrics.jsonl", tmp_path, {}) == []
    for step in range(10, 100, 10):
        error = math.exp(-step / 30) + 1.0
        log.write({"step": step, "loss": error})
        log.write({"step": step, "loss": error, "ade_3s": error, "fde_3s": 2 * error})
    log.close()
    baseline = {"ade_3s": 1.5, "fde_3s": 3.0}
    files = plot_metrics(tmp_path / "metrics.jsonl", tmp_path, baseline)
    assert [file.name for file in files] == ["loss.png", "loss.svg", "errors.png", "errors.svg"]
    before = [file.read_bytes() for file in files]
    plot_metrics(tmp_path / "metrics.jsonl", tmp_path, baseline)
    assert [file.read_bytes() for file in files] == before
