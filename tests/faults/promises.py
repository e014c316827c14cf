"""What holds for everything that the service says, whatever comes in."""

from __future__ import annotations

import math

import numpy as np

from eqrt.core.kinematics import FIT_STEPS
from eqrt.runtime.decoding.latency_checks import MAX_INPUT_AGE_S
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import SILENT_PERIODS, TARGET_AGE_S

AGENT_MODES = {Mode.RUN, Mode.PARTIAL, Mode.LATE, Mode.FALLBACK}
_REACH_M = 100.0 * 3.1 + 2.0  # what the fastest object can cover in the horizon
_TICK_S = 0.011  # how often the service looks at the clock


class Promises:
    """Looks at every forecast as it is made; fails as soon as one breaks a promise."""

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._cycle = -1
        self._heard_s = math.inf  # nothing has been said yet
        self.seen = 0

    def look(self, forecast: ForecastSet, now_s: float) -> None:
        """At a forecast made at `now_s`, the pipeline's clock."""
        self.seen += 1
        assert forecast.cycle == self._cycle + 1, "the cycles are counted without a gap"
        self._cycle, self._heard_s = forecast.cycle, now_s
        sound(forecast)
        assert forecast.made_s >= now_s - 1e-9, "made before it was asked for"
        if forecast.mode is Mode.SILENT:
            assert forecast.num_targets == 0, "silence predicts nothing"
        else:
            age_s = now_s - forecast.timestamp_s
            assert -1e-6 <= age_s <= MAX_INPUT_AGE_S, f"input {age_s:.3f} s old passes for new"

    def tick(self, now_s: float) -> None:
        """Time passes: once something was said, there is never silence without saying so."""
        quiet_s = now_s - self._heard_s
        assert quiet_s <= SILENT_PERIODS * self._dt_s + 2 * _TICK_S, f"{quiet_s:.3f} s unsaid"

    def clock_was_set(self, now_s: float) -> None:
        """It is `now_s`, and no time has passed."""
        self._heard_s = now_s if self.seen else math.inf


def sound(forecast: ForecastSet) -> None:
    """Finite, ids unique, probabilities sorted, nothing stale, nothing out of this world."""
    assert len(set(forecast.track_id.tolist())) == forecast.num_targets
    assert set(forecast.agent_mode.tolist()) <= AGENT_MODES
    for values in (forecast.position, forecast.trajectories):
        assert np.isfinite(values).all()
    assert not np.isinf(forecast.velocity).any()
    seen_more = forecast.history_valid[:, -FIT_STEPS:].sum(axis=1) > 1
    assert np.isfinite(forecast.velocity[seen_more]).all()
    assert (np.diff(forecast.probabilities, axis=1) <= 0.0).all()
    np.testing.assert_allclose(forecast.probabilities.sum(axis=1), 1.0, atol=1e-3)
    assert (forecast.age_s >= -1e-6).all()
    behind_s = forecast.timestamp_s - forecast.anchor_s
    assert ((behind_s >= -1e-6) & (behind_s <= TARGET_AGE_S + 1e-6)).all()
    reach_m = np.linalg.norm(forecast.trajectories - forecast.position[:, None, None], axis=-1)
    assert reach_m.max(initial=0.0) < _REACH_M
