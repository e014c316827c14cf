"""Two processes train like one."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from eqrt.core.errors import EqrtError
from eqrt.training.ranks import Ranks, alone
from eqrt.training.train import batch_maker, train
from processes import PATIENCE_S, environment
from tiny_training import DATA, tiny, tiny_data, tiny_file

EXACT = (("dropout = 0.1", "dropout = 0.0"), ("evaluate_every = 25", "evaluate_every = 5"))
"""Dropout is drawn in each process for itself."""


def curve(out: Path) -> list[dict[str, float]]:
    lines = (out / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def test_two_processes_give_the_loss_curve_of_one(tmp_path: Path) -> None:
    """Through torchrun and gloo. Equal but for the order of sums, which grows step by step."""
    config = tiny_file(tmp_path, *EXACT)
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    launcher += ["--nproc-per-node", "2", "-m", "eqrt"]
    sources = [word for path in DATA for word in ("--data", str(path))]
    words = ["train", "--config", str(config), *sources, "--out", str(tmp_path / "two")]
    done = subprocess.run(
        [*launcher, *words, "--steps", "30"],
        capture_output=True,
        text=True,
        check=False,
        env=environment(OMP_NUM_THREADS="1"),
        timeout=4 * PATIENCE_S,
    )
    assert done.returncode == 0, done.stderr
    assert "processes           2, 8 windows of every batch each" in done.stdout
    assert done.stdout.count("constant velocity") == 1  # the first process alone speaks
    exact = tiny({"network": {"dropout": 0.0}, "train": {"evaluate_every": 5}})
    train(exact.with_steps(30), tiny_data(), tmp_path / "one")
    one, two = curve(tmp_path / "one"), curve(tmp_path / "two")
    assert [line["step"] for line in two] == [5, 10, 15, 20, 25, 30]
    for mine, theirs in zip(one, two, strict=True):
        assert theirs["loss"] == pytest.approx(mine["loss"], rel=1e-5)
        assert theirs["fde_3s"] == pytest.approx(mine["fde_3s"], rel=1e-4)


@pytest.mark.parametrize("batch_size", [16, 150])
def test_the_slices_of_a_batch_make_the_batch(batch_size: int) -> None:
    """Augmented, and also where a slice ends within a block of noise."""
    config = tiny({"train": {"batch_size": batch_size}})
    whole = batch_maker(config, tiny_data(), alone())
    halves = [
        batch_maker(config, tiny_data(), Ranks(torch.device("cpu"), rank, 2)) for rank in (0, 1)
    ]
    for step in (0, 1, 17):
        batch, parts = whole(step), [half(step) for half in halves]
        for name, tensor in batch.items():
            together = torch.cat([part[name] for part in parts])
            torch.testing.assert_close(together, tensor, rtol=0, atol=0, equal_nan=True)


def test_a_batch_that_cannot_be_shared_equally_is_refused() -> None:
    with pytest.raises(EqrtError, match="batch_size 16 cannot be shared equally by 3 processes"):
        batch_maker(tiny(), tiny_data(), Ranks(torch.device("cpu"), 0, 3))


def test_alone_means_and_votes_are_ones_own() -> None:
    ranks = alone()
    assert ranks.leads
    assert ranks.any(True)
    assert not ranks.any(False)
    assert ranks.mean(torch.tensor([1.0, 2.0])).tolist() == [1.0, 2.0]
