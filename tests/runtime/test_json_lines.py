"""Forecasts as lines of JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from eqrt.runtime.output.json_lines import json_lines
from forecast_sets import many, nobody, one_car


def test_a_line_reads_as_the_prediction() -> None:
    (line,) = json_lines(one_car()).splitlines()
    values = json.loads(line)
    trajectories = values.pop("trajectories")
    assert values == {
        "cycle": 300,
        "time_s": 1000.0,
        "cycle_mode": "NO_MAP",
        "model_id": "0123456789ab",
        "tile_id": "",
        "track_id": 65_537,
        "object_id": 17,
        "mode": "PARTIAL",
        "anchor_s": 999.962,
        "age_s": 0.05,
        "dt_s": 0.1,
        "position": [100.0, 220.0],
        "velocity": [0.0, 10.0],
        "probabilities": [0.75, 0.25],
    }
    assert np.shape(trajectories) == (2, 30, 2)
    assert trajectories[0][0] == [100.0, 221.0]
    assert trajectories[1][29] == [100.0, 220.0]


def test_there_is_a_line_for_every_target() -> None:
    forecasts = many(32)
    lines = [json.loads(line) for line in json_lines(forecasts).splitlines()]
    assert [line["track_id"] for line in lines] == forecasts.track_id.tolist()
    assert json_lines(nobody()) == b""


def test_values_are_rounded_to_a_millimetre() -> None:
    """So is what is no longer than a millimetre: minus nothing is nothing."""
    position = np.array([[-0.0004, 1234567.8916]])
    (line,) = json_lines(replace(one_car(), position=position)).splitlines()
    assert b'"position":[0.0,1234567.892]' in line


def test_an_unknown_velocity_is_null() -> None:
    (line,) = json_lines(replace(one_car(), velocity=np.full((1, 2), np.nan))).splitlines()
    assert json.loads(line)["velocity"] == [None, None]


def test_covariances_are_told_where_the_model_predicts_them() -> None:
    forecasts = many(3)
    roots = np.random.default_rng(1).uniform(0.1, 2.0, (*forecasts.trajectories.shape, 2))
    spread = roots @ roots.mT
    spread[1] = np.nan  # of a target that physics predicts
    lines = json_lines(replace(forecasts, covariances=spread)).splitlines()
    first, second, third = (json.loads(line)["covariances"] for line in lines)
    assert second is None
    for told, true in ((first, spread[0]), (third, spread[2])):
        halves = np.stack([true[..., 0, 0], true[..., 0, 1], true[..., 1, 1]], -1)
        np.testing.assert_allclose(np.array(told), halves, atol=5.1e-5, rtol=0)
    assert [*json.loads(lines[0])][-2:] == ["trajectories", "covariances"]
    assert b"covariances" not in json_lines(replace(forecasts, covariances=None))
