"""`eqrt eval`: numbers that can be worked out by hand, through the whole command."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from eqrt.cli import main
from eqrt.core.errors import EqrtError
from eqrt.core.metrics import horizons_s
from eqrt.export.artifact import write_artifact
from eqrt.export.evaluation.manoeuvres import MANOEUVRES, SPEED_BANDS
from eqrt.export.evaluation.measure import MODEL, Piece, Settings, measure
from eqrt.export.evaluation.predictors import load_model
from eqrt.export.evaluation.report import as_text
from eqrt.export.evaluation.selection import Choice, select
from eqrt.export.evaluation.tally import (
    GROUPS,
    Tally,
    end_errors,
    errors_of,
    membership,
    mode_counts,
)
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.training.checkpoint import Card, save_checkpoint
from eqrt.training.dataset.split import group_digest
from eqrt.training.dataset.windows import Windows
from eqrt.training.evaluate import Predicted
from eqrt.training.networks.compact import CompactConfig
from eqrt.training.networks.config import SceneConfig
from eqrt.training.networks.registry import ModelConfig, build_network
from packed_scenes import NOW, PackedScene, straight, write_packed

SETTINGS = Settings(choice=Choice())
NGSIM = Path(__file__).parents[1] / "data" / "ngsim"
SCENE = SceneConfig(
    num_agents=4,
    history_steps=20,
    num_centerlines=4,
    centerline_points=10,
    lane_choice="routes",
    horizon_steps=30,
    num_modes=8,
    dt_s=0.1,
)
NETWORK = CompactConfig(width=16, hidden=32, heads=2, layers=1, dropout=0.0)
CARD = Card(
    name="eight-modes",
    data="made up",
    license="CC-BY-NC-SA-4.0",
    non_commercial=True,
    metrics={},
    baseline={},
    command="",
    config_sha256="",
    parameters=0,
    steps=0,
    seed=0,
)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight modes of random weights."""
    torch.manual_seed(3)
    config = ModelConfig(scene=SCENE, kind="compact", network=NETWORK)
    path = tmp_path_factory.mktemp("run") / "model.safetensors"
    save_checkpoint(path, build_network(config), config, CARD)
    return path


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    """Three targets: one keeps 12 m/s, one goes on at 14 m/s, one is not seen in the end."""
    vanishing = straight(12.0)
    vanishing[-1] = np.nan
    scenes = [
        PackedScene([straight(12.0), straight(7.0) + 4.0, straight(0.0) - 4.0]),
        PackedScene([straight(12.0, later_mps=14.0)]),
        PackedScene([vanishing]),
    ]
    return write_packed(tmp_path / "three.npz", scenes)


def evaluate(tmp_path: Path, *arguments: object, model: Path = DEFAULT_ARTIFACT) -> dict[str, Any]:
    """The JSON of an `eqrt eval`."""
    out = tmp_path / "eval.json"
    rest = [str(argument) for argument in arguments]
    assert main(["eval", "--model", str(model), "--jobs", "1", "--json", str(out), *rest]) == 0
    report: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    return report


def errors(report: dict[str, Any], predictor: str, group: str = "all") -> dict[str, float]:
    found: dict[str, float] = next(
        row["errors"][predictor] for row in report["groups"] if row["group"] == group
    )
    return found


def test_errors_of_eight_modes_by_hand() -> None:
    """Mode k runs 8 - k metres beside the truth; the best is not among the first six."""
    truth = np.zeros((1, 30, 2))
    modes = np.zeros((1, 8, 30, 2))
    modes[0, :, :, 1] = np.arange(8.0, 0.0, -1.0)[:, None]
    table = errors_of(Predicted(modes, np.full((1, 8), 0.125)), truth, dt_s=0.1)
    expected = {
        **dict.fromkeys(("ade_1s", "fde_1s", "ade_2s", "fde_2s", "ade_3s", "fde_3s"), 8.0),
        "miss_rate": 1.0,
        "min_ade_6": 3.0,
        "min_fde_6": 3.0,
        "least_ade_6": 3.0,
        "miss_rate_6": 1.0,
        "brier_min_fde_6": 3.0 + (1 - 1 / 6) ** 2,
        "min_ade_8": 1.0,
        "min_fde_8": 1.0,
        "least_ade_8": 1.0,
        "miss_rate_8": 0.0,
        "brier_min_fde_8": 1.0 + (1 - 1 / 8) ** 2,
    }
    assert list(table) == list(expected)
    np.testing.assert_allclose([float(v[0]) for v in table.values()], list(expected.values()))


def test_the_end_is_off_along_the_way_or_across_it() -> None:
    """One goes 3 m too far north, one ends 2 m short and 1 m to the left of a way west."""
    truth = np.zeros((2, 30, 2))
    ends = np.array([[0.0, 3.0], [2.0, -1.0]])
    modes = truth[:, None] + ends[:, None, None]
    direction = np.array([[0.0, 1.0], [-1.0, 0.0]])
    found = end_errors(Predicted(modes, np.ones((2, 1))), truth, direction)
    assert {name: values.tolist() for name, values in found.items()} == {
        "along": [3.0, 2.0],
        "across": [0.0, 1.0],
        "ahead": [3.0, -2.0],
    }


def test_the_report_tells_wrong_speeds_from_wrong_ways(packed: Path, tmp_path: Path) -> None:
    """The second target speeds up by 2 m/s, on a straight road: all that is wrong is along it."""
    report = evaluate(tmp_path, "--data", packed)
    table = errors(report, MODEL)
    assert table["across"] < 0.3 < table["along"]
    assert table["ahead"] < 0.0
    assert table["fde_3s"] >= table["along"]


def test_errors_are_given_at_whole_seconds_and_at_the_horizon() -> None:
    assert horizons_s(0.1, 30) == (1.0, 2.0, 3.0)
    assert horizons_s(0.1, 50) == (1.0, 2.0, 3.0, 5.0)
    assert horizons_s(0.1, 15) == (1.0, 1.5)
    assert horizons_s(0.1, 5) == (0.5,)


def test_the_best_is_taken_of_six_modes_and_of_all() -> None:
    assert [mode_counts(modes) for modes in (1, 3, 6, 8)] == [(), (3,), (6,), (6, 8)]


def test_a_tally_of_parts_is_that_of_the_whole() -> None:
    generator = np.random.default_rng(2)
    members = membership(
        generator.integers(0, len(SPEED_BANDS), 40), generator.integers(0, len(MANOEUVRES), 40)
    )
    values = generator.uniform(0.0, 3.0, 40)
    whole, first, second = Tally(), Tally(), Tally()
    whole.add(members, {"model": {"ade_3s": values}})
    first.add(members[:13], {"model": {"ade_3s": values[:13]}})
    second.add(members[13:], {"model": {"ade_3s": values[13:]}})
    first.merge(second)
    np.testing.assert_array_equal(first.counts, whole.counts)
    for group in range(len(GROUPS)):
        found, expected = first.means(group), whole.means(group)
        assert found.keys() == expected.keys()
        if expected:
            assert found["model"]["ade_3s"] == pytest.approx(expected["model"]["ade_3s"])
    assert whole.means(0)["model"]["ade_3s"] == pytest.approx(values.mean())


def test_an_empty_group_has_a_count_and_no_errors() -> None:
    tally = Tally()
    tally.add(membership(np.array([0]), np.array([0])), {"model": {"ade_3s": np.array([1.0])}})
    stopped = GROUPS.index(("manoeuvre", "stopped"))
    assert tally.counts[stopped] == 0
    assert tally.means(stopped) == {}


@pytest.mark.parametrize("baseline", ["constant velocity", "constant turn rate"])
def test_constant_velocity_on_a_target_that_speeds_up(
    packed: Path, tmp_path: Path, baseline: str
) -> None:
    """2 m/s faster: 0.2 m off after a step, 6 m after 30; the other target is predicted exactly."""
    report = evaluate(tmp_path, "--data", packed)
    expected = {
        "ade_1s": 0.2 * 5.5 / 2,
        "fde_1s": 2.0 / 2,
        "ade_2s": 0.2 * 10.5 / 2,
        "fde_2s": 4.0 / 2,
        "ade_3s": 0.2 * 15.5 / 2,
        "fde_3s": 6.0 / 2,
        "miss_rate": 0.5,
    }
    found = errors(report, baseline)
    assert list(found) == list(expected)
    np.testing.assert_allclose(list(found.values()), list(expected.values()), atol=1e-4)


def test_the_kalman_filter_on_the_same_targets_ends_as_far_off_give_or_take_its_settling(
    packed: Path, tmp_path: Path
) -> None:
    found = errors(evaluate(tmp_path, "--data", packed), "Kalman filter")
    assert found["fde_3s"] == pytest.approx(6.0 / 2, abs=0.05)
    assert found["ade_1s"] == pytest.approx(0.2 * 5.5 / 2, abs=0.05)


def test_what_is_not_wholly_seen_is_left_out_and_counted(packed: Path, tmp_path: Path) -> None:
    report = evaluate(tmp_path, "--data", packed)
    assert (report["targets"], report["left_out"]) == (2, 1)
    counts = {row["group"]: row["targets"] for row in report["groups"]}
    assert counts["10 to 15 m/s"] == counts["straight"] == counts["all"] == 2
    assert sum(counts[band] for band in SPEED_BANDS) == 2
    assert sum(counts[manoeuvre] for manoeuvre in MANOEUVRES) == 2


def test_which_targets(packed: Path, tmp_path: Path) -> None:
    """The dataset's own by default; or all that drive; or also those that stand."""
    chosen = {
        name: evaluate(tmp_path, "--data", packed, "--targets", name)
        for name in ("focal", "complete", "all")
    }
    assert {name: report["targets"] for name, report in chosen.items()} == {
        "focal": 2,
        "complete": 3,
        "all": 4,
    }
    assert evaluate(tmp_path, "--data", packed)["data"][0]["targets"] == "focal"
    stopped = chosen["all"]["groups"][-1]
    assert (stopped["group"], stopped["targets"]) == ("stopped", 1)


def test_data_that_names_no_targets_is_evaluated_on_all_that_drive(tmp_path: Path) -> None:
    scenario = NGSIM / "USA_Lanker-2_23_T-1.xml.gz"
    report = evaluate(tmp_path, "--data", scenario, "--stride", 20)
    assert report["data"][0]["targets"] == "complete"


def test_a_world_turned_by_37_degrees_gives_the_same_errors(tmp_path: Path) -> None:
    """The model is equivariant: to a millimetre, in every group."""
    data = ("--data", NGSIM, "--targets", "all", "--stride", 10)
    plain = evaluate(tmp_path, *data)
    turned = evaluate(tmp_path, *data, "--rotate", 37)
    assert plain["targets"] > 500
    for before, after in zip(plain["groups"], turned["groups"], strict=True):
        assert before["targets"] == after["targets"]
        for predictor, table in before["errors"].items():
            for name, value in table.items():
                if name.startswith(("ade", "fde")):
                    assert after["errors"][predictor][name] == pytest.approx(value, abs=1e-3)


def test_the_size_of_batches_does_not_matter(packed: Path, tmp_path: Path) -> None:
    data = ("--data", packed, "--targets", "all")
    small, large = (evaluate(tmp_path, *data, "--batch", n) for n in (1, 256))
    for one, other in zip(small["groups"], large["groups"], strict=True):
        assert one["errors"].keys() == other["errors"].keys()
        for predictor, table in one["errors"].items():
            assert table == pytest.approx(other["errors"][predictor], abs=1e-5)


def test_the_same_evaluation_writes_the_same_file(packed: Path, tmp_path: Path) -> None:
    texts = []
    for _ in range(2):
        evaluate(tmp_path, "--data", packed)
        texts.append((tmp_path / "eval.json").read_bytes())
    assert texts[0] == texts[1]
    assert not list(tmp_path.glob(".eval.json*"))


def test_several_datasets_are_counted_together(packed: Path, tmp_path: Path) -> None:
    """In the order they were named, whichever process is done first."""
    other = write_packed(tmp_path / "one.npz", [PackedScene([straight(12.0, later_mps=15.0)])])
    alone = [evaluate(tmp_path, "--data", path) for path in (packed, other)]
    both = evaluate(tmp_path, "--data", packed, other, "--jobs", "2")
    assert [part["path"] for part in both["data"]] == [str(packed), str(other)]
    assert both["targets"] == 3
    velocity = [errors(report, "constant velocity")["fde_3s"] for report in (*alone, both)]
    assert velocity[2] == pytest.approx((2 * velocity[0] + velocity[1]) / 3)
    assert [part["errors"] for part in both["data"]] == [
        part["data"][0]["errors"] for part in alone
    ]


def test_a_checkpoint_of_eight_modes(packed: Path, tmp_path: Path, checkpoint: Path) -> None:
    report = evaluate(tmp_path, "--data", packed, model=checkpoint)
    assert report["model"]["kind"] == "checkpoint"
    assert report["model"]["modes"] == 8
    table = errors(report, "model")
    assert table["min_fde_8"] <= table["min_fde_6"] <= table["fde_3s"]
    assert table["brier_min_fde_6"] >= table["min_fde_6"]
    folder = evaluate(tmp_path, "--data", packed, model=checkpoint.parent)
    assert folder["groups"] == report["groups"]


@pytest.mark.parametrize("kind", ["checkpoint", "artifact"])
def test_measuring_on_what_was_trained_on_is_said(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    """Two of three scenes; the third is another source's of the same name."""
    groups = [("Argoverse 1", "1"), ("Argoverse 1", "2"), ("NGSIM", "3")]
    card = replace(CARD, trained_on=tuple(sorted(group_digest(*group) for group in groups)))
    config = ModelConfig(scene=SCENE, kind="compact", network=NETWORK)
    model, path = build_network(config).eval(), tmp_path / kind
    if kind == "checkpoint":
        save_checkpoint(path / "model.safetensors", model, config, card)
    else:
        write_artifact(model, config.contract("eight-modes", "1.0.0"), card, path)
    assert evaluate(tmp_path, "--data", packed, model=path)["data"][0]["trained_on"] == 2
    said = "warning     the model was trained on the vehicles of 2 of its 3 recordings, by their"
    assert said in capsys.readouterr().out


def test_a_model_that_does_not_say_what_it_was_trained_on_is_not_warned_of(
    packed: Path, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(tmp_path, "--data", packed, model=checkpoint)["data"][0]["trained_on"] == 0
    assert "warning" not in capsys.readouterr().out


def test_calibration_by_hand() -> None:
    """Two targets, 1 m and 9 m off at the end; S = 1 m^2 in all directions: m = 1 and 9."""
    truth = np.zeros((2, 30, 2))
    modes = np.zeros((2, 1, 30, 2))
    modes[:, 0, -1, 1] = [1.0, 9.0]
    spread = np.broadcast_to(3.0 * np.eye(2), (2, 1, 2, 2))
    table = errors_of(Predicted(modes, np.ones((2, 1)), spread), truth, dt_s=0.1)
    np.testing.assert_allclose(table["nll"], np.array([1.0, 9.0]) + np.log(2 * np.pi))
    np.testing.assert_array_equal(table["inside_50"], [1.0, 0.0])
    np.testing.assert_array_equal(table["inside_90"], [1.0, 0.0])


def test_a_model_that_says_how_far_off_it_may_be_is_measured_by_it(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The checkpoint and the artifact alike; the baselines say nothing of the kind."""
    torch.manual_seed(3)
    network = replace(NETWORK, uncertainty=True)
    config = ModelConfig(scene=SCENE, kind="compact", network=network)
    model = build_network(config)
    save_checkpoint(tmp_path / "run" / "model.safetensors", model, config, CARD)
    write_artifact(model, config.contract("uncertain", "1.0.0"), CARD, tmp_path / "artifact")
    reports = [
        evaluate(tmp_path, "--data", packed, model=tmp_path / name) for name in ("run", "artifact")
    ]
    tables = [errors(report, "model") for report in reports]
    assert {"nll", "inside_50", "inside_90"} < tables[0].keys()
    assert tables[0] == pytest.approx(tables[1], abs=1e-3)
    for report in reports:
        assert report["model"]["covariances"] is True
        assert "nll" not in errors(report, "constant velocity")
        assert "nll" not in errors(report, "published")
    lines = capsys.readouterr().out.splitlines()
    (said,) = {line for line in lines if line.startswith("uncertainty, 3 s")}
    assert f"NLL {tables[0]['nll']:.3f} nats" in said
    assert max(len(line) for line in lines if not line.startswith(" ")) <= 100


def test_what_no_vehicle_can_do_is_counted_and_measured_as_the_service_publishes_it(
    packed: Path,
) -> None:
    """A model that jumps by 50 m: refused every time, and constant turn rate stands in for it."""
    sound = load_model(DEFAULT_ARTIFACT)

    def jump(windows: Windows) -> Predicted:
        predicted = sound.predict(windows)
        return replace(predicted, trajectories=predicted.trajectories + 50.0)

    piece = Piece(model=DEFAULT_ARTIFACT, data=packed, base=Path.cwd(), settings=SETTINGS)
    selection = select(packed, sound.contract, SETTINGS.choice)
    jumping = measure(replace(sound, predict=jump), selection, piece)
    means = jumping.tally.means(0)
    assert means["model"]["fde_3s"] > 40.0
    assert means["published"].pop("refused") == 1.0
    assert means["published"] == means["constant turn rate"]
    said = as_text([jumping], SETTINGS)
    assert "the service's guard refuses 2 (100.0%) for constant turn rate" in said
    plain = measure(sound, selection, piece)
    assert plain.tally.means(0)["published"]["refused"] == 0.0
    assert "as published" not in as_text([plain], SETTINGS)


def test_a_model_that_predicts_no_numbers_is_refused(packed: Path) -> None:
    sound = load_model(DEFAULT_ARTIFACT)

    def nothing(windows: Windows) -> Predicted:
        predicted = sound.predict(windows)
        return replace(predicted, trajectories=predicted.trajectories * np.nan)

    def no_spread(windows: Windows) -> Predicted:
        return replace(sound.predict(windows), end_covariances=np.full((1, 1, 2, 2), np.inf))

    piece = Piece(model=DEFAULT_ARTIFACT, data=packed, base=Path.cwd(), settings=SETTINGS)
    selection = select(packed, sound.contract, SETTINGS.choice)
    for broken in (nothing, no_spread):
        with pytest.raises(EqrtError, match="predicts what is not a number"):
            measure(replace(sound, predict=broken), selection, piece)


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> list[str]:
    assert main(["eval", *map(str, arguments)]) == 0
    return capsys.readouterr().out.splitlines()


def test_the_table_says_what_was_measured(
    packed: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(packed.parent)
    lines = printed(capsys, "--model", DEFAULT_ARTIFACT, "--data", packed.name)
    assert any(line.startswith("data licence: CC-BY-NC-SA-4.0, non-commercial") for line in lines)
    assert "targets     2 (focal), 1 left out (gaps in history or future)" in lines
    velocity = next(line for line in lines if line.startswith("constant velocity"))
    expected = ["0.550", "1.000", "1.050", "2.000", "1.550", "3.000", "50.0%"]
    assert velocity.split()[2:] == ["2", *expected]
    empty = next(line for line in lines if line.startswith("  stopped"))
    assert empty.split()[1:] == ["0", *["-"] * 7]


def test_the_table_fits_a_hundred_columns(
    packed: Path,
    checkpoint: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shutil.copy(checkpoint, packed.parent / "eight.safetensors")
    monkeypatch.chdir(packed.parent)
    data = ("--data", packed.name, packed.name, "--jobs", 1)
    lines = printed(capsys, "--model", "eight.safetensors", *data)
    assert max(map(len, lines)) <= 100
    assert "model licence: CC-BY-NC-SA-4.0, non-commercial" in lines
    assert any(line.startswith("best of 6 modes") for line in lines)
    assert any(line.startswith("best of 8 modes") for line in lines)
    assert sum("three.npz" in line and "2" in line for line in lines) >= 2


def test_nothing_is_said_of_licences_that_allow_all_use(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scenario = NGSIM / "USA_Lanker-2_23_T-1.xml.gz"
    lines = printed(capsys, "--model", DEFAULT_ARTIFACT, "--data", scenario, "--stride", 20)
    assert not any("licence" in line for line in lines)


def refused(capsys: pytest.CaptureFixture[str], arguments: Sequence[object], status: int) -> str:
    """The one line that a command ends with."""
    assert main(["eval", *map(str, arguments)]) == status
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_a_model_that_is_not_there(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (tmp_path / "nowhere", tmp_path):
        said = refused(capsys, ["--model", path, "--data", packed], 1)
        assert f"{path}: no model here" in said
    assert "not a checkpoint" in refused(capsys, ["--model", packed, "--data", packed], 1)


def test_data_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--model", DEFAULT_ARTIFACT, "--data", tmp_path / "nowhere"]
    assert "nowhere: no such file" in refused(capsys, arguments, 1)


def test_data_without_a_complete_window(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    track = straight(12.0)
    track[NOW + 20 :] = np.nan
    data = write_packed(tmp_path / "short.npz", [PackedScene([track])])
    said = refused(capsys, ["--model", DEFAULT_ARTIFACT, "--data", data], 1)
    assert "none of 1 chosen windows (targets focal, split all) has a whole history" in said


def test_focal_targets_of_data_that_names_none(capsys: pytest.CaptureFixture[str]) -> None:
    scenario = NGSIM / "USA_Lanker-2_23_T-1.xml.gz"
    arguments = ["--model", DEFAULT_ARTIFACT, "--data", scenario, "--targets", "focal"]
    assert "targets" in refused(capsys, arguments, 1)


def test_options_that_are_no_numbers(packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--batch", "--stride", "--threads"):
        arguments = ["--model", DEFAULT_ARTIFACT, "--data", packed, option, "0"]
        assert option in refused(capsys, arguments, 2)
    for angle in ("nan", "inf", "north"):
        arguments = ["--model", DEFAULT_ARTIFACT, "--data", packed, "--rotate", angle]
        assert "--rotate" in refused(capsys, arguments, 2)


@pytest.mark.parametrize(
    "option", [("--stride", 3), ("--maps", "maps"), ("--profile", "ars408"), ("--stationary",)]
)
def test_options_for_raw_data_are_refused_with_prepared_data(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: tuple[object, ...]
) -> None:
    out = tmp_path / "prepared"
    words = ["prepare", packed, "--out", out, "--model", DEFAULT_ARTIFACT, "--jobs", 1]
    assert main([str(word) for word in words]) == 0
    capsys.readouterr()
    arguments = ["--model", DEFAULT_ARTIFACT, "--data", out, *option]
    assert f"{option[0]} is for raw data" in refused(capsys, arguments, 2)


def test_a_json_file_that_cannot_be_written(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = packed / "eval.json"  # below a file
    arguments = ["--model", DEFAULT_ARTIFACT, "--data", packed, "--jobs", "1", "--json", out]
    assert f"{out}: cannot be written" in refused(capsys, arguments, 1)
    (tmp_path / "folder").mkdir()
    arguments[-1] = tmp_path / "folder"
    assert "cannot be written" in refused(capsys, arguments, 1)
    assert not list(tmp_path.glob(".folder*"))
