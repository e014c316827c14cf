"""The baseline with an LSTM: reads what it should, and has no symmetry but that of shifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torch import nn

from eqrt.core.frames import Pose2
from eqrt.export.vectors import nan_where_invalid, without_map, without_neighbours
from paper_systems import LSTM, SCENE, SCENES, move_exactly, nan_free, predict, small_system


@pytest.fixture(scope="module")
def baseline() -> nn.Module:
    return small_system(LSTM).double()


def test_shifting_the_world_shifts_the_prediction(baseline: nn.Module) -> None:
    pose = Pose2(80.0, -30.0, 0.0)
    before = predict(baseline, SCENES["driving"])
    after = predict(baseline, move_exactly(SCENES["driving"], pose))
    np.testing.assert_allclose(after, pose.apply(before), atol=1e-8)


@pytest.mark.parametrize("what", ["tracks", "map"])
def test_turning_the_world_does_not_turn_the_prediction(baseline: nn.Module, what: str) -> None:
    """Neither of its two inputs is read in a frame that turns."""
    scene = SCENES["driving"]
    scene = without_map(scene) if what == "tracks" else scene
    turn = Pose2(0.0, 0.0, 1.0)
    before, after = predict(baseline, scene), predict(baseline, move_exactly(scene, turn))
    assert np.abs(after - turn.apply(before)).max() > 0.01


@pytest.mark.parametrize("name", SCENES)
def test_values_under_false_masks_are_never_read(baseline: nn.Module, name: str) -> None:
    clean = predict(baseline, nan_free(SCENES[name]))
    np.testing.assert_array_equal(predict(baseline, nan_where_invalid(SCENES[name])), clean)


def test_an_agent_that_was_never_seen_moves_nobody(baseline: nn.Module) -> None:
    scene = without_neighbours(SCENES["driving"])
    elsewhere = replace(scene, history=scene.history.copy())
    elsewhere.history[:, 1:] += 5.0
    np.testing.assert_array_equal(predict(baseline, elsewhere), predict(baseline, scene))


def test_a_line_that_is_not_valid_draws_nothing(baseline: nn.Module) -> None:
    scene = SCENES["driving"]
    valid = scene.centerlines_valid & (np.arange(SCENE.num_centerlines) < 2)[None, :, None]
    hidden = replace(scene, centerlines_valid=valid)
    repeated = scene.centerlines.copy()
    repeated[:, 2:] = repeated[:, :1]  # drawn twice is drawn once
    twice = replace(scene, centerlines=repeated, centerlines_valid=valid | valid[:, :1])
    np.testing.assert_allclose(predict(baseline, hidden), predict(baseline, twice), atol=1e-10)


def test_tracks_and_map_do_matter(baseline: nn.Module) -> None:
    full = predict(baseline, SCENES["driving"])
    for poorer in (without_map(SCENES["driving"]), without_neighbours(SCENES["driving"])):
        assert np.abs(predict(baseline, poorer) - full).max() > 1e-4
