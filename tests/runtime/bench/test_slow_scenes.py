"""Scenes that are slow by themselves are told from runs that were disturbed."""

from __future__ import annotations

import re

import numpy as np
import pytest

from eqrt.runtime.bench.slow_scenes import slow_scenes

SCENES, ROUNDS = 200, 6


def times_ns(rounds: int = ROUNDS) -> np.typing.NDArray[np.int64]:
    """Of runs that take 1 ms, with some noise: (rounds, SCENES)."""
    noise = np.random.default_rng(1).uniform(0.0, 0.2, (rounds, SCENES))
    return (1e6 * (1.0 + noise)).astype(np.int64)


def said(times: np.typing.NDArray[np.int64], runs: int | None = None) -> list[str]:
    total_ns = times.reshape(-1)[:runs]
    return list(slow_scenes(np.arange(len(total_ns)), total_ns, SCENES))


def test_scenes_that_are_slow_whenever_they_come_are_named() -> None:
    times = times_ns()
    times[:, ::4] *= 3
    (line,) = said(times)
    assert re.match(r"25% of the scenes take (2\.[89]|3\.[0-3]) x as long as others", line)


def test_they_may_be_most_of_all() -> None:
    times = times_ns()
    times[:, SCENES // 5 :] *= 3
    (line,) = said(times)
    assert re.match(r"80% of the scenes take (2\.[89]|3\.[0-3]) x as long as others", line)


def test_disturbed_runs_are_not_taken_for_slow_scenes() -> None:
    times = times_ns()
    disturbed = np.random.default_rng(2).random(times.shape) < 0.3
    assert not said(np.where(disturbed, 5 * times, times))


def test_a_machine_that_becomes_slower_is_no_slow_scene() -> None:
    times = times_ns()
    times[ROUNDS // 2 :] *= 3
    assert not said(times)


def test_a_scene_or_two_are_not_worth_a_word() -> None:
    times = times_ns()
    times[:, :4] *= 3
    assert not said(times)


@pytest.mark.parametrize("runs", [1, SCENES, 2 * SCENES - 1])
def test_nothing_is_said_before_every_scene_has_come_twice(runs: int) -> None:
    times = times_ns()
    times[:, ::4] *= 3
    assert not said(times, runs)
    assert said(times, 2 * SCENES)


def test_turns_that_were_left_out_change_nothing() -> None:
    times = times_ns(10)
    times[:, ::4] *= 3
    kept = np.random.default_rng(3).random(times.size) < 0.9
    number = np.flatnonzero(kept)
    assert list(slow_scenes(number, times.reshape(-1)[kept], SCENES))
