"""`python -m faults.restarts`, a few times."""

from __future__ import annotations

from faults.restarts import restarts


def test_the_service_ends_cleanly_and_comes_back_predicting() -> None:
    """How fast is a figure, and not asserted: docs/reliability.md."""
    seen = restarts(3)
    assert seen.signals == {"SIGTERM": 1, "SIGKILL": 1, "SIGSTOP": 1}
    assert seen.unclean == []
    assert len(seen.first_prediction_s) == 3
    assert len(seen.end_s) == 2
