"""Forecasts to publish: one whose every number is known, and many at random."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.output.forecasts import ForecastSet, Mode

T, H, K, DT_S = 20, 30, 2, 0.1
PAST_M = 10.0 * DT_S * np.arange(1 - T, 1)


def one_car() -> ForecastSet:
    """The ego vehicle at (100, 200) m faces north; a car 20 m ahead drives north at 10 m/s.

    Mode 0 goes on like that. Mode 1 stays where it is. Both are of the same prediction, which was
    finished 12 ms after the newest measurement and 50 ms after that of the car.
    """
    ahead_m = 10.0 * DT_S * np.arange(1, H + 1)
    north = np.stack([np.full(H, 100.0), 220.0 + ahead_m], axis=-1)
    stay = np.tile([100.0, 220.0], (H, 1))
    return ForecastSet(
        cycle=300,
        timestamp_s=1000.0,
        received_s=1000.003,
        made_s=1000.012,
        compute_s=0.0081,
        mode=Mode.NO_MAP,
        model_id="0123456789ab",
        tile_id="",
        map_from_ego=Pose2(100.0, 200.0, math.pi / 2),
        ego_speed_mps=8.0,
        dt_s=DT_S,
        track_id=np.array([65_537]),
        object_id=np.array([17]),
        anchor_s=np.array([999.962]),
        agent_mode=np.array([Mode.PARTIAL], np.uint8),
        position=np.array([[100.0, 220.0]]),
        velocity=np.array([[0.0, 10.0]]),
        heading_rad=np.array([math.pi / 2]),
        object_class=np.array([ObjectClass.CAR], np.uint8),
        length_m=np.array([4.5]),
        width_m=np.array([np.nan]),
        history=np.stack([np.full(T, 100.0), 220.0 + PAST_M], axis=-1)[None],
        history_valid=np.arange(T)[None] >= T - 7,
        trajectories=np.stack([north, stay])[None],
        probabilities=np.array([[0.75, 0.25]]),
    )


def nobody(mode: Mode = Mode.SILENT) -> ForecastSet:
    """A cycle without targets."""
    return replace(one_car(), mode=mode).targets(slice(0))


def many(count: int, num_modes: int = 6, horizon: int = H, seed: int = 0) -> ForecastSet:
    """`count` targets within some 200 m of an ego vehicle that is 7 km from the map's origin."""
    random = np.random.default_rng(seed)
    ego = Pose2(4321.5, -5678.25, 1.1)
    position = random.uniform(-200.0, 200.0, (count, 2)) + np.array([ego.x_m, ego.y_m])
    steps = random.normal(0.0, 2.0, (count, num_modes, horizon, 2))
    probabilities = -np.sort(-random.dirichlet(np.ones(num_modes), count))
    return ForecastSet(
        cycle=7,
        timestamp_s=50.0,
        received_s=50.0005,
        made_s=50.009,
        compute_s=0.0085,
        mode=Mode.RUN,
        model_id="89abcdef0123",
        tile_id="fedcba98",
        map_from_ego=ego,
        ego_speed_mps=13.5,
        dt_s=DT_S,
        track_id=np.arange(1000, 1000 + count),
        object_id=np.arange(count) % 256,
        anchor_s=50.0 - random.uniform(0.0, 0.3, count),
        agent_mode=random.choice([Mode.RUN, Mode.PARTIAL, Mode.FALLBACK], count).astype(np.uint8),
        position=position,
        velocity=random.normal(0.0, 15.0, (count, 2)),
        heading_rad=random.uniform(-math.pi, math.pi, count),
        object_class=random.integers(0, 8, count).astype(np.uint8),
        length_m=random.uniform(1.0, 15.0, count),
        width_m=random.uniform(0.5, 2.5, count),
        history=position[:, None] + random.normal(0.0, 20.0, (count, T, 2)),
        history_valid=np.ones((count, T), np.bool_),
        trajectories=position[:, None, None] + steps.cumsum(axis=2),
        probabilities=probabilities,
    )
