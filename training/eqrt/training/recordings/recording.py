"""One form for every recording: tracks on one clock, the lanes under them, and whose they are.

Axes: A agents (tracks), S steps of the recording. Metres, map frame (x east, y north), float64.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eqrt.core.lanes import LaneMap
from eqrt.core.scene import AgentHistories

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Where data comes from and what its licence asks; travels into every model made of it."""

    name: str
    """For example `Argoverse 1`."""
    credits: str
    """The notice that the licence asks for, one sentence."""
    license: str
    """An SPDX expression, or the terms' name."""
    non_commercial: bool
    """Whether models made of it may not be used commercially; `eqrt` then says so."""


@dataclass(frozen=True, slots=True)
class TrackGrid:
    """Tracks on one clock."""

    positions: Float64
    """(A, S, 2) metres, map frame; anything where not valid."""
    heading_rad: Float64
    """(A, S) measured heading, counter-clockwise from +x; NaN = not known."""
    valid: Bool
    """(A, S) True = seen."""

    @classmethod
    def empty(cls, agents: int, steps: int) -> TrackGrid:
        """Nothing seen yet, to be filled in."""
        return cls(
            np.zeros((agents, steps, 2)),
            np.full((agents, steps), np.nan),
            np.zeros((agents, steps), np.bool_),
        )

    @property
    def num_steps(self) -> int:
        """S."""
        return int(self.valid.shape[1])

    def histories(self, step: int, history_steps: int) -> AgentHistories:
        """What was known at `step`: the last `history_steps` steps up to it."""
        steps = np.arange(step - history_steps + 1, step + 1)
        inside = steps >= 0
        heading = self.heading_rad[:, step]
        known = (self.valid[:, step] & np.isfinite(heading))[:, None]
        return AgentHistories(
            positions=self.positions[:, np.maximum(steps, 0)],
            valid=self.valid[:, np.maximum(steps, 0)] & inside,
            heading=np.where(known, np.stack([np.cos(heading), np.sin(heading)], -1), 0.0),
        )

    def future(self, step: int, horizon_steps: int) -> tuple[Float64, Bool]:
        """Positions (A, H, 2) after `step` and whether they were seen (A, H)."""
        steps = np.arange(step + 1, step + 1 + horizon_steps)
        inside = steps < self.num_steps
        steps = np.minimum(steps, self.num_steps - 1)
        return self.positions[:, steps], self.valid[:, steps] & inside


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """One stretch of driving."""

    name: str
    """Unique within its dataset; errors and pictures use it."""
    group: str
    """Recordings that share vehicles share a group; a split never cuts through one."""
    dt_s: float
    tracks: TrackGrid
    track_ids: tuple[str, ...]
    """(A,)"""
    may_be_target: Bool
    """(A,) vehicles, as far as the format tells: predicting anything else is not what we do."""
    focal: Bool
    """(A,) the targets that the dataset itself is evaluated on; all False where it names none."""
    now_steps: tuple[int, ...] | None
    """The steps that the dataset calls now; None = any."""
    lanes: LaneMap | None
    """Map frame; the same object for all recordings on one map. None = no map."""


@dataclass(frozen=True, slots=True)
class Part:
    """A piece of a dataset that one worker reads at a time. Plain data: it crosses processes."""

    path: str
    first: int = 0
    """First recording in the file, for files that hold many."""
    count: int = 1

    @property
    def name(self) -> str:
        """How errors call it."""
        return self.path if self.count == 1 else f"{self.path}[{self.first}:+{self.count}]"


class Reader(Protocol):
    """Reads one format. Instances are small and picklable; maps are cached per process."""

    @property
    def source(self) -> Source:
        """Credits and licence of what it reads."""

    def parts(self, path: Path) -> Sequence[Part]:
        """The pieces of the dataset at `path`, in a fixed order; LogError if there are none."""

    def read(self, part: Part) -> Iterator[Recording]:
        """The recordings of one piece. Raises LogError, naming the file and the reason."""
