"""What is trained on, what is measured on, and how often each window is drawn."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eqrt.cli import main
from eqrt.core.errors import EqrtError
from eqrt.training.configuration import DataConfig
from eqrt.training.dataset.windows import MIN_DRIVE_M
from eqrt.training.tables import fill
from eqrt.training.training_data import TrainingData, open_training_data
from tiny_training import DATA, tiny
from window_samples import packed_scenes

SCENES = 12


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve scenes of Argoverse's layout: a target and three cars each, one of them seen late."""
    return packed_scenes(tmp_path_factory.mktemp("scenes") / "scenes.npz", SCENES)


def opened(path: Path, data: DataConfig, *more: Path) -> TrainingData:
    return open_training_data(replace(tiny(), data=data), [path, *more])


def test_a_model_is_measured_on_the_datasets_own_targets(scenes: Path) -> None:
    data = opened(scenes, DataConfig(held_out=("1", "2", "3")))
    assert len(data.held_out) == 3
    assert data.held_out.focal.all()
    assert data.held_out.future_valid.all()


def test_it_is_trained_on_everybody_else(scenes: Path) -> None:
    data = opened(scenes, DataConfig(held_out=("1", "2", "3")))
    windows = data.pool.gather(np.arange(len(data.pool)))
    assert set(windows.recording) == set(range(3, SCENES))
    assert 0 < windows.focal.sum() < len(windows)


def test_weights_tell_targets_driving_and_standing_windows_apart(scenes: Path) -> None:
    config = DataConfig(held_out=("1",), focal_weight=3.0, driving_weight=2.0, standing_weight=0.5)
    pool = opened(scenes, config).pool
    windows = pool.gather(np.arange(len(pool)))
    first = windows.history_valid[:, 0].argmax(axis=1)
    began = windows.history[np.arange(len(pool)), 0, first]
    drives = np.hypot(*(windows.future[:, -1] - began).T) >= MIN_DRIVE_M  # all are seen to the end
    assert set(pool.weights) == {3.0, 2.0, 0.5}
    assert np.array_equal(pool.weights == 3.0, windows.focal)
    assert np.array_equal(pool.weights == 2.0, drives & ~windows.focal)
    assert pool.samples_per_epoch == round(pool.weights.sum())


def test_windows_that_their_recording_cuts_off_are_drawn_less_often(scenes: Path) -> None:
    """Scenes last 50 steps, 0 to 49; a target that is lost before their end is no edge."""
    everything = DataConfig(stride=6, held_out=("1",), focal_weight=3.0, standing_weight=0.5)
    as_they_are = opened(scenes, everything).pool
    pool = opened(scenes, replace(everything, cut_share=0.2)).pool
    step = pool.gather(np.arange(len(pool))).step
    inside = (step + 30 <= 49) & (step + 1 > 10)
    assert set(step[inside]) == {13, 19}
    assert np.allclose(pool.weights, as_they_are.weights * np.where(inside, 1.0, 0.2))


def test_a_share_of_nothing_is_refused() -> None:
    """Windows that are never drawn need not be read at all: `targets` and `stride` choose."""
    with pytest.raises(ValueError, match="cut_share"):
        fill(DataConfig, {"cut_share": 0.0}, "data")


def test_a_share_of_the_recordings_is_trained_on_and_all_that_are_held_out_measure(
    scenes: Path,
) -> None:
    def trained_on(share: float) -> set[int]:
        data = opened(scenes, DataConfig(held_out=("1", "2"), train_share=share))
        assert len(data.held_out) == 2
        return set(data.pool.gather(np.arange(len(data.pool))).recording)

    assert trained_on(1.0) == set(range(2, SCENES))
    assert trained_on(0.3) < trained_on(0.6) < trained_on(1.0)


def test_a_share_that_leaves_nothing_is_told(scenes: Path) -> None:
    with pytest.raises(EqrtError, match="no recording is left by held_out and train_share 1e-09"):
        opened(scenes, DataConfig(held_out=("1",), train_share=1e-9))


def test_several_datasets_are_trained_on_together_and_each_is_measured_its_own_way(
    scenes: Path,
) -> None:
    """NGSIM names no targets: there, every complete window counts."""
    data = opened(scenes, DataConfig(held_out=("1", "USA_Peach-2")), *DATA)
    assert data.source.non_commercial
    assert "NGSIM" in data.source.name
    assert 0 < data.held_out.focal.sum() < len(data.held_out)


def folder_of(folder: Path, *names: str) -> Path:
    """The recording DATA[0] under other names, as scenarios of NGSIM's."""
    folder.mkdir()
    for name in names:
        shutil.copy(DATA[0], folder / f"{name}.xml.gz")
    return folder


@pytest.mark.parametrize("held_out", ["USA_US101-21_2_T-1", "USA_US101-21"])
def test_what_is_held_out_takes_its_group_along_in_every_dataset(
    tmp_path: Path, held_out: str
) -> None:
    """US-101's numbers 21 and 22 overlap in time: the same vehicles, under two names."""
    one = folder_of(tmp_path / "one", "USA_Peach-4_8_T-1", "USA_US101-21_2_T-1")
    other = folder_of(tmp_path / "other", "USA_US101-22_4_T-1", "USA_Peach-5_1_T-1")
    data = opened(one, DataConfig(stride=5, held_out=(held_out,)), other)
    trained_on = set(data.pool.gather(np.arange(len(data.pool))).recording)
    assert trained_on == {0, 2}  # by name, one folder after the other
    assert data.recordings == 2


def test_a_group_that_two_splits_put_on_both_sides_is_refused(tmp_path: Path) -> None:
    """Each dataset was split by itself, by other seeds."""
    data = folder_of(tmp_path / "raw", "USA_Peach-4_8_T-1", "USA_Peach-5_1_T-1")
    contract = tiny().model.scene.contract("tiny", "0.0.0")
    for name, held_out in (("one", "USA_Peach-4"), ("other", "USA_Peach-5")):
        (tmp_path / f"{name}.txt").write_text(held_out)
        (tmp_path / "contract.json").write_text(contract.to_json())
        words = ["prepare", str(data), "--out", str(tmp_path / name), "--model", str(tmp_path)]
        words += ["--held-out-groups", str(tmp_path / f"{name}.txt"), "--jobs", "1"]
        assert main(words) == 0
    with pytest.raises(EqrtError, match="group USA_Peach-4 is held out in one dataset and trained"):
        opened(tmp_path / "one", DataConfig(), tmp_path / "other")
    with pytest.raises(EqrtError, match="nothing to train on"):
        opened(tmp_path / "one", DataConfig(held_out=("USA_Peach-4", "USA_Peach-5")))


def test_without_names_the_datas_own_split_counts(scenes: Path) -> None:
    data = opened(scenes, DataConfig())
    windows = data.pool.gather(np.arange(len(data.pool)))
    assert not set(windows.recording) & set(data.held_out.recording)


def test_nothing_to_train_on_and_nothing_to_measure_on_are_told(scenes: Path) -> None:
    everything = tuple(str(number + 1) for number in range(SCENES))
    with pytest.raises(EqrtError, match="nothing to train on"):
        opened(scenes, DataConfig(held_out=everything))
    with pytest.raises(EqrtError, match="group 99 is not here"):
        opened(scenes, DataConfig(held_out=("99",)))
