"""Predictions scored against where the same tracks were measured a little later."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.demo.score import MAX_GAP_S, Scoreboard, Scored
from eqrt.runtime.output.forecasts import ForecastSet, Mode

Float64 = NDArray[np.float64]

DT_S, STEPS = 0.1, 30
AHEAD_S: Float64 = DT_S * np.arange(1, STEPS + 1, dtype=np.float64)
Course = Callable[[float], tuple[float, float]]
"""Time -> place."""


def straight(time_s: float) -> tuple[float, float]:
    """10 m/s along x."""
    return 10.0 * time_s, 0.0


def forecast(
    time_s: float,
    seen: Sequence[tuple[int, float, Course]],
    error: Callable[[Float64], Float64] = np.zeros_like,
) -> ForecastSet:
    """A cycle at `time_s` of tracks (id, last measurement, where it is when), each predicted on
    its course but too far to the left by `error`, metres for seconds ahead. A second mode is
    elsewhere.
    """
    anchors = np.array([anchor_s for _, anchor_s, _ in seen])
    places = np.array([course(anchor_s) for _, anchor_s, course in seen]).reshape(-1, 2)
    paths = np.array([[c(a + h) for h in AHEAD_S] for _, a, c in seen]).reshape(-1, STEPS, 2)
    paths[..., 1] = paths[..., 1] + error(AHEAD_S)
    count = len(seen)
    return ForecastSet(
        cycle=0,
        timestamp_s=time_s,
        received_s=time_s,
        made_s=time_s,
        compute_s=0.0,
        mode=Mode.RUN,
        model_id="",
        tile_id="",
        map_from_ego=Pose2(),
        ego_speed_mps=0.0,
        dt_s=DT_S,
        track_id=np.array([track_id for track_id, _, _ in seen], np.int64),
        object_id=np.zeros(count, np.int64),
        anchor_s=anchors,
        agent_mode=np.zeros(count, np.uint8),
        position=places,
        velocity=np.zeros((count, 2)),
        heading_rad=np.full(count, np.nan),
        object_class=np.zeros(count, np.uint8),
        length_m=np.full(count, np.nan),
        width_m=np.full(count, np.nan),
        history=places[:, None],
        history_valid=np.ones((count, 1), np.bool_),
        trajectories=np.stack([paths, paths + 100.0], axis=1),
        probabilities=np.tile([0.6, 0.4], (count, 1)),
    )


def drive(board: Scoreboard, seconds: float, seen: Sequence[int] = (1,), **more: object) -> None:
    """Tracks on the straight course, measured ten times a second."""
    for step in range(round(10 * seconds) + 1):
        time_s = step / 10
        board.add(forecast(time_s, [(i, time_s, straight) for i in seen], **more))  # type: ignore[arg-type]  # error


def test_a_perfect_prediction_scores_zero() -> None:
    """So does constant velocity, on a straight course."""
    board = Scoreboard()
    drive(board, 5.0)
    for table in board.tables():
        assert set(table) == {f"{e}_{s}s" for e in ("ade", "fde") for s in (1, 2, 3)}
        assert list(table.values()) == pytest.approx([0.0] * 6, abs=1e-9)


def test_errors_are_the_distances_to_what_happened() -> None:
    """Two metres per second to the left: at 0.1 k s they are 0.2 k m, 1.1 m in the mean of the
    first ten, and constant velocity is right.
    """
    board = Scoreboard()
    drive(board, 5.0, error=lambda ahead_s: 2.0 * ahead_s)
    ours, baseline = board.tables()
    assert ours == pytest.approx(
        {"ade_1s": 1.1, "fde_1s": 2.0, "ade_2s": 2.1, "fde_2s": 4.0, "ade_3s": 3.1, "fde_3s": 6.0}
    )
    assert max(baseline.values()) == pytest.approx(0.0, abs=1e-9)


def test_constant_velocity_is_the_last_half_second_gone_on() -> None:
    """With x = t²: from 3.5 to 4 s it went 3.75 m, so at 7 s it would be at 16 + 22.5 = 38.5 m; it
    is at 49 m, where a perfect model has it.
    """

    def faster(time_s: float) -> tuple[float, float]:
        return time_s * time_s, 0.0

    scored: list[Scored] = []
    board = Scoreboard()
    for step in range(81):
        scored += board.add(forecast(step / 10, [(1, step / 10, faster)]))
    (at_4_s,) = [s for s in scored if abs(s.anchor_s - 4.0) < 1e-6]
    np.testing.assert_allclose(at_4_s.constant_velocity[-1], [38.5, 0.0])
    np.testing.assert_allclose(at_4_s.truth[-1], [49.0, 0.0])
    np.testing.assert_allclose(at_4_s.predicted, at_4_s.truth, atol=1e-9)
    assert board.tables()[0]["fde_3s"] == pytest.approx(0.0, abs=1e-9)
    assert board.tables()[1]["fde_3s"] > 8.0


def test_a_prediction_is_scored_once_its_whole_future_is_known() -> None:
    """And its track had been seen for half a second: of 51 cycles, those from 0.5 to 1.7 s."""
    board = Scoreboard()
    drive(board, 3.7)
    assert board.count == 0
    drive_on = [forecast(step / 10, [(1, step / 10, straight)]) for step in range(38, 51)]
    assert sum(len(board.add(cycle)) for cycle in drive_on) == board.count == 13


def test_every_track_is_scored_for_itself() -> None:
    board = Scoreboard()
    drive(board, 5.0, seen=(1, 2, 3))
    assert board.count == 3 * 13


def test_a_track_that_ends_is_not_scored_beyond_its_end() -> None:
    """Seen until 3.5 s: predictions until 0.5 s have a known future, and just the last of them a
    known past.
    """
    board = Scoreboard()
    for step in range(81):
        time_s = step / 10
        board.add(forecast(time_s, [(1, time_s, straight)] if time_s <= 3.5 else []))
    assert board.count == 1


def test_a_gap_in_the_truth_is_not_bridged() -> None:
    """Not seen from 2.0 to 2.6 s, longer than what is interpolated; every prediction over the gap,
    and those whose past is in it, are left out.
    """
    gap = range(21, 26)
    scored: list[Scored] = []
    board = Scoreboard()
    for step in range(101):
        seen = [] if step in gap else [(1, step / 10, straight)]
        scored += board.add(forecast(step / 10, seen))
    assert len(gap) * DT_S > MAX_GAP_S
    anchors = sorted({round(10 * s.anchor_s) for s in scored})
    assert anchors[0] == 31  # 2.6 s and half a second
    assert board.too_young == 5  # from 2.6 s to then
    assert anchors[-1] == 67  # the last whose 3.3 s end by 10.0 s


def test_a_short_gap_is_interpolated() -> None:
    """Measured every 0.2 s: the truth in between is where the line through them is."""
    board = Scoreboard()
    for step in range(0, 61, 2):
        board.add(forecast(step / 10, [(1, step / 10, straight)]))
    assert board.count > 5
    assert max(board.tables()[0].values()) == pytest.approx(0.0, abs=1e-9)


def test_a_coasting_track_counts_from_its_last_measurement() -> None:
    """Measured until 1.0 s and again from 1.3 s on, predicted all the while: what was said at 1.1
    and 1.2 s counts from 1.0 s, and repeating a place is no measurement.
    """
    scored: list[Scored] = []
    board = Scoreboard()
    for step in range(61):
        anchor_s = 1.0 if step in (11, 12) else step / 10
        scored += board.add(forecast(step / 10, [(1, anchor_s, straight)]))
    assert sum(abs(s.anchor_s - 1.0) < 1e-9 for s in scored) == 3
    for s in scored:
        np.testing.assert_allclose(s.truth[:, 0], 10.0 * (s.anchor_s + AHEAD_S), atol=1e-9)


def test_cycles_without_anybody_are_no_matter() -> None:
    board = Scoreboard()
    for step in range(100):
        assert board.add(forecast(step / 10, [])) == []
    assert board.count == 0


def test_tracks_that_are_gone_are_forgotten() -> None:
    """A day of driving does not fill the memory."""
    board = Scoreboard()
    for step in range(1200):
        board.add(forecast(step / 10, [(step // 10, step / 10, straight)]))
    assert len(board._places) < 12
    assert len(board._pending) < 40
