"""Another tile and model for a pipeline, exchanged between two cycles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from drives import TILE, cycle, shipped_predictor, traffic
from eqrt.core.tile import encode
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import Pipeline, lanes_for
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.runtime.prediction.tiles import Tile, load_tile, save_tile
from handmade_model import CONTRACT, write_handmade
from steady_model import CONTRACT as STEADY
from steady_model import Steady
from tiny_sensor import EGO, message, profile_of
from two_tiles import CARS, POSE, other_tile


def said(pipeline: Pipeline, messages: Iterable[can.Message]) -> list[ForecastSet]:
    return [made for m in messages for made in pipeline.feed(m, m.timestamp)]


def exchanged(pipeline: Pipeline, predictor: Predictor, tile: Tile | None) -> None:
    pipeline.exchange(predictor, tile, lanes_for(tile, predictor))


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


def test_a_model_of_longer_histories_gets_them_as_they_come() -> None:
    """Five seconds at 20 Hz, after a model that reads half a second."""
    pipeline = Pipeline(load_profile("generic"), Steady())
    longer = Steady(replace(STEADY, history_steps=50, dt_s=0.1))
    pipeline.exchange(longer, None, None)
    steps = [m for step in range(101) for m in cycle(CARS, step / 20)]
    modes = [set(forecast.agent_mode.tolist()) for forecast in said(pipeline, steps)]
    assert modes == [{Mode.PARTIAL}] * 49 + [{Mode.RUN}] * 2


@pytest.mark.parametrize(("steps", "dt_s"), [(50, 0.1), (25, 0.2)])
def test_the_first_model_gets_histories_as_long_as_it_reads(steps: int, dt_s: float) -> None:
    """Five seconds at 24 Hz, the rate of which most measurements are kept."""
    model = Steady(replace(STEADY, history_steps=steps, dt_s=dt_s))
    pipeline = Pipeline(load_profile("generic"), model)
    forecasts = said(pipeline, (m for step in range(121) for m in cycle(CARS, step / 24)))
    modes = [set(forecast.agent_mode.tolist()) for forecast in forecasts]
    assert modes[0] == {Mode.PARTIAL}
    assert modes[-1] == {Mode.RUN}


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


GEODETIC = """
description = "poses by latitude and longitude, to a tenth of a degree"

[[ego]]
bus = "car"
dbc = "tiny.dbc"
messages = { pose = "EGO" }

[ego.fields]
latitude = { signal = "pose.LEFT", unit = "deg" }
longitude = { signal = "pose.RIGHT", unit = "deg" }
heading = { signal = "pose.YAW_RATE", unit = "deg" }
"""


@pytest.fixture
def geodetic(tmp_path: Path) -> Callable[[float, float], Pipeline]:
    """A pipeline whose poses come as latitude and longitude, with the demo's tile at an origin."""

    def made(latitude_deg: float, longitude_deg: float) -> Pipeline:
        folder = tmp_path / f"{latitude_deg}-{longitude_deg}"
        folder.mkdir()
        at = other_tile(
            folder, origin_latitude_deg=latitude_deg, origin_longitude_deg=longitude_deg
        )
        return Pipeline(profile_of(folder, GEODETIC), shipped_predictor(), load_tile(at))

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
    exchanged(pipeline, shipped_predictor(), tile)
    assert pipeline.ego.epoch == epoch + 3


def test_the_origin_is_that_of_the_tile_from_the_start_and_after_an_exchange(
    geodetic: Callable[[float, float], Pipeline],
) -> None:
    """48 degrees north, 11.5 east: half a degree from the first one, none from the second."""
    here = message(EGO, (480).to_bytes(2, "little") + (115).to_bytes(2, "little") + bytes(4))
    pipeline = geodetic(48.0, 11.0)
    east_m = []
    for step, tile in enumerate([None, geodetic(48.0, 11.5).tile, geodetic(48.0, 11.25).tile]):
        if tile is not None:
            exchanged(pipeline, shipped_predictor(), tile)
        for now_s in (step, step + 0.1):
            pipeline.feed(here, now_s)
        place = pipeline.ego.map_from_ego(step + 0.1)
        assert place is not None
        east_m.append(place.x_m)
    np.testing.assert_allclose(east_m, [37_300.0, 0.0, 18_650.0], atol=50.0)


def test_a_map_that_is_nowhere_on_earth_has_no_place_for_latitudes_and_longitudes(
    geodetic: Callable[[float, float], Pipeline],
) -> None:
    """The first pose is not its origin: its lanes would lie anywhere."""
    here = message(EGO, (480).to_bytes(2, "little") + (115).to_bytes(2, "little") + bytes(4))
    pipeline = geodetic(math.nan, math.nan)
    for now_s in (0.0, 0.1):
        pipeline.feed(here, now_s)
    assert pipeline.ego.map_from_ego(0.1) is None
    epoch = pipeline.ego.epoch
    exchanged(pipeline, shipped_predictor(), pipeline.tile)
    assert pipeline.ego.epoch == epoch
