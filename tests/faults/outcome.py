"""One row of the campaign's table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Outcome:
    """What became of one fault."""

    fault: str
    injected: str
    """How much of it."""
    broken: str
    """The promise that was broken; empty = survived."""
    said: str
    """What consumers were told meanwhile: modes of the cycles."""
    recovery_s: float | None
    """None = never."""

    @property
    def survived(self) -> bool:
        """Every promise was kept, and it recovered."""
        return not self.broken and self.recovery_s is not None

    def cells(self) -> tuple[str, str, str, str, str]:
        """As they stand in the table."""
        verdict = "yes" if self.survived else f"**no**: {self.broken or 'did not recover'}"
        recovery = "never" if self.recovery_s is None else f"{self.recovery_s:.2f} s"
        return self.fault, self.injected, verdict, self.said, recovery

    def line(self) -> str:
        """For a terminal, while the campaign runs."""
        fault, injected, verdict, said, recovery = self.cells()
        return f"{fault:<62} {injected:<22} {verdict:<5} {recovery:>8}  {said}"


def table(outcomes: Sequence[Outcome]) -> str:
    """Markdown."""
    rows = [
        "| fault | injected | survived | said meanwhile | recovery |",
        "| --- | --- | --- | --- | --- |",
    ]
    rows += [f"| {' | '.join(outcome.cells())} |" for outcome in outcomes]
    return "\n".join(rows)
