"""Errors of every target, summed by what the targets do: memory does not grow with their number.

Axes: W targets of a batch, K modes, H horizon steps, G groups.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eqrt.core.metrics import (
    brier_min_fde,
    calibration,
    displacement,
    horizons_s,
    least_ade,
    min_ade,
    min_fde,
    missed,
)
from eqrt.export.evaluation.manoeuvres import MANOEUVRES, SPEED_BANDS
from eqrt.training.evaluate import Predicted

Float64 = NDArray[np.float64]
Errors = Mapping[str, Float64]
"""Name -> (W,): metres; 1 or 0 for what is counted (`miss_rate`, `inside_*`); `nll` in nats."""

GROUPS = (
    ("all", "all"),
    *(("speed", band) for band in SPEED_BANDS),
    *(("manoeuvre", manoeuvre) for manoeuvre in MANOEUVRES),
)
"""The rows of a report: by what, and which."""
COMMON_MODES = 6
"""The number of modes that the field compares at."""


def mode_counts(num_modes: int) -> tuple[int, ...]:
    """Of how many modes, the most probable ones, the best is taken; none for a single mode."""
    return tuple(
        sorted({count for count in (min(COMMON_MODES, num_modes), num_modes) if count > 1})
    )


def errors_of(predicted: Predicted, truth: Float64, dt_s: float) -> dict[str, Float64]:
    """The errors of W targets, whose truth is (W, H, 2).

    `ade_*s`, `fde_*s` and `miss_rate` are those of the most probable mode; `*_K` of the best of the
    K most probable. Of covariances `nll`, `inside_50` and `inside_90`, of all K modes.
    docs/evaluation.md defines each.
    """
    trajectories, probabilities = predicted.trajectories, predicted.probabilities
    distance = displacement(trajectories, truth[:, None])  # (W, K, H)
    errors: dict[str, Float64] = {}
    for seconds in horizons_s(dt_s, truth.shape[1]):
        steps = round(seconds / dt_s)
        errors[f"ade_{seconds:g}s"] = distance[:, 0, :steps].mean(axis=1)
        errors[f"fde_{seconds:g}s"] = distance[:, 0, steps - 1]
    errors["miss_rate"] = missed(distance[:, :1]).astype(np.float64)
    for modes in mode_counts(distance.shape[1]):
        likeliest = distance[:, :modes]
        errors[f"min_ade_{modes}"] = min_ade(likeliest)
        errors[f"min_fde_{modes}"] = min_fde(likeliest)
        errors[f"least_ade_{modes}"] = least_ade(likeliest)
        errors[f"miss_rate_{modes}"] = missed(likeliest).astype(np.float64)
        errors[f"brier_min_fde_{modes}"] = brier_min_fde(likeliest, probabilities[:, :modes])
    if predicted.end_covariances is not None:
        errors |= calibration(trajectories, probabilities, predicted.end_covariances, truth)
    return errors


def end_errors(predicted: Predicted, truth: Float64, direction: Float64) -> dict[str, Float64]:
    """Where the most probable mode ends, as seen along the truth's own direction there (W, 2).

    `along` and `across` are lengths; `ahead` has a sign, and is positive where it ends too far on.
    """
    offset = predicted.trajectories[:, 0, -1] - truth[:, -1]
    ahead = (offset * direction).sum(axis=1)
    left = direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]
    return {"along": np.abs(ahead), "across": np.abs(left), "ahead": ahead}


def membership(speed_band: NDArray[np.intp], manoeuvre: NDArray[np.intp]) -> Float64:
    """(W, G) 1 where a target belongs to one of GROUPS, else 0; from indices (W,), (W,)."""
    return np.concatenate(
        [
            np.ones((len(speed_band), 1)),
            np.eye(len(SPEED_BANDS))[speed_band],
            np.eye(len(MANOEUVRES))[manoeuvre],
        ],
        axis=1,
    )


@dataclass(slots=True)
class Tally:
    """Counts and sums over targets, in each of GROUPS. Plain data: it crosses processes."""

    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(GROUPS), np.int64))
    """(G,) targets."""
    sums: dict[str, dict[str, Float64]] = field(default_factory=dict)
    """Predictor -> error -> (G,)."""

    def add(self, members: Float64, errors: Mapping[str, Errors]) -> None:
        """Take a batch: membership (W, G), and each predictor's errors of its targets."""
        self.counts += members.sum(axis=0).astype(np.int64)
        for predictor, table in errors.items():
            mine = self.sums.setdefault(predictor, {})
            for name, values in table.items():
                mine[name] = mine.get(name, np.zeros(len(GROUPS))) + values @ members

    def merge(self, other: Tally) -> None:
        """Take another tally's targets too."""
        self.counts += other.counts
        for predictor, table in other.sums.items():
            mine = self.sums.setdefault(predictor, {})
            for name, values in table.items():
                mine[name] = mine.get(name, np.zeros(len(GROUPS))) + values

    def means(self, group: int) -> dict[str, dict[str, float]]:
        """Predictor -> error -> mean over the targets of a group; none for an empty group."""
        count = int(self.counts[group])
        if not count:
            return {}
        return {
            predictor: {name: float(values[group]) / count for name, values in table.items()}
            for predictor, table in self.sums.items()
        }
