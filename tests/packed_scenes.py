"""Small files in the packed Argoverse 1 layout, of tracks made by hand.

A scene has 50 steps at 10 Hz, of which number 19 is now. A track is (50, 2) metres around the
scene's origin, NaN where it is not seen; the first is the dataset's own target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

STEPS, NOW = 50, 19
TIME_S = 0.1 * (np.arange(STEPS) - NOW)
"""(50,) of every step; 0 is now."""
ORIGIN_M = np.array([2530.0, 1210.0])
"""City position of every scene's origin."""


@dataclass(frozen=True, slots=True)
class PackedScene:
    """What one scene holds."""

    tracks: Sequence[Float64]
    """(50, 2) each."""
    lanes: Sequence[Float64] = ()
    """(n, 2) each, in driving direction."""


def write_packed(path: Path, scenes: Sequence[PackedScene]) -> Path:
    """Write the scenes, whose `seq_id` are 1, 2, 3 and so on; returns `path`."""
    tracks = [track for scene in scenes for track in scene.tracks]
    seen = [np.flatnonzero(np.isfinite(track[:, 0])) for track in tracks]
    lanes = [lane for scene in scenes for lane in scene.lanes]
    np.savez(
        path,
        seq_id=np.arange(1, len(scenes) + 1),
        orig=np.tile(ORIGIN_M, (len(scenes), 1)),
        scene_track_ptr=_pointers([len(scene.tracks) for scene in scenes]),
        track_pt_ptr=_pointers([len(steps) for steps in seen]),
        track_xy=_joined([track[steps] for track, steps in zip(tracks, seen, strict=True)]),
        track_step=np.concatenate(seen).astype(np.int16),
        scene_lane_ptr=_pointers([len(scene.lanes) for scene in scenes]),
        lane_pt_ptr=_pointers([len(lane) for lane in lanes]),
        lane_xy=_joined(lanes),
    )
    return path


def straight(speed_mps: float, later_mps: float | None = None) -> Float64:
    """(50, 2) along +x, at 0 now; from now on at `later_mps`, if that is given."""
    later = speed_mps if later_mps is None else later_mps
    x = np.where(TIME_S > 0.0, later, speed_mps) * TIME_S
    return np.stack([x, np.zeros(STEPS)], axis=-1)


def _pointers(counts: Sequence[int]) -> NDArray[np.int64]:
    return np.cumsum([0, *counts])


def _joined(lines: Sequence[Float64]) -> NDArray[np.float32]:
    return np.concatenate([np.zeros((0, 2)), *lines]).astype(np.float32)
