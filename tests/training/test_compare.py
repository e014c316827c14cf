"""Trainings side by side: the table, the curve, and what cannot be compared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.lines import Line2D

from eqrt.cli import main
from eqrt.core.errors import EqrtError
from eqrt.training.checkpoint import Card, save_checkpoint
from eqrt.training.compare import Run, curve, table
from eqrt.training.networks.registry import build_network
from eqrt.training.recorder import MODEL_FILE
from tiny_training import tiny

CARD = Card(
    name="turned",
    data="made up",
    license="Apache-2.0",
    non_commercial=False,
    metrics={"ade_3s": 1.5, "fde_3s": 3.25},
    baseline={"ade_3s": 2.0, "fde_3s": 4.0},
    command="eqrt train --config turned.toml",
    config_sha256="",
    parameters=330_000,
    steps=100,
    seed=1,
    recordings=2857,
    samples=25_600,
)
SMALLER = replace(CARD, recordings=143, metrics={"ade_3s": 1.9, "fde_3s": 3.9})
OTHER = replace(CARD, name="shifted", metrics={"ade_3s": 1.7, "fde_3s": 3.5, "nll": 2.0})


def test_a_row_per_run_and_one_of_constant_velocity() -> None:
    assert table([Run("turned-5", SMALLER), Run("shifted", OTHER)]) == [
        "| run | parameters | recordings | samples | ADE 3 s | FDE 3 s | nll |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        "| turned-5 | 330,000 | 143 | 25,600 | 1.900 | 3.900 |  |",
        "| shifted | 330,000 | 2,857 | 25,600 | 1.700 | 3.500 | 2.000 |",
        "| constant velocity |  |  |  | 2.000 | 4.000 |  |",
    ]


def test_runs_that_were_measured_on_other_targets_each_get_their_constant_velocity() -> None:
    elsewhere = replace(OTHER, baseline={"ade_3s": 2.5, "fde_3s": 5.0})
    rows = table([Run("here", CARD), Run("there", elsewhere)])
    assert [row for row in rows if "velocity" in row] == [
        "| constant velocity |  |  |  | 2.000 | 4.000 |  |",
        "| constant velocity |  |  |  | 2.500 | 5.000 |  |",
    ]


def test_constant_velocity_is_one_row_where_some_runs_were_measured_in_more_ways() -> None:
    """A model of several modes has more metrics, and so has what it is compared with."""
    metrics = {"ade_3s": 1.8, "fde_3s": 3.6, "min_ade": 0.9, "inside_50": 0.5}
    several = replace(CARD, metrics=metrics, baseline=CARD.baseline | {"min_ade": 2.0})
    rows = table([Run("one", CARD), Run("six", several), Run("again", CARD)])
    assert rows[0].endswith("| ADE 3 s | FDE 3 s | min ADE | inside 50 |")
    assert [row for row in rows if "velocity" in row] == [
        "| constant velocity |  |  |  | 2.000 | 4.000 | 2.000 |  |"
    ]


def test_a_line_of_the_curve_joins_the_runs_of_one_configuration_by_how_much_they_saw() -> None:
    figure = curve([Run("all", CARD), Run("other", OTHER), Run("few", SMALLER)])
    turned, shifted, *_ = (line for line in figure.axes[0].lines if isinstance(line, Line2D))
    assert turned.get_label() == "turned"
    assert turned.get_xydata().tolist() == [[143, 1.9], [2857, 1.5]]  # type: ignore[union-attr]
    assert shifted.get_xydata().tolist() == [[2857, 1.7]]  # type: ignore[union-attr]
    assert figure.axes[1].get_ylabel().startswith("FDE 3 s")


def test_a_curve_of_what_cannot_be_compared_is_refused() -> None:
    elsewhere = replace(OTHER, baseline={"ade_3s": 2.5, "fde_3s": 5.0})
    with pytest.raises(EqrtError, match="there and here were measured on different targets"):
        curve([Run("here", CARD), Run("there", elsewhere)])
    with pytest.raises(EqrtError, match="old: its checkpoint does not say"):
        curve([Run("old", replace(CARD, recordings=0))])


def test_the_command_prints_the_table_and_draws_the_curve(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, card in (("turned-5", SMALLER), ("turned-100", CARD)):
        save_checkpoint(
            tmp_path / name / MODEL_FILE, build_network(tiny().model), tiny().model, card
        )
    runs = [str(tmp_path / name) for name in ("turned-5", "turned-100")]
    assert main(["compare", *runs, "--plot", str(tmp_path / "curve.svg")]) == 0
    assert "| turned-5 | 330,000 | 143 |" in capsys.readouterr().out
    assert "recordings trained on" in (tmp_path / "curve.svg").read_text()
    assert main(["compare", *runs, "--plot", str(tmp_path / "curve.pdf")]) == 2
    assert main(["compare", *runs, "--plot", str(tmp_path / "curve.svg" / "x.png")]) == 1
    assert "x.png: cannot be written (" in capsys.readouterr().err
    assert main(["compare", str(tmp_path / "nowhere")]) == 1
    assert "no such checkpoint" in capsys.readouterr().err
