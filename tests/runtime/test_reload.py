"""SIGHUP: another tile and model, exchanged between two cycles; a bad one changes nothing."""

from __future__ import annotations

import math
import os
import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import can
import numpy as np
import pytest

from drives import TILE, Car, cycle, shipped_predictor, traffic
from eqrt.core.frames import Pose2
from eqrt.core.tile import encode
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import Pipeline, lanes_for
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.prediction.tiles import Tile, load_tile, save_tile
from handmade_model import CONTRACT, write_handmade
from processes import PATIENCE_S, Heard, Serving

CARS = [Car(object_id=1, x_m=0.0, y_m=0.0), Car(object_id=2, x_m=20.0, y_m=4.0)]
SLOW = [replace(car, speed_mps=0.5) for car in CARS]
"""They stay where there are lanes for as long as a test takes."""
X_M, Y_M = load_tile(TILE).lane_map.points[0].tolist()
POSE = Pose2(X_M, Y_M, 0.0)
"""Where there are lanes."""


def other_tile(folder: Path, **info: object) -> Path:
    """The demo's tile under another name, so with another id."""
    tile = load_tile(TILE)
    path = folder / "other.tile"
    save_tile(path, encode(tile.lane_map, replace(tile.info, name="other", **info)))  # type: ignore[arg-type]  # its own fields
    return path


def said(pipeline: Pipeline, messages: Iterator[can.Message]) -> list[ForecastSet]:
    return [made for m in messages for made in pipeline.feed(m, m.timestamp)]


def exchanged(pipeline: Pipeline, predictor: Predictor, tile: Tile | None) -> None:
    pipeline.exchange(predictor, tile, lanes_for(tile, predictor))


# --- in the pipeline


def test_an_exchange_keeps_tracks_and_histories(tmp_path: Path) -> None:
    """A model of other sizes and another tile, in the middle of a drive: not one cycle is worse."""
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), load_tile(TILE))
    before = said(pipeline, traffic(CARS, 3.0, pose=POSE))
    handmade = Predictor.load(write_handmade(tmp_path / "model"))
    exchanged(pipeline, handmade, load_tile(other_tile(tmp_path)))
    (after,) = said(pipeline, iter(cycle(CARS, 3.1, pose=POSE)))
    assert after.cycle == before[-1].cycle + 1
    assert (before[-1].mode, after.mode) == (Mode.RUN, Mode.RUN)
    assert set(after.agent_mode) == {Mode.RUN}
    assert after.track_id.tolist() == before[-1].track_id.tolist()
    assert after.model_id == handmade.model_id != before[-1].model_id
    assert after.tile_id == load_tile(tmp_path / "other.tile").info.tile_id != before[-1].tile_id
    assert after.trajectories.shape == (2, CONTRACT.num_modes, CONTRACT.horizon_steps, 2)
    assert after.history.shape[1] == CONTRACT.history_steps
    ahead = after.trajectories[:, 0, -1] - after.position
    np.testing.assert_allclose(np.linalg.norm(ahead, axis=-1), 10.0, atol=0.2)  # 1 s at 10 m/s
    (nobody,) = said(pipeline, iter(cycle([], 9.0, pose=POSE)))
    assert nobody.trajectories.shape == (0, CONTRACT.num_modes, CONTRACT.horizon_steps, 2)


def test_lanes_are_those_of_the_new_tile(tmp_path: Path) -> None:
    """Without lanes near the cars, the model predicts what it predicts without a map."""
    tile = load_tile(TILE)
    far = replace(tile.lane_map, points=tile.lane_map.points + np.float32(5e4))
    path = tmp_path / "far.tile"
    save_tile(path, encode(far, tile.info))
    ends = []
    for first, then in ((TILE, None), (TILE, path), (path, None), (path, TILE)):
        pipeline = Pipeline(load_profile("generic"), shipped_predictor(), load_tile(first))
        said(pipeline, traffic(CARS, 3.0, pose=POSE))
        if then:
            exchanged(pipeline, shipped_predictor(), load_tile(then))
        (after,) = said(pipeline, iter(cycle(CARS, 3.1, pose=POSE)))
        ends.append(after.trajectories)
    assert not np.allclose(ends[0], ends[1], atol=1e-3)
    np.testing.assert_allclose(ends[1], ends[2], atol=1e-9)
    np.testing.assert_allclose(ends[0], ends[3], atol=1e-9)


def test_poses_in_map_coordinates_do_not_care_where_the_tile_says_its_origin_is(
    tmp_path: Path,
) -> None:
    """They come as x and y: the map frame is that of whoever sends them."""
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), load_tile(TILE))
    said(pipeline, traffic(CARS, 3.0, pose=POSE))
    elsewhere = other_tile(tmp_path, origin_latitude_deg=1.0, origin_longitude_deg=2.0)
    exchanged(pipeline, shipped_predictor(), load_tile(elsewhere))
    (after,) = said(pipeline, iter(cycle(CARS, 3.1, pose=POSE)))
    assert (after.mode, set(after.agent_mode)) == (Mode.RUN, {Mode.RUN})


@pytest.fixture
def geodetic(tmp_path: Path) -> Callable[[float, float], Pipeline]:
    """A pipeline on the built-in INS profile, with the demo's tile at an origin."""

    def made(latitude_deg: float, longitude_deg: float) -> Pipeline:
        folder = tmp_path / f"{latitude_deg}-{longitude_deg}"
        folder.mkdir()
        at = other_tile(
            folder, origin_latitude_deg=latitude_deg, origin_longitude_deg=longitude_deg
        )
        return Pipeline(load_profile("sbg-ins"), shipped_predictor(), load_tile(at))

    return made


def test_another_origin_of_the_map_begins_the_places_anew(
    geodetic: Callable[[float, float], Pipeline],
) -> None:
    """Of poses by latitude and longitude; the same origin changes nothing."""
    pipeline = geodetic(48.0, 11.0)
    epoch, tile = pipeline.ego.epoch, pipeline.tile
    exchanged(pipeline, shipped_predictor(), tile)
    assert pipeline.ego.epoch == epoch
    exchanged(pipeline, shipped_predictor(), geodetic(48.0, 11.5).tile)
    assert pipeline.ego.epoch == epoch + 1
    exchanged(pipeline, shipped_predictor(), None)
    assert pipeline.ego.epoch == epoch + 2


# --- in a process


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
