"""Configuration files: what is in them comes back, what is wrong in them is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from eqrt.core.errors import EqrtError, UsageError
from eqrt.training.configuration import TrainConfig, differences, load_config
from eqrt.training.dataset.windows import WindowOptions
from source_tree import ROOT
from tiny_training import AUGMENT, tiny, tiny_file

CONFIGS = sorted((ROOT / "training/configs").rglob("*.toml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_configuration_that_ships_is_read_and_comes_back(path: Path) -> None:
    config = load_config(path)
    assert config.name == path.stem
    assert TrainConfig.from_tables(config.to_tables()) == config


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("seed = 1", "sead = 1"), r"\[train\] has .*unknown fields: sead"),
        (("seed = 1", ""), r"\[train\].*seed"),
        (("heads = 2", ""), r"\[network\].*heads"),
        (('kind = "compact"', 'kind = "oracle"'), r"\[network\] kind is 'oracle'"),
        (('name = "tiny"', "name ="), "not TOML"),
        (('name = "tiny"', "name = 3"), "name: Expected `str`, got `int`"),
        (("[data]", "[date]"), "top level has missing or unknown fields: data, date"),
        (("batch_size = 16", "batch_size = 0"), r"\[train\].*>= 1.*batch_size"),
        (("batch_size = 16", 'batch_size = "16"'), r"\[train\].*Expected `int`.*batch_size"),
        (('optimizer = "adamw"', 'optimizer = "sgd"'), r"\[train\].*'sgd'.*optimizer"),
        (('loss = "best_mode"', 'loss = "worst"'), r"\[train\].*'worst', expected one of ade"),
        (("steps = 100", ""), r"\[train\].*either steps or epochs"),
        (("steps = 100", "steps = 100\nepochs = 2"), r"\[train\].*either steps or epochs"),
        (("mirrored", "mirored"), r"\[augment\].*mirored"),
    ],
)
def test_a_wrong_configuration_names_the_file_and_the_field(
    tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    path = tiny_file(tmp_path, change)
    with pytest.raises(EqrtError, match=said) as refused:
        load_config(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_missing_configuration_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such configuration"):
        load_config(tmp_path / "missing.toml")


def test_the_ade_of_one_mode_does_not_train_several(tmp_path: Path) -> None:
    path = tiny_file(tmp_path, ("num_modes = 1", "num_modes = 6"), ('"best_mode"', '"ade"'))
    with pytest.raises(EqrtError, match=r"'ade' trains one mode, \[scene\] has 6"):
        load_config(path)


def test_without_the_table_augment_there_is_no_augmentation(tmp_path: Path) -> None:
    assert load_config(tiny_file(tmp_path, (AUGMENT, ""))).augment is None


def test_data_is_taken_as_it_is_prepared_unless_something_is_asked_for() -> None:
    data = replace(tiny().data, targets=None, stride=None)
    assert data.window_options() is None
    assert replace(data, stride=3).window_options() == WindowOptions(stride=3, targets="all")


def test_equal_configurations_have_equal_digests_and_others_others() -> None:
    assert tiny().sha256 == tiny().sha256
    assert tiny().sha256 != tiny({"train": {"seed": 2}}).sha256


def test_differences_name_the_table_the_field_and_both_values() -> None:
    there, here = tiny().to_tables(), tiny({"data": {"stride": 7}}).to_tables()
    assert differences(there, here) == ["[data] stride (5 there, 7 here)"]
    del here["augment"]
    assert "[augment] ghost (0.06 there, absent here)" in differences(there, here)
