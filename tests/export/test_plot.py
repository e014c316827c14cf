"""`eqrt plot`: the right cases, in the right frame, in files that can be opened."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from eqrt.cli import main
from eqrt.export.evaluation.picture import SHEET_CASES, Case, Outcome, cases, draw_one, draw_sheet
from eqrt.export.evaluation.plot import Ranking
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from packed_scenes import NOW, PackedScene, straight, write_packed
from window_cases import DT_S, H, bend, lane, window


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    """Three targets; the second speeds up most, the third not at all."""
    scenes = [PackedScene([straight(10.0, later_mps=v)], [lane(0.0)]) for v in (12.0, 16.0, 10.0)]
    return write_packed(tmp_path / "three.npz", scenes)


def plot(data: Path, out: Path, *options: object, model: Path = DEFAULT_ARTIFACT) -> int:
    arguments = ["plot", "--model", model, "--data", data, "--out", out, *options]
    return main([str(argument) for argument in arguments])


def one_case(modes: int = 3) -> Case:
    """A left turn, of which the first mode knows."""
    path = bend(8.0, 15.0)
    windows = window(path, [lane(0.0), lane(3.5)])
    courses = np.stack([path[-H:] * [1.0, 1.0 - 0.3 * mode] for mode in range(modes)])
    outcome = Outcome(
        modes=courses[None],
        probabilities=np.linspace(0.6, 0.1, modes)[None],
        velocity=np.stack([0.8 * np.arange(1, H + 1), np.zeros(H)], axis=-1)[None],
    )
    return next(iter(cases(windows, outcome, ["a left turn"], ["ADE 0 m"], DT_S)))


def test_the_worst_come_first_and_ties_stay_in_order() -> None:
    ranking = Ranking(np.array([10, 11, 12, 13]), np.array([1.0, 5.0, 1.0, 9.0]))
    np.testing.assert_array_equal(ranking.worst(3), [13, 11, 10])
    np.testing.assert_array_equal(ranking.worst(9), [13, 11, 10, 12])


def test_a_sample_is_drawn_once_each_and_again_the_same() -> None:
    ranking = Ranking(np.arange(100, 200), np.zeros(100))
    drawn = ranking.sample(20, seed=4)
    assert len(set(drawn.tolist())) == 20
    np.testing.assert_array_equal(drawn, ranking.sample(20, seed=4))
    assert not np.array_equal(drawn, ranking.sample(20, seed=5))
    assert len(ranking.sample(500, seed=4)) == 100


def test_the_target_heads_up_and_left_is_left() -> None:
    """It drove along +x: that is up; it turns left, to negative x."""
    case = one_case()
    np.testing.assert_allclose(case.history[-1], [0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(case.history[0], [0.0, -0.8 * 19], atol=1e-5)
    assert case.truth[-1, 0] < -10.0
    np.testing.assert_allclose(case.velocity[-1], [0.0, 24.0], atol=1e-6)
    np.testing.assert_allclose(case.lanes[1][:, 0], -3.5, atol=1e-6)


def test_a_picture_shows_every_course() -> None:
    """Two lanes, a history and its triangle, the truth, three modes, constant velocity."""
    axes = draw_one(one_case()).axes[0]
    assert len(axes.lines) == 2 + 2 + 1 + 3 + 1
    assert axes.get_title().splitlines() == ["a left turn", "ADE 0 m"]
    low, high = axes.get_ylim()
    assert low < -0.8 * 19
    assert high > 24.0


def test_a_prediction_of_kilometres_leaves_the_picture_and_hides_nothing() -> None:
    case = one_case()
    broken = replace(case, modes=case.modes * 1000.0)
    assert draw_one(broken).axes[0].get_ylim()[1] < 200.0


def test_only_several_modes_have_a_less_probable_one() -> None:
    labels = [
        [text.get_text() for text in draw_one(one_case(modes)).legends[0].get_texts()]
        for modes in (1, 3)
    ]
    assert "less probable" not in labels[0]
    assert "less probable" in labels[1]


def test_a_sheet_has_a_picture_of_each() -> None:
    assert len(draw_sheet([one_case()] * 6, "six").axes) == 6
    assert len(draw_sheet([one_case()], "one").axes) == 1


def test_a_sheet_holds_the_first_of_many() -> None:
    sheet = draw_sheet([one_case()] * (SHEET_CASES + 1), "many")
    assert len(sheet.axes) == SHEET_CASES


def test_names_are_drawn_as_they_are(packed: Path, tmp_path: Path) -> None:
    """Two dollar signs would make a formula of what stands between them."""
    data = packed.rename(tmp_path / "a$^$b.npz")
    assert plot(data, tmp_path / "out", "--worst", 1, "--sample", 0, "--format", "svg") == 0
    figure = draw_one(replace(one_case(), name="a$^$b"))
    figure.savefig(tmp_path / "one.svg")


def test_pictures_of_the_worst_and_of_a_sample(packed: Path, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    assert plot(packed, out, "--worst", 2, "--sample", 1) == 0
    names = sorted(path.name for path in out.iterdir())
    assert names == ["sample-01.png", "sample.png", "worst-01.png", "worst-02.png", "worst.png"]
    for path in out.iterdir():
        head = path.read_bytes()[:24]
        assert head.startswith(b"\x89PNG")
        width, height = struct.unpack(">II", head[16:])
        assert min(width, height) >= 400


def test_the_same_plot_writes_the_same_files(packed: Path, tmp_path: Path) -> None:
    for suffix in ("png", "svg"):
        options = ("--worst", 1, "--sample", 0, "--format", suffix)
        for run in ("first", "second"):
            assert plot(packed, tmp_path / run, *options) == 0
        first, second = (
            (tmp_path / run / f"worst-01.{suffix}").read_bytes() for run in ("first", "second")
        )
        assert first == second


def test_a_vector_picture(packed: Path, tmp_path: Path) -> None:
    assert plot(packed, tmp_path / "out", "--worst", 1, "--sample", 0, "--format", "svg") == 0
    root = ElementTree.parse(tmp_path / "out" / "worst-01.svg").getroot()
    assert root.tag.endswith("svg")
    assert not list((tmp_path / "out").glob("sample*"))


def refused(capsys: pytest.CaptureFixture[str], status: int) -> str:
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert status == 1
    return said


def test_data_without_a_complete_window(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    track = straight(12.0)
    track[NOW + 20 :] = np.nan
    data = write_packed(tmp_path / "short.npz", [PackedScene([track])])
    assert "nothing to draw" in refused(capsys, plot(data, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_made(packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "cannot be written" in refused(capsys, plot(packed, packed, "--worst", 1))


def test_a_seed_below_zero(packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plot(packed, packed, "--seed", -1) == 2
    assert "--seed" in capsys.readouterr().err


def test_a_model_that_is_not_there(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = plot(packed, tmp_path / "out", model=tmp_path / "nowhere")
    assert "no model here" in refused(capsys, status)
