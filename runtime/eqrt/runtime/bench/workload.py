"""What can be measured: something that runs on demand and tells how long its stages took."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class Timed(Protocol):
    """What samples are of."""

    @property
    def name(self) -> str:
        """What it is called in a report."""

    @property
    def stages(self) -> tuple[str, ...]:
        """The parts of one run, in order."""


class Workload(Timed, Protocol):
    """Runs number 0, 1, 2, ...; each on other input, the same input for the same number."""

    def run(self, number: int) -> Sequence[int]:
        """Run once; nanoseconds spent in each stage. Their sum is the time of the run."""
