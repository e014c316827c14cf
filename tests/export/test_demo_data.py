"""What `eqrt demo` plays is what its recipe makes of the recordings."""

from __future__ import annotations

import gzip
from pathlib import Path

from eqrt.export.demo_data import SCENARIOS, main
from eqrt.runtime.demo.command import DATA
from eqrt.training.configuration import load_config
from eqrt.training.recordings.commonroad_recordings import group_of
from source_tree import ROOT


def test_the_demo_plays_what_its_recipe_makes(tmp_path: Path) -> None:
    """Unpacked: how gzip packs is up to the version of zlib."""
    rav4 = ROOT / "tests/data/can/rav4/candump.log.gz"
    assert main([str(ROOT / "tests/data/ngsim"), str(rav4), str(tmp_path)]) == 0
    for name in ("ngsim.log.gz", "rav4.log.gz"):
        assert unpacked(tmp_path / name) == unpacked(DATA / name)
    assert (tmp_path / "ngsim.tile").read_bytes() == (DATA / "ngsim.tile").read_bytes()


def test_nothing_that_the_demo_plays_was_trained_on() -> None:
    config = load_config(ROOT / "training/configs/eqrt-free.toml")
    assert {group_of(name) for name in SCENARIOS} <= set(config.data.held_out)


def unpacked(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes())
