"""What the service says: the predictions of one cycle, with how they came about.

Publishers and recorders get this record and nothing else. Arrays share their first axis A (the
targets of the cycle); T steps of history; K modes, most probable first; H steps of `dt_s` to come.
Map frame, metres, seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2


class Mode(IntEnum):
    """How a cycle, or one target of it, was predicted; the numbers are those of `eqrt.dbc`.

    A target carries RUN, PARTIAL, LATE or FALLBACK, for this prediction of it. A cycle carries the
    gravest of SILENT, FALLBACK, NO_POSE, LATE and NO_MAP that holds, or held until just now
    (`eqrt.runtime.prediction.modes`), else RUN.
    """

    RUN = 0
    """The model's prediction, from full histories, a pose and a map."""
    NO_MAP = 1
    """No tile, or no lane of it near any target: the model was given no centerlines."""
    NO_POSE = 2
    """No ego motion is known (nothing is predicted), or no map pose (predicted without the map)."""
    PARTIAL = 3
    """The target has been seen for less than the model's history."""
    LATE = 4
    """Of a cycle: made later than one period after `received_s`, or some of its targets are late.

    Of a target: there was no time for the model; constant turn rate and velocity instead.
    """
    FALLBACK = 5
    """The model failed, or its output was impossible: constant turn rate and velocity instead."""
    SILENT = 6
    """No input for three periods: nothing is predicted, whatever was said before is void."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastSet:
    """The predictions of one cycle. Times are on the pipeline's clock."""

    cycle: int
    """Counts the cycles from 0, also those without targets."""
    timestamp_s: float
    """The newest measurement used, in SILENT the last that was; `map_from_ego` holds at this
    time."""
    received_s: float
    """When the cycle's last message came; NaN = nothing came (SILENT), or it is not told."""
    made_s: float
    """When the prediction was finished."""
    compute_s: float
    """How long it took; 0 when replaying, so that a log gives the same bytes twice."""
    mode: Mode
    model_id: str
    """The first digits of the model file's sha256, hexadecimal; empty without a model."""
    tile_id: str
    """Likewise of the tile; empty without a map."""
    map_from_ego: Pose2 | None
    """None = not known: then nothing is predicted."""
    ego_speed_mps: float
    """Of the ego reference point over ground, backwards negative; NaN = not known."""
    dt_s: float
    """Between steps: step h of a target is at `anchor_s + (h + 1) * dt_s`."""
    track_id: NDArray[np.int64]
    """(A,) never used twice while the service runs."""
    object_id: NDArray[np.int64]
    """(A,) as the sensor numbers it."""
    anchor_s: NDArray[np.float64]
    """(A,) time of the target's last measurement, from which it is predicted."""
    agent_mode: NDArray[np.uint8]
    """(A,) `Mode`."""
    position: NDArray[np.float64]
    """(A, 2) at `anchor_s`."""
    velocity: NDArray[np.float64]
    """(A, 2) m/s over ground at `anchor_s`: from the last second of `history`; where that has few
    steps as the sensor says, NaN = neither tells.
    """
    heading_rad: NDArray[np.float64]
    """(A,) as the sensor says, counter-clockwise from east, NaN = it does not."""
    object_class: NDArray[np.uint8]
    """(A,) `ObjectClass`."""
    length_m: NDArray[np.float64]
    """(A,) NaN = not known."""
    width_m: NDArray[np.float64]
    """(A,) NaN = not known."""
    history: NDArray[np.float64]
    """(A, T, 2) what the model was given: steps of `dt_s` up to `anchor_s`."""
    history_valid: NDArray[np.bool_]
    """(A, T) False = not seen; what `history` holds there means nothing."""
    trajectories: NDArray[np.float64]
    """(A, K, H, 2)"""
    probabilities: NDArray[np.float64]
    """(A, K) sum to 1."""
    covariances: NDArray[np.float64] | None = None
    """(A, K, H, 2, 2) square metres; None from a model that predicts none."""

    @property
    def num_targets(self) -> int:
        """A."""
        return len(self.track_id)

    @property
    def moment_s(self) -> float:
        """When what the cycle says held: at its newest measurement; in SILENT, which has none and
        repeats the last, when it was said.
        """
        return self.made_s if self.mode is Mode.SILENT else self.timestamp_s

    @property
    def age_s(self) -> NDArray[np.float64]:
        """(A,) how old each target's last measurement was when the prediction was finished."""
        return self.made_s - self.anchor_s

    @property
    def is_standstill_assumed(self) -> NDArray[np.bool_]:
        """(A,) the target was just found, and its velocity is not known: `trajectories` stay at
        `position`, which says nothing.
        """
        return np.asarray(np.isnan(self.velocity).any(axis=1))

    def targets(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> ForecastSet:
        """The same cycle with only some of its targets."""
        chosen = {name: getattr(self, name)[rows] for name in _OF_TARGETS}
        covariances = None if self.covariances is None else self.covariances[rows]
        return replace(self, covariances=covariances, **chosen)


def pose_numbers(pose: Pose2 | None) -> tuple[float, float, float]:
    """A pose as formats have it: x and y in m, yaw in rad, all NaN = not known."""
    return (pose.x_m, pose.y_m, pose.yaw_rad) if pose is not None else (math.nan,) * 3


def pose_of(numbers: tuple[float, float, float]) -> Pose2 | None:
    """The pose that `pose_numbers` wrote."""
    return None if any(map(math.isnan, numbers)) else Pose2(*numbers)


_OF_TARGETS = (
    "track_id",
    "object_id",
    "anchor_s",
    "agent_mode",
    "position",
    "velocity",
    "heading_rad",
    "object_class",
    "length_m",
    "width_m",
    "history",
    "history_valid",
    "trajectories",
    "probabilities",
)
