"""Windows of recorded traffic, the split, and what augmentation may and may not change."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from eqrt.core.errors import EqrtError
from eqrt.training.augment import AugmentConfig, augment
from eqrt.training.commonroad import Scenario, read_scenario
from eqrt.training.data import (
    TrackGrid,
    Windows,
    batches,
    scenario_files,
    scenario_name,
    scenario_windows,
)
from eqrt.training.train import load_config
from source_tree import ROOT

NGSIM = ROOT / "tests/data/ngsim"
CONFIG = load_config(ROOT / "training/configs/eqrt-ngsim.toml")
CONTRACT = CONFIG.model.contract("test", "0.0.0")
NOTHING = AugmentConfig(
    scaled=0.0,
    max_scale=1.0,
    parked=0.0,
    standing=0.0,
    clutter=0.0,
    ghost=0.0,
    alone=0.0,
    short_history=0.0,
    missing_step=0.0,
    hidden_neighbour=0.0,
    missing_line=0.0,
    no_map=0.0,
    unknown_heading=0.0,
    heading_noise_rad=0.0,
    position_noise_m=0.0,
)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return read_scenario(NGSIM / "USA_Peach-4_8_T-1.xml.gz")


@pytest.fixture(scope="module")
def windows(scenario: Scenario) -> Windows:
    return scenario_windows(scenario, CONTRACT, stride=5)


def speed_sequences(scenario: Scenario, steps: int) -> set[tuple[float, ...]]:
    """Every stretch of `steps` speeds that varies: as good as a fingerprint of a vehicle."""
    rows = [np.round(track.speed_mps, 3).tolist() for track in scenario.tracks]
    windows = (tuple(row[i : i + steps]) for row in rows for i in range(len(row) - steps))
    return {window for window in windows if len(set(window)) > steps // 2}


def test_no_vehicle_of_a_held_out_recording_is_trained_on() -> None:
    """Recordings overlap under different names: the same car would be on both sides.

    Two chance matches are allowed: speeds that a recorder repeats look alike.
    """
    held, trained = set[tuple[float, ...]](), set[tuple[float, ...]]()
    for path in scenario_files(NGSIM):
        is_held = scenario_name(path) in CONFIG.data.held_out
        (held if is_held else trained).update(speed_sequences(read_scenario(path), 15))
    assert len(held) > 1000
    assert len(trained) > 100
    assert len(held & trained) <= 2


def test_the_held_out_recordings_that_overlap_are_held_out_together() -> None:
    one, other = (
        speed_sequences(read_scenario(NGSIM / f"{name}.xml.gz"), 15)
        for name in ("USA_US101-22_4_T-1", "USA_US101-21_2_T-1")
    )
    assert len(one & other) > 10
    assert {"USA_US101-22_4_T-1", "USA_US101-21_2_T-1"} <= set(CONFIG.data.held_out)


def test_a_window_holds_what_the_recording_says(scenario: Scenario) -> None:
    """Target 0's last step and its future are its recorded positions."""
    grid = TrackGrid.of(scenario)
    row = int(grid.valid.sum(axis=1).argmax())
    agents = grid.histories(25, 20)
    future, valid = grid.future(25, 30)
    np.testing.assert_array_equal(agents.positions[row, -1], grid.positions[row, 25])
    np.testing.assert_array_equal(future[row, 0], grid.positions[row, 26])
    np.testing.assert_array_equal(valid[row], grid.valid[row, 26:56])


def test_what_lies_before_or_after_the_recording_is_not_seen(scenario: Scenario) -> None:
    grid = TrackGrid.of(scenario)
    assert not grid.histories(5, 20).valid[:, :14].any()
    assert not grid.future(grid.num_steps - 3, 30)[1][:, 2:].any()


def test_every_window_has_a_target_a_past_and_a_future(windows: Windows) -> None:
    assert len(windows) > 50
    assert windows.history_valid[:, 0, -1].all()
    assert (windows.future_valid.sum(axis=1) >= 10).all()
    assert np.isfinite(windows.history).all()
    assert np.isfinite(windows.centerlines).all()
    moved = np.linalg.norm(windows.future[:, 0] - windows.history[:, 0, -1], axis=-1)
    assert moved[windows.future_valid[:, 0]].max() < 5.0  # 0.1 s later


def test_batches_repeat_with_the_seed_and_show_every_window_once(windows: Windows) -> None:
    def futures(seed: int) -> torch.Tensor:
        stream = batches(windows, 16, torch.Generator().manual_seed(seed))
        return torch.cat([next(stream)["future"] for _ in range(len(windows) // 16)])

    assert torch.equal(futures(1), futures(1))
    assert not torch.equal(futures(1), futures(2))
    assert len(torch.unique(futures(1), dim=0)) == len(futures(1))


def test_too_few_windows_for_a_batch_is_an_error_a_user_understands(windows: Windows) -> None:
    with pytest.raises(EqrtError, match="fewer than one batch"):
        next(batches(windows, 10**6, torch.Generator()))


def test_an_empty_folder_is_an_error_a_user_understands(tmp_path: Path) -> None:
    with pytest.raises(EqrtError, match="no CommonRoad scenario"):
        scenario_files(tmp_path)


def augmented(windows: Windows, **changes: float) -> dict[str, torch.Tensor]:
    fields = {name: getattr(NOTHING, name) for name in AugmentConfig.__dataclass_fields__}
    generator = torch.Generator().manual_seed(0)
    return augment(windows.tensors(), AugmentConfig(**(fields | changes)), generator)


def test_without_augmentation_a_batch_stays_as_it_is(windows: Windows) -> None:
    for name, value in augmented(windows).items():
        torch.testing.assert_close(value, windows.tensors()[name])


def test_the_target_stays_seen_now_whatever_is_dropped(windows: Windows) -> None:
    batch = augmented(windows, missing_step=0.9, short_history=1.0, hidden_neighbour=1.0)
    assert batch["history_valid"][:, 0, -1].all()
    assert not batch["history_valid"][:, 1:].any()


def test_scaling_keeps_the_target_where_it_is_and_the_shape_of_its_path(windows: Windows) -> None:
    batch, before = augmented(windows, scaled=1.0, max_scale=2.0), windows.tensors()
    here = before["history"][:, 0, -1]
    torch.testing.assert_close(batch["history"][:, 0, -1], here)
    old, new = before["future"][:, 0] - here, batch["future"][:, 0] - here
    torch.testing.assert_close(old[:, 0] * new[:, 1], old[:, 1] * new[:, 0], atol=1e-2, rtol=1e-3)
    ratio = new.norm(dim=-1) / old.norm(dim=-1).clamp(min=1e-3)
    moving = old.norm(dim=-1) > 0.5
    assert ratio[moving].min() > 0.49
    assert ratio[moving].max() < 2.01
    assert ratio[moving].std() > 0.1


def test_a_parked_target_has_always_been_and_will_be_where_it_is(windows: Windows) -> None:
    batch = augmented(windows, parked=1.0)
    here = windows.tensors()["history"][:, 0, -1]
    torch.testing.assert_close(batch["history"][:, 0], here[:, None].expand(-1, 20, -1))
    torch.testing.assert_close(batch["future"], here[:, None].expand(-1, 30, -1))
    torch.testing.assert_close(batch["history"][:, 1:], windows.tensors()["history"][:, 1:])


def test_in_standing_traffic_nobody_moves(windows: Windows) -> None:
    batch, before = augmented(windows, standing=1.0), windows.tensors()
    seen = before["history_valid"][:, :, -1]
    still = (batch["history"] - batch["history"][:, :, -1:]).abs().amax(dim=(2, 3))
    assert float(still[seen].max()) == 0.0
    torch.testing.assert_close(batch["future"], before["history"][:, 0, -1:].expand(-1, 30, -1))


def test_clutter_is_beside_the_target_and_never_the_target(windows: Windows) -> None:
    batch, before = augmented(windows, clutter=1.0), windows.tensors()
    torch.testing.assert_close(batch["history"][:, 0], before["history"][:, 0])
    seen = before["history_valid"][:, 1:, -1]
    moved = (batch["history"][:, 1:] - batch["history"][:, 1:, -1:]).abs().amax(dim=(2, 3))
    assert float(moved[seen].max()) == 0.0


def test_a_ghost_moves_with_the_target(windows: Windows) -> None:
    batch, before = augmented(windows, ghost=1.0), windows.tensors()
    offset = batch["history"] - before["history"][:, :1]
    torch.testing.assert_close(offset, offset[:, :, :1].expand_as(offset), atol=1e-4, rtol=0)
    assert 0.5 < float(offset[:, 1:].norm(dim=-1).median()) < 3.0
    assert torch.equal(batch["history_valid"], before["history_valid"][:, :1].expand(-1, 8, -1))


def test_a_target_left_alone_has_no_neighbours(windows: Windows) -> None:
    batch = augmented(windows, alone=1.0)
    assert not batch["history_valid"][:, 1:].any()
    assert batch["history_valid"][:, 0, -1].all()


def test_noise_touches_histories_and_never_the_truth(windows: Windows) -> None:
    batch, before = augmented(windows, position_noise_m=0.2), windows.tensors()
    torch.testing.assert_close(batch["future"], before["future"])
    noise = batch["history"] - before["history"]
    assert 0.02 < float(noise.std()) < 0.2
