"""What a check found: a line of the table, and one line for every failure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


class Result(StrEnum):
    """How a check ended."""

    OK = "ok"
    FAILED = "FAILED"
    NOTED = "note"
    """Nothing that the contract promises: said, not counted."""
    NOT_RUN = "not run"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the table."""

    name: str
    result: Result
    figure: str
    """What was found, in words and numbers."""
    limit: str
    """What is allowed."""
    failures: tuple[str, ...] = ()
    """One line each: what, where, found, allowed."""


def check_of(name: str, failures: Sequence[str], figure: str, limit: str) -> Check:
    """A check that passed if there are no `failures`."""
    result = Result.FAILED if failures else Result.OK
    return Check(name, result, figure, limit, tuple(failures))


def not_run(name: str, reason: str) -> Check:
    """A check that could not be made."""
    return Check(name, Result.NOT_RUN, reason, "")


def passed(checks: Sequence[Check]) -> bool:
    """Whether nothing failed and everything was run."""
    return all(check.result in (Result.OK, Result.NOTED) for check in checks)
