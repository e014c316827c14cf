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
        (("seed = 1", "seed = 9223372036854775808"), r"\[train\].*seed"),
        (("heads = 2", ""), r"\[network\].*heads"),
        (('kind = "compact"', 'kind = "oracle"'), r"\[network\] kind is 'oracle'"),
        (('name = "tiny"', "name ="), "not TOML"),
        (('name = "tiny"', "name = 3"), "name is 3, expected a text"),
        (("[data]", "[date]"), "top level has missing or unknown fields: data, date"),
        (("batch_size = 16", "batch_size = 0"), r"\[train\].*>= 1.*batch_size"),
        (("batch_size = 16", "batch_size = 800000000000"), r"\[train\].*<= 65536.*batch_size"),
        (("batch_size = 16", 'batch_size = "16"'), r"\[train\].*Expected `int`.*batch_size"),
        (('optimizer = "adamw"', 'optimizer = "sgd"'), r"\[train\].*'sgd'.*optimizer"),
        (('loss = "best_mode"', 'loss = "worst"'), r"\[train\].*'worst', expected one of ade"),
        (("steps = 100", ""), r"\[train\].*either steps or epochs"),
        (("steps = 100", "steps = 100\nepochs = 2"), r"\[train\].*either steps or epochs"),
        (("mirrored", "mirored"), r"\[augment\].*mirored"),
        (("no_map = 0.2", "no_map = 30"), r"\[augment\].*<= 1.0.*no_map"),
        (("parked = 0.08", "parked = -0.08"), r"\[augment\].*>= 0.0.*parked"),
        (("max_scale = 1.8", "max_scale = -2"), r"\[augment\].*>= 1.0.*max_scale"),
        (("wander_m = 1.0", "wander_m = nan"), r"\[augment\]: wander_m is nan, expected a finite"),
        (("max_grad_norm = 1.0", "max_grad_norm = inf"), r"\[train\]: max_grad_norm is inf, exp"),
        (("heads = 2", "heads = 7"), r"\[network\]: width is 16, expected a multiple of heads, 7"),
        (("width = 16", "width = -3"), r"\[network\].*>= 1.*width"),
        (("width = 16", "width = 1000000"), r"\[network\].*<= 65536.*width"),
        (("width = 16", 'width = "x"'), r"\[network\].*Expected `int`.*width"),
        (("dropout = 0.1", "dropout = 1.5"), r"\[network\].*< 1.0.*dropout"),
        (("layers = 1", "layers = 0"), r"\[network\].*>= 1.*layers"),
        (
            ("dropout = 0.1", 'dropout = 0.1\nuncertainty = "no"'),
            r"\[network\].*`bool`.*uncertainty",
        ),
        (("layers = 1", "layers = true"), r"\[network\].*Expected `int`, got `bool`.*layers"),
        (("dropout = 0.1", 'frame = "bent"\ndropout = 0.1'), r"\[network\]: frame is 'bent', expe"),
        (("num_agents = 3", "num_agents = 8.5"), r"\[scene\].*Expected `int`.*num_agents"),
        (("num_agents = 3", 'num_agents = "x"'), r"\[scene\].*Expected `int`.*num_agents"),
        (("num_agents = 3", "num_agents = 2000"), r"\[scene\].*<= 1024.*num_agents"),
        (("centerline_points = 8", "centerline_points = 1"), r"\[scene\].*>= 2.*centerline_points"),
        (("dt_s = 0.1", 'dt_s = "0.1"'), r"\[scene\].*Expected `float`, got `str`.*dt_s"),
        (("dt_s = 0.1", "dt_s = 0"), r"\[scene\].*dt_s"),
        (('lane_choice = "routes"', 'lane_choice = "all"'), r"\[scene\]: lane_choice is 'all'"),
        (('[network]\nkind = "compact"', "[network]\nkind = []"), r"\[network\] kind is \[\]"),
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


@pytest.mark.parametrize(
    ("path", "change", "said"),
    [
        ("paper-7-rotated-cnn", ("image_pixels = 200", "image_pixels = 30"), "multiple of 4"),
        ("paper-7-rotated-cnn", ('map = "raster"', 'map = "paper"'), "map is 'paper', expected"),
        ("paper-6-rotated-transformer", ("token_width = 72", "token_width = 70"), "of heads, 12"),
        ("paper-1-lstm", ("image_cell_m = 0.5", "image_cell_m = 0"), r"> 0.0.*image_cell_m"),
    ],
)
def test_the_papers_networks_are_checked_likewise(
    tmp_path: Path, path: str, change: tuple[str, str], said: str
) -> None:
    text = (ROOT / f"training/configs/{path}.toml").read_text(encoding="utf-8")
    assert change[0] in text
    (tmp_path / "changed.toml").write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(EqrtError, match=rf"changed\.toml: \[network\].*{said}"):
        load_config(tmp_path / "changed.toml")


def test_a_missing_configuration_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such configuration"):
        load_config(tmp_path / "missing.toml")


def test_a_mark_that_some_editors_begin_with_is_no_error(tmp_path: Path) -> None:
    path = tiny_file(tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load_config(path) == tiny()


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
