"""Windows hold what the recording says, and only of targets that teach something."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eqrt.core.contract import ModelContract
from eqrt.core.errors import LogError
from eqrt.training.dataset.windows import (
    COLUMNS,
    WindowCutter,
    WindowOptions,
    Windows,
    join,
    no_windows,
)
from eqrt.training.recordings.recording import Recording, TrackGrid
from window_samples import CONTRACT, scenario, scenario_windows


@pytest.fixture(scope="module")
def windows() -> Windows:
    return scenario_windows()


def recorded(tracks: TrackGrid, now_steps: tuple[int, ...] | None = (19,)) -> Recording:
    """Tracks without lanes, the first of them the dataset's own target."""
    agents = len(tracks.valid)
    return Recording(
        name="test",
        group="test",
        dt_s=0.1,
        tracks=tracks,
        track_ids=tuple(map(str, range(agents))),
        may_be_target=np.ones(agents, np.bool_),
        focal=np.arange(agents) == 0,
        now_steps=now_steps,
        lanes=None,
    )


def drive(agents: int, steps: int = 50, speed_mps: float = 10.0) -> TrackGrid:
    """Agents side by side, all seen all the time, along +x."""
    tracks = TrackGrid.empty(agents, steps)
    tracks.positions[..., 0] = speed_mps * 0.1 * np.arange(steps)
    tracks.positions[..., 1] = 4.0 * np.arange(agents)[:, None]
    tracks.valid[:] = True
    return tracks


def cut(tracks: TrackGrid, contract: ModelContract = CONTRACT, **options: object) -> Windows:
    cutter = WindowCutter(contract, WindowOptions(**options))  # type: ignore[arg-type]
    return cutter.cut(recorded(tracks), 7)


def test_a_window_is_the_recording_seen_from_its_origin(windows: Windows) -> None:
    tracks = scenario().tracks
    row = int(np.argmax(windows.history_valid[:, 0].all(1) & windows.future_valid.all(1)))
    agent, step, origin = windows.agent[row], windows.step[row], windows.origin[row]
    past = tracks.positions[agent, step - 19 : step + 1] - origin
    future = tracks.positions[agent, step + 1 : step + 31] - origin
    np.testing.assert_allclose(windows.history[row, 0], past, atol=1e-4)
    np.testing.assert_allclose(windows.future[row], future, atol=1e-4)


def test_every_window_has_a_target_a_past_and_a_future(windows: Windows) -> None:
    assert len(windows) > 20
    assert windows.history_valid[:, 0, -1].all()
    assert (windows.history_valid[:, 0].sum(axis=1) >= 2).all()
    assert (windows.future_valid.sum(axis=1) >= 10).all()
    assert np.isfinite(windows.history).all()
    assert windows.centerlines_valid.any(axis=(1, 2)).mean() > 0.9


def test_what_lies_outside_the_recording_is_not_seen() -> None:
    tracks = drive(1, steps=25)
    assert not tracks.histories(5, 20).valid[:, :14].any()
    assert not tracks.future(22, 30)[1][:, 2:].any()


def test_a_heading_that_nobody_measured_is_zero() -> None:
    tracks = drive(2)
    tracks.heading_rad[1, 19] = np.pi / 2.0
    windows = cut(tracks)
    np.testing.assert_allclose(windows.heading, [[0.0, 0.0], [0.0, 1.0]], atol=1e-7)


def test_the_dataset_says_when_now_is_and_a_stride_adds_more() -> None:
    assert set(cut(drive(1)).step) == {19}
    assert sorted(set(cut(drive(1), stride=10).step)) == [1, 11, 19, 21, 31]
    assert sorted(set(cut(drive(1), stride=6).step)) == [1, 7, 13, 19, 25, 31, 37]


@pytest.mark.parametrize("stride", [None, 2, 5, 6, 10])
def test_whatever_the_stride_a_scene_as_long_as_history_and_future_is_complete_once(
    stride: int | None,
) -> None:
    assert cut(drive(1), stride=stride).complete().step.tolist() == [19]


def test_targets_are_the_datasets_own_the_complete_ones_or_all() -> None:
    tracks = drive(4)
    tracks.positions[1] = tracks.positions[1, :1]  # stands
    tracks.valid[2, :5] = False  # came late
    tracks.valid[3, 18:] = False  # is gone
    assert cut(tracks, targets="focal").agent.tolist() == [0]
    assert cut(tracks, targets="complete").agent.tolist() == [0]
    assert cut(tracks, targets="all").agent.tolist() == [0, 1, 2]
    assert cut(tracks, targets="all").focal.tolist() == [True, False, False]


def test_what_is_no_vehicle_is_seen_but_never_a_target() -> None:
    recording = replace(recorded(drive(2)), may_be_target=np.array([True, False]))
    windows = WindowCutter(CONTRACT, WindowOptions()).cut(recording, 0)
    assert windows.agent.tolist() == [0]
    assert windows.history_valid[0, 1].all()


def test_a_recording_without_targets_gives_no_windows_of_the_right_shape() -> None:
    tracks = drive(2)
    tracks.valid[:] = False
    windows = cut(tracks)
    assert len(windows) == 0
    both = join([windows, cut(drive(2))])
    for name in COLUMNS:
        assert getattr(both, name).dtype == getattr(no_windows(CONTRACT), name).dtype


def test_a_recording_on_another_clock_is_refused() -> None:
    slow = replace(recorded(drive(1)), dt_s=0.2)
    with pytest.raises(LogError, match=r"test: time step 0.2 s, the model's is 0.1 s"):
        WindowCutter(CONTRACT, WindowOptions()).cut(slow, 0)


@pytest.mark.parametrize("wrong", [1e300, -2e5, np.nan])
def test_a_recording_with_a_track_in_the_middle_of_nowhere_is_refused(wrong: float) -> None:
    tracks = drive(2)
    tracks.positions[1, 19, 0] = wrong
    with pytest.raises(LogError, match="test: positions lie more than 131 km apart"):
        cut(tracks)
    tracks.valid[1, 19] = False
    assert np.isfinite(cut(tracks).history).all()


def test_a_recording_far_from_the_maps_origin_is_cut() -> None:
    tracks = drive(2)
    tracks.positions[:] += (5e5, 5.4e6)  # as UTM has them
    assert len(cut(tracks)) == 2


def test_the_lanes_of_a_window_are_chosen_as_the_contract_says() -> None:
    routes = scenario_windows()
    nearest = scenario_windows(replace(CONTRACT, lane_choice="nearest"))
    assert nearest.centerlines_valid.all(axis=2).any()
    assert not np.array_equal(routes.centerlines, nearest.centerlines)
    np.testing.assert_array_equal(routes.history, nearest.history)
