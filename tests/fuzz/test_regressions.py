"""The fuzzer's seeds, and every input that once broke something, without the fuzzer."""

from __future__ import annotations

from pathlib import Path

import pytest

from fuzz.target import REGRESSIONS
from fuzz.targets import ALL

STORED = [(target.name, path) for target in ALL.values() for path in target.regressions]


@pytest.mark.parametrize("name", ALL)
def test_seeds_break_nothing(name: str) -> None:
    seeds = list(ALL[name].seeds())
    assert seeds
    for seed in seeds:
        ALL[name].run(seed)
        ALL[name].run(seed[: ALL[name].max_bytes])  # as the fuzzer takes it


@pytest.mark.parametrize(("name", "path"), STORED, ids=[f"{n}-{p.name}" for n, p in STORED])
def test_what_once_broke_something_does_not_any_more(name: str, path: Path) -> None:
    ALL[name].run(path.read_bytes())


def test_every_stored_input_belongs_to_a_target() -> None:
    assert {path.name for path in REGRESSIONS.iterdir()} <= set(ALL)
