"""deploy/ under the systemd that it is written for: installed, struck, stopped."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from booted.machine import missing, run_beside_systemd
from drives import DRIVES, first_seconds
from socketcan.vcan import program

DYNAMIC_USERS = range(61184, 65520)  # systemd.exec(5), DynamicUser=
WELL = {"ActiveState": "active", "Result": "success", "ExecMainStatus": "0"}
SOME = range(1, 21)
"""Cycles, of the 20 that are played: a busy machine is too slow for the rest."""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What was seen from the installation to the end."""
    if lacking := missing():
        if os.environ.get("CI"):
            pytest.fail(f"{lacking} not found")
        pytest.skip(f"{lacking} not found")
    work = tmp_path_factory.mktemp("booted")
    (work / "part.log").write_text(first_seconds(DRIVES["ngsim"].log, 2.0))
    life = Path(__file__).parent / "programs/unit_life.py"
    done = run_beside_systemd(program(str(life), "part.log"), work, 300.0)
    assert done.status == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_it_is_installed_as_the_readme_says_and_has_no_rights(found: dict[str, Any]) -> None:
    """It has started when `enable --now` returns, as a user that nobody else is."""
    installed = found["installed"]
    status, said = installed["enabled"]
    assert status == 0, said
    assert {name: installed[name] for name in WELL} == WELL
    assert installed["user"] in DYNAMIC_USERS
    assert int(installed["CapEff"], 16) == 0
    assert installed["NoNewPrivs"] == "1"
    assert installed["Seccomp"] == "2"  # a filter


def test_it_predicts_on_can_and_is_heard_over_loopback(found: dict[str, Any]) -> None:
    heard = found["over_loopback"]
    assert heard["predicted"] in SOME
    assert heard["datagrams"] >= heard["predicted"]
    assert heard["counted"] in SOME
    assert "messages/s" in found["status_text"]  # the status line


def test_reload_waits_until_a_tile_is_exchanged_or_refused(found: dict[str, Any]) -> None:
    """The journal has the outcome when `systemctl reload` returns; the process stays."""
    damaged, right = found["reloaded"]["damaged"], found["reloaded"]["right"]
    for step in (damaged, right):
        assert step["reload"] == [0, ""]
        assert {name: step[name] for name in WELL} == WELL
    (failed,) = (line for line in damaged["said"] if "reload failed, tile and model stay" in line)
    assert "not a tile" in failed
    assert sum(line.startswith("reloaded: ") for line in right["said"]) == 1
    assert found["reloaded"]["same"]
    assert found["predicted_after_reload"] in SOME


def test_whoever_hangs_or_is_killed_is_started_again(found: dict[str, Any]) -> None:
    """The watchdog takes five seconds and what it began with, a start one and what it takes."""
    assert not found["hung"]["same"]
    assert not found["killed"]["same"]
    assert found["hung"]["seconds"] > 2.0
    assert found["predicted_after_restarts"] in SOME


def test_it_stops_well_and_leaves_its_recordings(found: dict[str, Any]) -> None:
    """In the service's own folder, which systemd makes; a start that is killed at once has none."""
    stopped = found["stopped"]
    assert stopped["stop"] == [0, ""]
    assert stopped["seconds"] < 5.0
    assert (stopped["ActiveState"], stopped["Result"]) == ("inactive", "success")
    assert len(stopped["recordings"]) in (2, 3)
    assert min(stopped["recordings"]) > 1000
    assert len(found["stopped_again"]["recordings"]) == len(stopped["recordings"]) + 1


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("misspelt", "unknown key 'out_nodes' in [serve]; did you mean 'out_modes'?"),
        ("without_rights", "cpus 0: refused (Operation not permitted); give SystemCallFilter="),
        ("without_rights", "priority 40: refused"),
        ("without_rights", "give LimitMEMLOCK=infinity in the unit"),
    ],
)
def test_a_wrong_configuration_is_not_tried_again(
    found: dict[str, Any], what: str, said: str
) -> None:
    refused = found[what]
    assert refused["start"] == 1
    assert (refused["ActiveState"], refused["ExecMainStatus"]) == ("failed", "2")
    assert refused["restarts"] == "0"
    assert said in refused["said"]


def test_realtime_conf_gives_the_rights_that_its_settings_need(found: dict[str, Any]) -> None:
    settings = found["in_real_time"]
    assert settings["restart"] == [0, ""]
    assert {name: settings[name] for name in WELL} == WELL
    assert settings["is_fifo"]
    assert settings["priority"] == 40
    assert settings["cores"] == [0]
    assert settings["locked_kib"] > 0
    assert found["predicted_in_real_time"] in SOME
