"""What became of earlier predictions, and cycles put together from their parts."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from crowd import crowd
from eqrt.runtime.demo.score import Scoreboard
from eqrt.runtime.output.datagrams import Datagram, decode_datagram, encode_datagrams
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.view.hindsight import Hindsight
from eqrt.runtime.view.joining import Joiner
from eqrt.runtime.view.watch import LastMinute, Watch

AGENTS = 12


def aside(forecast: ForecastSet, metres: float) -> ForecastSet:
    """The same cycle, predicted so far beside where the agents will be."""
    return replace(forecast, trajectories=forecast.trajectories + np.array([0.0, metres]))


def test_a_ghost_is_where_the_agent_was_said_to_be_now() -> None:
    """The crowd drives as its most probable modes say; these predictions are 1.5 m off."""
    hindsight = Hindsight()
    for cycle in range(40):
        forecast = aside(crowd(cycle, AGENTS), 1.5)
        ghosts = hindsight.add(forecast)
        old = cycle >= 10 * np.arange(1, 4)
        assert np.isnan(ghosts.error_m[:, ~old]).all()
    stayed = ~np.isnan(ghosts.error_m[:, 2])
    assert stayed.sum() > AGENTS / 2
    assert ghosts.error_m[stayed] == pytest.approx(1.5)
    assert ghosts.constant_velocity_error_m[stayed] == pytest.approx(0.0, abs=1e-9)
    offset = ghosts.position[stayed] - forecast.position[stayed, None]
    np.testing.assert_allclose(offset, np.broadcast_to([0.0, 1.5], offset.shape), atol=1e-9)


def test_a_ghost_between_two_steps_is_on_the_way_between_them() -> None:
    hindsight = Hindsight()
    then, now = crowd(0, AGENTS), crowd(10, AGENTS)
    hindsight.add(then)
    later = replace(  # everybody 0.04 s later than the model's steps, and so much farther
        now,
        anchor_s=now.anchor_s + 0.04,
        position=now.position + 0.04 * now.velocity,
    )
    errors = hindsight.add(later).error_m[:, 0]
    assert np.nanmax(errors) < 1e-9
    assert (~np.isnan(errors)).sum() > AGENTS / 2


def test_a_prediction_of_3_s_is_judged_although_cycles_do_not_come_exactly_so_far_apart() -> None:
    hindsight = Hindsight()
    then, now = crowd(0, AGENTS), crowd(30, AGENTS)
    hindsight.add(then)

    def late(seconds: float) -> ForecastSet:
        return replace(
            now,
            timestamp_s=now.timestamp_s + seconds,
            anchor_s=now.anchor_s + seconds,
            position=now.position + seconds * now.velocity,
            track_id=then.track_id,
        )

    stayed = now.track_id == then.track_id
    errors = hindsight.add(late(0.03)).error_m[:, 2]
    assert stayed.sum() > AGENTS / 3
    assert errors[stayed] == pytest.approx(0.0, abs=1e-9)


def test_a_track_that_was_not_measured_since_has_no_ghost() -> None:
    """A coasting track repeats its measurement: that says nothing about a prediction."""
    hindsight = Hindsight()
    then, now = crowd(0, AGENTS), crowd(10, AGENTS)
    hindsight.add(then)
    ghosts = hindsight.add(replace(now, anchor_s=then.anchor_s, track_id=then.track_id))
    assert np.isnan(ghosts.error_m).all()


def test_the_running_score_is_the_demos_over_the_last_minute() -> None:
    hindsight, board = Hindsight(), Scoreboard()
    for cycle in range(80):
        forecast = aside(crowd(cycle, AGENTS), 0.01 * cycle)
        hindsight.add(forecast)
        board.add(forecast)
    score = hindsight.score()
    assert score is not None
    assert score.count == board.count
    ours, baseline = board.tables()
    assert score.eqrt == pytest.approx(ours)
    assert score.constant_velocity == pytest.approx(baseline, abs=1e-9)


def test_what_is_older_than_a_minute_no_longer_counts() -> None:
    hindsight = Hindsight()
    for cycle in range(700):
        hindsight.add(aside(crowd(cycle, 3), 5.0 if cycle < 50 else 1.0))
    score = hindsight.score()
    assert score is not None
    assert score.eqrt["ade_3s"] == pytest.approx(1.0)


def test_the_score_keeps_its_size_however_long_it_runs() -> None:
    board = Scoreboard(keep=0)
    for cycle in range(200):
        board.add(crowd(cycle, 3))
    assert board.count == 0
    assert all(len(places._times_s) <= 82 for places in board._places.values())


def silence(after: ForecastSet, number: int) -> ForecastSet:
    """What a service says every 0.1 s while no input comes, with the last measurement's time."""
    return replace(
        after,
        cycle=after.cycle + 1 + number,
        mode=Mode.SILENT,
        made_s=after.made_s + 0.3 + 0.1 * number,
        map_from_ego=None,
    ).targets(slice(0))


def test_silence_costs_nothing_however_long_it_lasts() -> None:
    """A parked car's bus sleeps for days."""
    hindsight = Hindsight()
    for cycle in range(60):
        hindsight.add(crowd(cycle, 3))
    assert hindsight.score() is not None
    before = len(hindsight._recent), len(hindsight._board._pending)
    for number in range(1000):
        hindsight.add(silence(crowd(59, 3), number))
    assert (len(hindsight._recent), len(hindsight._board._pending)) <= before
    assert hindsight.score() is None  # the last minute had nothing to judge


def test_time_goes_on_in_silence_and_after_it() -> None:
    """What ends it was measured before it was last said: neither steps back."""
    watch, minute = Watch(), LastMinute()
    for cycle in range(3):
        watch.add(crowd(cycle, 2))
    for number in range(1000):
        minute.add(watch.time_s, watch.update(silence(crowd(2, 2), number)))
    assert watch.time_s - watch.mode_since_s == pytest.approx(99.9)  # of silence
    assert len(list(minute.newest_first())) == pytest.approx(601, abs=1)
    said_s = watch.time_s
    again = replace(crowd(1004, 2), timestamp_s=said_s - 0.05)
    watch.add(again)
    assert said_s < watch.time_s < said_s + 0.05
    watch.add(crowd(1005, 2, start_s=0.1))
    assert watch.time_s == pytest.approx(100.6)
    assert watch.stream == 0


def test_drives_of_several_starts_are_one_timeline() -> None:
    """The clock of the second begins anew with its computer; that of the third goes on for days."""
    watch = Watch(joins_runs=True)
    times_s = []
    for start_s in (500.0, 20.0, 1e6):
        for cycle in range(5):
            watch.add(crowd(cycle, 2, start_s=start_s))
            times_s.append(watch.time_s)
    steps_s = [after - before for before, after in itertools.pairwise(times_s)]
    assert steps_s == pytest.approx([0.1] * 4 + [1.0] + [0.1] * 4 + [1.0] + [0.1] * 4)
    assert watch.time_s - watch.shift_s == pytest.approx(1e6 + 0.4)


def test_what_was_no_prediction_has_no_ghost() -> None:
    """Of who was just found, and nothing told how it moved."""
    hindsight = Hindsight()
    then, now = crowd(0, AGENTS), crowd(10, AGENTS)
    then.velocity[:6] = np.nan
    hindsight.add(then)
    known = ~np.isnan(hindsight.add(now).error_m[:, 0])
    assert not known[:6].any()
    assert known[6:].sum() > 3


def test_a_service_that_starts_again_is_another_stream() -> None:
    watch = Watch()
    for cycle in range(30):
        watch.add(crowd(cycle, AGENTS))
    assert watch.stream == 0
    ghosts, score = watch.add(crowd(0, AGENTS, start_s=3.0))  # the same tracks, but others
    assert watch.stream == 1
    assert np.isnan(ghosts.error_m).all()
    assert score is None


def test_a_mode_is_known_since_its_first_cycle() -> None:
    watch = Watch()
    modes = [Mode.RUN] * 5 + [Mode.NO_POSE] * 5
    for cycle, mode in enumerate(modes):
        watch.add(replace(crowd(cycle, 1), mode=mode))
    assert watch.mode_since_s == crowd(5, 1).timestamp_s


def test_parts_become_a_whole_cycle_again() -> None:
    whole = crowd(3, 200)
    parts = [decode_datagram(payload) for payload in encode_datagrams(whole)]
    assert len(parts) > 1
    joiner = Joiner()
    joined = [joiner.add(part) for part in parts if isinstance(part, Datagram)]
    assert joined[:-1] == [None] * (len(parts) - 1)
    assert joined[-1] is not None
    np.testing.assert_array_equal(joined[-1].track_id, whole.track_id)
    np.testing.assert_allclose(joined[-1].trajectories, whole.trajectories, atol=1e-3)
    assert joined[-1].covariances is not None
    assert joiner.lost_cycles == 0


def test_cycles_that_did_not_come_whole_are_counted() -> None:
    joiner = Joiner()

    def hear(cycle: int, *, without: int | None = None) -> int:
        whole = 0
        for number, payload in enumerate(encode_datagrams(crowd(cycle, 200))):
            if number != without:
                part = decode_datagram(payload)
                assert isinstance(part, Datagram)
                whole += joiner.add(part) is not None
        return whole

    assert [hear(0), hear(1, without=0), hear(2), hear(5), hear(6)] == [1, 0, 1, 1, 1]
    assert joiner.lost_cycles == 3  # 1 in part, 3 and 4
    assert hear(0) == 1  # a service that started again has lost nothing
    assert joiner.lost_cycles == 3


def test_parts_of_different_cycles_make_no_cycle() -> None:
    """Of one service and of another that came after it."""
    here, there = ([part_of(p) for p in encode_datagrams(crowd(0, n))] for n in (200, 190))
    other_model = [replace(one, forecasts=replace(one.forecasts, model_id="other")) for one in here]
    joiner = Joiner()
    last = len(here) - 1
    for one in (here[0], here[0], *here[2:], *other_model[:last]):  # twice; without 1; no last one
        assert joiner.add(one) is None
    assert joiner.lost_cycles == 2
    assert joiner.add(there[0]) is None
    assert joiner.lost_cycles == 3
    later = [joiner.add(one) for one in reversed(here)]  # in whatever order they come
    assert later[:-1] == [None] * last
    assert later[-1] is not None
    np.testing.assert_array_equal(later[-1].track_id, crowd(0, 200).track_id)


def part_of(payload: bytes) -> Datagram:
    part = decode_datagram(payload)
    assert isinstance(part, Datagram)
    return part


def test_the_last_minute_is_bounded_in_time_and_in_bytes() -> None:
    minute = LastMinute(kept_s=10.0, kept_bytes=5_000)
    for second in range(30):
        minute.add(float(second), b"x" * 100)
    assert len(list(minute.newest_first())) == 11
    for second in range(30, 60):
        minute.add(float(second), b"x" * 1_000)
    kept = list(minute.newest_first())
    assert len(kept) == 5
    assert minute.bytes == 5_000
    minute.add(1.0, b"y")  # another clock
    assert list(minute.newest_first()) == [b"y"]
