"""Some of the fault campaign: every kind of fault once, in short."""

from __future__ import annotations

import pytest

from faults.machine import FAULTS as MACHINE_FAULTS
from faults.machine import process_fault
from faults.messages import message_faults


def test_faults_on_messages_and_in_the_model_are_survived() -> None:
    for outcome in message_faults():
        assert outcome.survived, outcome.line()
        if outcome.fault != "none":
            assert outcome.injected, outcome.line()


TOLD = {
    "the sensor falls silent for 3 s": "SILENT",
    "the model hangs for 1 s": "LATE",
    "the model hangs for good": "LATE",
}
"""What consumers must be told meanwhile."""


@pytest.mark.parametrize("name", MACHINE_FAULTS)
def test_faults_of_the_machine_are_survived(name: str) -> None:
    outcome = process_fault(name)
    assert outcome.survived, outcome.line()
    assert TOLD.get(name, "") in outcome.said
