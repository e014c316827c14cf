"""What leaves the pipeline is sound, whatever comes in: recorded drives, alone and amid noise."""

from __future__ import annotations

import can
import numpy as np
import pytest

from drives import DRIVES, Drive, first_seconds, shipped_predictor
from eqrt.core.kinematics import FIT_STEPS
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay


def pipeline_of(drive: Drive) -> Pipeline:
    tile = load_tile(drive.tile) if drive.tile else None
    return Pipeline(load_profile(drive.profile), shipped_predictor(), tile)


@pytest.mark.parametrize("name", DRIVES)
def test_what_leaves_the_pipeline_is_always_sound(name: str) -> None:
    """Ids are unique, numbers finite, probabilities sum to one, nothing is from the future."""
    drive = DRIVES[name]
    messages = [candump_message(line) for line in first_seconds(drive.log, 8.0).splitlines()]
    pipeline = pipeline_of(drive)
    targets = [assert_sound(forecast) for forecast in replay(pipeline, messages)]
    assert sum(targets) == pipeline.counters.targets > 100


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("seed", range(2))
def test_no_message_breaks_the_pipeline(name: str, seed: int) -> None:
    """Real ones between messages of the profile's ids with random bytes, lengths and kinds."""
    drive, random = DRIVES[name], np.random.default_rng(seed)
    ids = sorted(load_profile(drive.profile).arbitration_ids)
    lines = first_seconds(drive.log, 3.0).splitlines()
    pipeline = pipeline_of(drive)
    fed = 0
    for line in lines:
        message = candump_message(line)
        for noise in (random_message(ids, random) for _ in range(int(random.integers(0, 3)))):
            for forecast in pipeline.feed(noise, message.timestamp):
                assert_sound(forecast)
            fed += 1
            if fed > 3000:
                return
        for forecast in [
            *pipeline.poll(message.timestamp),
            *pipeline.feed(message, message.timestamp),
        ]:
            assert_sound(forecast)


def random_message(ids: list[int], random: np.random.Generator) -> can.Message:
    is_fd = bool(random.random() < 0.1)
    return can.Message(
        arbitration_id=int(random.choice(ids)),
        is_extended_id=bool(random.random() < 0.1),
        is_remote_frame=not is_fd and bool(random.random() < 0.1),
        is_error_frame=not is_fd and bool(random.random() < 0.1),
        is_fd=is_fd,
        data=random.bytes(int(random.integers(0, 65 if is_fd else 9))),
        check=False,
    )


def assert_sound(forecast: ForecastSet) -> int:
    assert len(set(forecast.track_id.tolist())) == forecast.num_targets
    for values in (forecast.position, forecast.trajectories):
        assert np.isfinite(values).all()
    assert not np.isinf(forecast.velocity).any()
    seen_more = forecast.history_valid[:, -FIT_STEPS:].sum(axis=1) > 1
    assert np.isfinite(forecast.velocity[seen_more]).all()
    assert (np.diff(forecast.probabilities, axis=1) <= 0.0).all()
    np.testing.assert_allclose(forecast.probabilities.sum(axis=1), 1.0, atol=1e-3)
    assert (forecast.age_s >= -1e-6).all()
    reach_m = np.linalg.norm(forecast.trajectories - forecast.position[:, None, None], axis=-1)
    assert reach_m.max(initial=0.0) < 90.0 * 3.1 + 2.0
    return forecast.num_targets
