"""What augmentation may change, and what it must leave alone."""

from __future__ import annotations

import pytest
import torch

from eqrt.training.augment import AugmentConfig, augment
from eqrt.training.dataset.windows import Windows
from window_samples import ROOMY, scenario_windows


@pytest.fixture(scope="module")
def windows() -> Windows:
    return scenario_windows(ROOMY)


def augmented(windows: Windows, **changes: float) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return augment(windows.tensors(), AugmentConfig(**changes), generator)


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


def test_a_standing_thing_may_be_seen_now_here_now_there(windows: Windows) -> None:
    batch, before = augmented(windows, parked=1.0, wander_m=0.5), windows.tensors()
    here = before["history"][:, :1, -1]
    torch.testing.assert_close(batch["history"][:, 0, -1:], here)
    offset = torch.cat([batch["history"][:, 0], batch["future"]], 1) - here
    assert 0.05 < float(offset.std()) < 0.7
    assert float(offset.diff(dim=1).std()) < 0.3 * float(offset.std())  # without jumps
    torch.testing.assert_close(batch["history"][:, 1:], before["history"][:, 1:])


def test_a_ghost_moves_with_the_target(windows: Windows) -> None:
    batch, before = augmented(windows, ghost=1.0), windows.tensors()
    offset = batch["history"] - before["history"][:, :1]
    torch.testing.assert_close(offset, offset[:, :, :1].expand_as(offset), atol=1e-4, rtol=0)
    assert 0.5 < float(offset[:, 1:].norm(dim=-1).median()) < 3.0
    assert torch.equal(
        batch["history_valid"], before["history_valid"][:, :1].expand(-1, ROOMY.num_agents, -1)
    )


def test_a_target_left_alone_has_no_neighbours(windows: Windows) -> None:
    batch = augmented(windows, alone=1.0)
    assert not batch["history_valid"][:, 1:].any()
    assert batch["history_valid"][:, 0, -1].all()


def test_noise_touches_histories_and_never_the_truth(windows: Windows) -> None:
    batch, before = augmented(windows, position_noise_m=0.2), windows.tensors()
    torch.testing.assert_close(batch["future"], before["future"])
    noise = batch["history"] - before["history"]
    assert 0.02 < float(noise.std()) < 0.2


def test_a_mirrored_scene_turns_left_into_right_and_keeps_every_distance(windows: Windows) -> None:
    batch, before = augmented(windows, mirrored=1.0), windows.tensors()

    def area(values: dict[str, torch.Tensor]) -> torch.Tensor:
        """Twice the signed area between the first step of the past, now, and the last future."""
        here = values["history"][:, 0, -1]
        to_past = values["history"][:, 0, -2] - here
        to_future = values["future"][:, 5] - here
        return to_past[:, 0] * to_future[:, 1] - to_past[:, 1] * to_future[:, 0]

    seen = before["history_valid"][:, 0, -2] & before["future_valid"][:, 5]
    torch.testing.assert_close(area(batch)[seen], -area(before)[seen], atol=2e-2, rtol=1e-3)
    for name in ("history", "centerlines"):
        here = before["history"][:, 0, -1].view(-1, *[1] * (before[name].dim() - 2), 2)
        old, new = (before[name] - here).norm(dim=-1), (batch[name] - here).norm(dim=-1)
        torch.testing.assert_close(new, old, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(batch["heading"][:, 0], before["heading"][:, 0])
    torch.testing.assert_close(batch["heading"][:, 1], -before["heading"][:, 1])


def test_a_rotated_scene_keeps_every_distance_and_turns_heading_and_path_alike(
    windows: Windows,
) -> None:
    batch, before = augmented(windows, rotated=1.0), windows.tensors()
    here = before["history"][:, 0, -1]
    torch.testing.assert_close(batch["history"][:, 0, -1], here)

    def seen_from_target(values: dict[str, torch.Tensor], name: str) -> torch.Tensor:
        return torch.view_as_complex(values[name].flatten(1, -2) - here.unsqueeze(1))

    heading = torch.view_as_complex(batch["heading"]), torch.view_as_complex(before["heading"])
    known = heading[1].abs() > 0.5
    turn = (heading[0] / heading[1])[:, None]  # of each window
    for name in ("history", "centerlines", "future"):
        old, new = seen_from_target(before, name), seen_from_target(batch, name)
        torch.testing.assert_close(new.abs(), old.abs(), atol=1e-3, rtol=1e-4)
        expected = (turn * old)[known]
        assert expected.abs().max() > 10.0
        torch.testing.assert_close(new[known], expected, atol=2e-2, rtol=1e-3)
    assert turn[known].angle().std() > 0.5  # by all kinds of angles


def test_only_the_share_asked_for_is_rotated(windows: Windows) -> None:
    batch, before = augmented(windows, rotated=0.5), windows.tensors()
    moved = (batch["history"] - before["history"]).abs().amax(dim=(1, 2, 3)) > 0.1
    assert 0.2 < moved.float().mean() < 0.8


def test_an_inexact_map_shifts_each_line_as_a_whole(windows: Windows) -> None:
    batch, before = augmented(windows, line_offset_m=0.5), windows.tensors()
    offset = batch["centerlines"] - before["centerlines"]
    torch.testing.assert_close(offset, offset[:, :, :1].expand_as(offset), atol=1e-4, rtol=0)
    assert 0.3 < float(offset[:, :, 0].std()) < 0.7
    torch.testing.assert_close(batch["history"], before["history"])
