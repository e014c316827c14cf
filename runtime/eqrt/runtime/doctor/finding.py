"""What one check of the doctor found."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """How bad it is."""

    OK = "OK"
    WARN = "WARN"
    """The service runs, but not as well as it could."""
    FAIL = "FAIL"
    """The service would not run, or not as it was asked to."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's report."""

    verdict: Verdict
    check: str
    found: str
    advice: str = ""
    """What to do; empty if nothing."""


def ok(check: str, found: str) -> Finding:
    """All is well."""
    return Finding(Verdict.OK, check, found)


def warn(check: str, found: str, advice: str) -> Finding:
    """It could be better."""
    return Finding(Verdict.WARN, check, found, advice)


def fail(check: str, found: str, advice: str = "") -> Finding:
    """It does not work."""
    return Finding(Verdict.FAIL, check, found, advice)


def has_failed(findings: Iterable[Finding]) -> bool:
    """Whether one of them says so."""
    return any(finding.verdict is Verdict.FAIL for finding in findings)
