"""What is fuzzed: a parser, inputs to begin with, and what it may say."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

FOLDER = Path(__file__).parent
REGRESSIONS = FOLDER / "regressions"
"""A folder per target, with inputs that once broke something."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """One parser under test."""

    name: str
    run: Callable[[bytes], None]
    """Parses one input, whatever it is; raises only if something is wrong with the parser."""
    seeds: Callable[[], Iterable[bytes]]
    """Inputs from which the fuzzer makes others: recordings cut short, small files made by hand."""
    words: tuple[str, ...] = ()
    """What the format is written with, for the fuzzer to put in."""
    max_bytes: int = 4096
    """Longer inputs are not tried."""

    @property
    def regressions(self) -> list[Path]:
        """Inputs that once broke something."""
        return sorted(path for path in (REGRESSIONS / self.name).glob("*") if path.is_file())


@cache
def scratch() -> Path:
    """A folder for the files that a parser reads, one per process."""
    return Path(_SCRATCH.name)


def assert_one_line(error: Exception) -> None:
    """What is refused is refused in one line."""
    said = str(error)
    assert said
    assert "\n" not in said


_SCRATCH = tempfile.TemporaryDirectory(prefix="eqrt-fuzz-")


def written(name: str, data: bytes) -> Path:
    """A file with the input in it."""
    path = scratch() / name
    path.write_bytes(data)
    return path
