"""The buses that the other tests here stand on, and the script that makes them for users."""

from __future__ import annotations

import sys

from socketcan.conftest import RunOnVcan
from socketcan.programs.exchange import MESSAGES, describe
from socketcan.vcan import program
from source_tree import ROOT


def test_classic_and_fd_messages_pass_between_two_processes(run_on_vcan: RunOnVcan) -> None:
    done = run_on_vcan(program("exchange.py", "vcan0"), 60.0)
    assert done.status == 0, done.stderr
    assert done.stdout.splitlines() == [describe(message) for message in MESSAGES]


def test_two_channels_are_two_buses(run_on_vcan: RunOnVcan) -> None:
    """A message on vcan1 is not seen on vcan0, and the tools of can-utils read what is there."""
    listen = "timeout 2 candump -L vcan0 > on0 & timeout 2 candump -L vcan1 > on1 & sleep 0.5"
    done = run_on_vcan(
        ["sh", "-c", f"{listen}; cansend vcan1 123#DEADBEEF; wait; wc -l < on0; cat on1"], 30.0
    )
    on_vcan0, on_vcan1 = done.stdout.splitlines()
    assert on_vcan0 == "0"
    assert on_vcan1.endswith("vcan1 123#DEADBEEF")


def test_a_kernel_with_vcan_is_used_as_it_is(run_on_vcan: RunOnVcan) -> None:
    """On a machine that has the driver the buses are its own, in a network of their own."""
    code = (
        "from pathlib import Path\n"
        "from socketcan.vcan import find_launcher, program, run_in_namespace\n"
        "assert find_launcher() is run_in_namespace\n"
        "done = run_in_namespace(program('exchange.py', 'vcan1'), Path.cwd(), 60.0)\n"
        "print(done.stdout, end='')\n"
        "print(run_in_namespace(['sleep', '9'], Path.cwd(), 0.1).status)"
    )
    done = run_on_vcan([sys.executable, "-c", code], 60.0)
    assert done.stderr == ""
    assert done.stdout.splitlines() == [*map(describe, MESSAGES), "124"]


def test_a_program_that_hangs_is_ended(run_on_vcan: RunOnVcan) -> None:
    done = run_on_vcan(["sh", "-c", "echo started; sleep 100"], 1.0)
    assert (done.status, done.stdout) == (124, "started\n")


def test_a_failing_program_leaves_its_status_and_words(run_on_vcan: RunOnVcan) -> None:
    done = run_on_vcan(["sh", "-c", "echo bad >&2; exit 3"], 10.0)
    assert (done.status, done.stdout, done.stderr) == (3, "", "bad\n")


def test_the_deployed_script_makes_a_bus_and_may_be_run_again(run_on_vcan: RunOnVcan) -> None:
    """vcan9 is new, vcan2 was there, down and without CAN FD."""
    script = ROOT / "deploy/vcan.sh"
    done = run_on_vcan(
        ["sh", "-c", f"{script} vcan9 vcan2 && {script} vcan9 && cansend vcan2 123##0{'00' * 64}"],
        30.0,
    )
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        "vcan9 is up (CAN FD)",
        "vcan2 is up (CAN FD)",
        "vcan9 is up (CAN FD)",
    ]
    assert done.status == 0


def test_the_deployed_script_touches_no_other_interface(run_on_vcan: RunOnVcan) -> None:
    done = run_on_vcan([str(ROOT / "deploy/vcan.sh"), "lo"], 30.0)
    assert done.status == 1
    assert done.stderr == (
        "vcan.sh: lo is there and is not a virtual CAN interface; name another channel\n"
    )
