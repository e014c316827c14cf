"""SIGHUP: another tile and model, exchanged between two cycles; a bad one changes nothing."""

from __future__ import annotations

import math
import os
import re
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from io import StringIO
from itertools import pairwise
from pathlib import Path

import can

from drives import TILE, cycle, shipped_predictor
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.operation.event_log import EventLog
from eqrt.runtime.operation.reload import Reloader
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.prediction.protobuf import nested, text
from handmade_model import CONTRACT, sign, write_handmade
from processes import PATIENCE_S, Heard, Serving
from two_tiles import CARS, POSE, other_tile

SLOW = [replace(car, speed_mps=0.5) for car in CARS]
"""They stay where there are lanes for as long as a test takes."""


class Driving:
    """Cars on the local bus, ten cycles a second, for as long as the block lasts."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self.cycles = 0

    def until(self, done: Callable[[], bool]) -> None:
        give_up_s = time.monotonic() + PATIENCE_S
        due_s = time.monotonic()
        while not done():
            assert time.monotonic() < give_up_s
            for message in cycle(SLOW, self.cycles / 10, pose=POSE):
                self._bus.send(message)
            self.cycles += 1
            due_s += 0.1
            time.sleep(max(0.0, due_s - time.monotonic()))


def test_a_running_service_exchanges_tile_and_model_without_missing_a_cycle(
    tmp_path: Path,
) -> None:
    """First the tile, then a bad tile, then a model whose sizes are others; always under load."""
    channel = f"reload-{time.monotonic_ns()}"
    tile, model = tmp_path / "town.tile", tmp_path / "model"
    shutil.copy(TILE, tile)
    shutil.copytree(DEFAULT_ARTIFACT, model)
    paths = ["--tile", str(tile), "--model", str(model)]
    with (
        Heard(channel, []) as heard,
        Serving(
            "--can", channel, "--can-interface", LOCAL, "--profile", "generic", *paths,
            "--datagrams", heard.address, "--quiet",
        ) as service,
        open_bus(channel, LOCAL, receive_ids=[]) as bus,
    ):  # fmt: skip
        drive = Driving(bus)

        def now(name: str) -> str:
            return str(getattr(heard.forecasts[-1], name)) if heard.forecasts else ""

        drive.until(lambda: len(heard.forecasts) > 30)
        first_tile, first_model = now("tile_id"), now("model_id")

        os.replace(other_tile(tmp_path), tile)
        os.kill(service.pid, signal.SIGHUP)
        drive.until(lambda: now("tile_id") != first_tile)
        second_tile = now("tile_id")

        tile.write_bytes(tile.read_bytes()[:-1])
        os.kill(service.pid, signal.SIGHUP)
        still = len(heard.forecasts) + 10
        drive.until(lambda: len(heard.forecasts) >= still)
        assert now("tile_id") == second_tile

        other_tile(tmp_path).replace(tile)
        shutil.rmtree(model)
        write_handmade(model)
        os.kill(service.pid, signal.SIGHUP)
        drive.until(lambda: now("model_id") != first_model)
        still = len(heard.forecasts) + 10
        drive.until(lambda: len(heard.forecasts) >= still)
        status, stdout, stderr = service.end()
    assert (status, stderr) == (0, "")
    *_, after = no_cycle_was_missed(heard.forecasts, drive.cycles)
    assert (after.tile_id, after.history.shape[1]) == (second_tile, CONTRACT.history_steps)
    assert math.isclose(after.dt_s, CONTRACT.dt_s)
    events = re.sub(r"\d\d:\d\d:\d\d ", "", stdout)
    assert f"reloaded: model eqrt-free {first_model}, tile {second_tile}, before" in events
    assert "error: reload failed, tile and model stay: " in events
    assert "reloaded: model handmade " in events


def no_cycle_was_missed(forecasts: Sequence[ForecastSet], sent: int) -> list[ForecastSet]:
    """The cycles of the input; across each of two exchanges, every track goes on."""
    cycles = [one for one in forecasts if one.mode is not Mode.SILENT]
    assert [one.cycle for one in forecasts] == list(range(len(forecasts)))
    assert sent - 1 <= len(cycles) <= sent
    swaps = [
        (old, new)
        for old, new in pairwise(cycles)
        if (old.tile_id, old.model_id) != (new.tile_id, new.model_id) and old.num_targets
    ]
    assert len(swaps) == 2
    for old, new in swaps:
        assert new.track_id.tolist() == old.track_id.tolist()
    return cycles


def test_a_reload_of_the_same_files_says_that_nothing_changed() -> None:
    channel = f"reload-{time.monotonic_ns()}"
    with Serving(
        "--can", channel, "--can-interface", LOCAL, "--profile", "generic", "--tile", str(TILE)
    ) as service:  # fmt: skip
        os.kill(service.pid, signal.SIGHUP)
        time.sleep(0.5)
        status, stdout, stderr = service.end()
    assert (status, stderr) == (0, "")
    assert "reloaded: unchanged, model eqrt-free " in stdout


def test_a_model_that_may_not_be_sold_is_said_to_be_one_when_it_is_taken(tmp_path: Path) -> None:
    """As at the start of a service; the one before could be."""
    model = write_handmade(tmp_path / "model")
    with (model / "model.onnx").open("ab") as stream:
        stream.write(nested(14, text(1, "non_commercial") + text(2, "true")))
    sign(model)
    pipeline, lines = Pipeline(load_profile("generic"), shipped_predictor()), StringIO()
    log, told = EventLog(stream=lines), list[bool]()
    reload = Reloader(pipeline, model, None, is_asked=lambda: True, log=log, tell=told.append)
    give_up_s = time.monotonic() + PATIENCE_S
    while told != [True, False]:
        assert time.monotonic() < give_up_s
        reload()
    assert pipeline.predictor.contract.name == "handmade"
    assert "warning: model licence: " in lines.getvalue()
    assert lines.getvalue().endswith(", non-commercial (handmade)\n")
