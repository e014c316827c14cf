"""The agents that one cycle predicts, each with its history up to its own last measurement."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.scene import AgentHistories
from eqrt.runtime.tracking.tracks import Tracks

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Targets:
    """B targets; map frame, metres, seconds; NaN = not known."""

    track_id: NDArray[np.int64]
    object_id: NDArray[np.int64]
    anchor_s: Float64
    velocity: Float64
    """(B, 2) m/s over ground as measured."""
    heading_rad: Float64
    object_class: NDArray[np.uint8]
    length_m: Float64
    width_m: Float64
    history: Float64
    """(B, T, 2) the last step is a measurement."""
    valid: Bool
    """(B, T)"""

    @classmethod
    def of(cls, tracks: Tracks, agents: AgentHistories, rows: NDArray[np.intp]) -> Targets:
        """The tracks `rows`, on the clock of `agents`."""
        return cls(
            track_id=tracks.track_id[rows],
            object_id=tracks.object_id[rows],
            anchor_s=tracks.timestamp_s[rows],
            velocity=tracks.velocity[rows],
            heading_rad=tracks.heading_rad[rows],
            object_class=tracks.object_class[rows],
            length_m=tracks.length_m[rows],
            width_m=tracks.width_m[rows],
            history=agents.positions[rows],
            valid=agents.valid[rows],
        )

    @classmethod
    def none(cls, contract: ModelContract) -> Targets:
        """No targets."""
        return cls(
            track_id=np.zeros(0, np.int64),
            object_id=np.zeros(0, np.int64),
            anchor_s=np.zeros(0),
            velocity=np.zeros((0, 2)),
            heading_rad=np.zeros(0),
            object_class=np.zeros(0, np.uint8),
            length_m=np.zeros(0),
            width_m=np.zeros(0),
            history=np.zeros((0, contract.history_steps, 2)),
            valid=np.zeros((0, contract.history_steps), np.bool_),
        )

    @classmethod
    def join(cls, parts: list[Targets]) -> Targets:
        """The targets of all parts, at least one."""
        names = [f.name for f in fields(cls)]
        return cls(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})

    def __len__(self) -> int:
        return len(self.track_id)
