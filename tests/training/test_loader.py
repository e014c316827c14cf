"""What is drawn when, and batches made ahead."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from eqrt.core.errors import EqrtError
from eqrt.training.augment import Batch
from eqrt.training.loader import BatchMaker, Loader
from eqrt.training.ranks import alone
from eqrt.training.sampling import InMemory, Pool, Rows, Sampler
from eqrt.training.train import batch_maker
from tiny_training import tiny, tiny_data

CPU = torch.device("cpu")


def pool_of(weights: list[float]) -> Pool:
    source = InMemory(tiny_data().held_out)
    return Pool(source, np.arange(len(weights)), np.array(weights))


def drawn(sampler: Sampler, batch_size: int, samples: int) -> Rows:
    steps = -(-samples // batch_size)
    return np.concatenate([sampler.members(step) for step in range(steps)])[:samples]


def test_every_window_comes_once_an_epoch_and_nothing_is_dropped() -> None:
    """Ten windows in batches of four: the third batch ends one epoch and begins the next."""
    sampler = Sampler(pool_of([1.0] * 10), 4, seed=1)
    members = drawn(sampler, 4, 30)
    for epoch in members.reshape(3, 10):
        assert sorted(epoch) == list(range(10))
    assert not np.array_equal(members[:10], members[10:20])


def test_a_batch_may_be_larger_than_the_data() -> None:
    members = Sampler(pool_of([1.0] * 3), 8, seed=1).members(0)
    assert np.bincount(members).tolist() in ([3, 3, 2], [3, 2, 3], [2, 3, 3])


def test_what_a_step_draws_depends_on_nothing_before_it() -> None:
    one, other = (Sampler(pool_of([1.0] * 10), 4, seed=1) for _ in range(2))
    expected = [one.members(step).tolist() for step in range(20)]
    assert [other.members(step).tolist() for step in reversed(range(20))] == expected[::-1]
    assert Sampler(pool_of([1.0] * 10), 4, seed=2).members(0).tolist() != expected[0]


def test_a_weight_is_how_often_a_window_is_drawn_in_an_epoch_on_average() -> None:
    weights = [2.5, 1.0, 0.5, 0.0] * 10
    pool = pool_of(weights)
    assert pool.samples_per_epoch == 40
    sampler = Sampler(pool, 40, seed=1)
    counts = np.array([np.bincount(sampler.members(e), minlength=40) for e in range(400)])
    floor = np.floor(weights)
    assert np.all((counts == floor) | (counts == np.ceil(weights)))
    by_weight = counts.mean(axis=0).reshape(10, 4).mean(axis=0)
    assert by_weight == pytest.approx([2.5, 1.0, 0.5, 0.0], abs=0.03)


def test_windows_that_are_never_drawn_are_refused() -> None:
    with pytest.raises(EqrtError, match="none of which is ever drawn"):
        Sampler(pool_of([0.0, 0.0]), 1, seed=1)


def test_a_pool_gathers_its_own_rows_in_the_order_asked_for() -> None:
    windows = tiny_data().held_out
    pool = Pool(InMemory(windows), np.array([7, 3, 5]), np.ones(3))
    gathered = pool.gather(np.array([2, 0, 2]))
    assert np.array_equal(gathered.future, windows.future[[5, 7, 5]])


def test_other_rows_or_weights_have_another_fingerprint() -> None:
    pool = pool_of([1.0, 1.0])
    assert pool.fingerprint() == pool_of([1.0, 1.0]).fingerprint()
    assert pool.fingerprint() != pool_of([1.0, 2.0]).fingerprint()
    assert pool.fingerprint() != replace(pool, rows=np.array([0, 2])).fingerprint()


def test_noise_is_the_same_for_the_same_step_and_another_for_the_next() -> None:
    maker = batch_maker(tiny(), tiny_data(), alone())
    one, again = maker(3), batch_maker(tiny(), tiny_data(), alone())(3)
    assert all(torch.equal(one[name], again[name]) for name in ("future", "heading"))
    same_windows = replace(maker, sampler=_Always())
    assert not torch.equal(same_windows(0)["history"], same_windows(1)["history"])


def test_without_augmentation_windows_are_as_recorded() -> None:
    maker = replace(batch_maker(tiny(), tiny_data(), alone()), augmentation=None)
    expected = tiny_data().pool.gather(maker.sampler.members(2)).tensors()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in maker(2).items())


@pytest.mark.parametrize("threads", [1, 3])
def test_batches_come_in_order_however_many_threads_make_them(threads: int) -> None:
    with Loader(numbered, 5, 25, threads, CPU) as loader:
        assert [int(batch["future"][0]) for batch in loader] == list(range(5, 25))
        assert loader.times.samples == 20
        assert loader.times.busy_s > 0.0


def test_no_more_is_made_ahead_than_two_batches_a_thread() -> None:
    made: list[int] = []

    def counting(step: int) -> Batch:
        made.append(step)
        return numbered(step)

    with Loader(counting, 0, 1000, 1, CPU) as loader:
        next(iter(loader))
    assert len(made) <= 3


def test_an_error_in_a_thread_is_raised_where_its_batch_would_have_been() -> None:
    def failing(step: int) -> Batch:
        if step == 2:
            raise EqrtError("shard 3 is gone")
        return numbered(step)

    seen = []
    with pytest.raises(EqrtError, match="shard 3"), Loader(failing, 0, 9, 2, CPU) as loader:
        seen += [int(batch["future"][0]) for batch in loader]
    assert not [thread for thread in threading.enumerate() if "eqrt-loader" in thread.name]


def test_leaving_early_ends_the_threads() -> None:
    with Loader(numbered, 0, 10**9, 2, CPU) as loader:
        next(iter(loader))
    assert not [thread for thread in threading.enumerate() if "eqrt-loader" in thread.name]


def numbered(step: int) -> Batch:
    return {"future": torch.tensor([step])}


class _Always(Sampler):
    """Draws the first windows at every step."""

    def __init__(self) -> None:
        pass

    def members(self, step: int) -> Rows:  # noqa: ARG002 (that is the point)
        return np.arange(16)


def test_a_batch_maker_is_what_the_loader_takes() -> None:
    maker: BatchMaker = batch_maker(tiny(), tiny_data(), alone())
    with Loader(maker, 0, 2, 1, CPU) as loader:
        assert [len(batch["future"]) for batch in loader] == [16, 16]
