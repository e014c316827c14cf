"""Argoverse 1 motion forecasting scenes packed into one .npz file.

Ragged arrays: scene i owns tracks scene_track_ptr[i]:scene_track_ptr[i + 1], track j owns points
track_pt_ptr[j]:track_pt_ptr[j + 1] of track_xy (metres, relative to the scene's `orig`, not turned)
and track_step (0..49 at 10 Hz, of which 20 are observed). A scene's first track is the target
(AGENT), the second the recording car (AV). scene_lane_ptr, lane_pt_ptr and lane_xy hold the lane
centerlines around the target in the same way and frame; successors are inferred from shared ends.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import LogError
from eqrt.core.lanes import Lane, LaneMap, arclength, build_lane_map, evenly_spaced
from eqrt.training.recordings.recording import Part, Recording, Source, TrackGrid
from eqrt.training.recordings.recording_file import UNREADABLE

Float64 = NDArray[np.float64]
Arrays = dict[str, NDArray[np.generic]]

ARGOVERSE1 = Source(
    name="Argoverse 1",
    credits="Argoverse 1 Motion Forecasting ((c) 2018-2019 Argo AI, LLC; CC BY-NC-SA 4.0 and the "
    "Argoverse terms of use)",
    license="CC-BY-NC-SA-4.0",
    non_commercial=True,
)
DT_S = 0.1
NUM_STEPS = 50
NOW_STEP = 19
SAME_POINT_M = 0.6
"""A lane follows another if it begins within this distance of the other's end."""
SCENES_PER_PART = 32
_NEEDED: dict[str, tuple[int, ...]] = {
    "seq_id": (),
    "orig": (2,),
    "scene_track_ptr": (),
    "track_pt_ptr": (),
    "track_xy": (2,),
    "track_step": (),
    "scene_lane_ptr": (),
    "lane_pt_ptr": (),
    "lane_xy": (2,),
}
"""Array -> the shape of each of its entries."""


class PackedArgoverse1Reader:
    """Reads the packed layout."""

    @property
    def source(self) -> Source:
        """Argoverse 1's."""
        return ARGOVERSE1

    def parts(self, path: Path) -> Sequence[Part]:
        """Runs of scenes of the file at `path`."""
        scenes = len(_arrays(str(path))["seq_id"])
        if not scenes:
            raise LogError(f"{path}: no scenes in it")
        return [
            Part(str(path), first, min(SCENES_PER_PART, scenes - first))
            for first in range(0, scenes, SCENES_PER_PART)
        ]

    def read(self, part: Part) -> Iterator[Recording]:
        """The scenes of `part`, one recording each."""
        arrays = _arrays(part.path)
        for scene in range(part.first, part.first + part.count):
            where = f"{part.path}: scene {arrays['seq_id'][scene]}"
            yield _recording(arrays, scene, where)


@lru_cache(maxsize=1)
def _arrays(path: str) -> Arrays:
    """The arrays of one file, their sizes checked."""
    try:
        # Opened here: np.load leaves a file that it cannot read open.
        with Path(path).open("rb") as stream:
            file = np.load(stream, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise ValueError("it holds a single array")
            missing = sorted(set(_NEEDED) - set(file.files))
            if missing:
                raise LogError(
                    f"{path}: no array {', '.join(missing)}; not a packed Argoverse 1 file"
                )
            arrays = {name: file[name] for name in _NEEDED}
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file") from error
    except UNREADABLE as error:
        raise LogError(f"{path}: not a readable .npz file ({error})") from error
    _check(arrays, path)
    return arrays


def _check(arrays: Arrays, path: str) -> None:
    for name, entry in _NEEDED.items():
        shape, kind = arrays[name].shape, arrays[name].dtype
        if not shape or shape[1:] != entry or kind.kind not in "iuf":
            raise LogError(
                f"{path}: {name} is {kind} of shape {shape}, expected numbers of shape "
                f"{('n', *entry)}; the file is damaged"
            )
    scenes = len(arrays["seq_id"])
    for pointer, owners, owned in (
        ("scene_track_ptr", scenes, len(arrays["track_pt_ptr"]) - 1),
        ("track_pt_ptr", len(arrays["track_pt_ptr"]) - 1, len(arrays["track_xy"])),
        ("scene_lane_ptr", scenes, len(arrays["lane_pt_ptr"]) - 1),
        ("lane_pt_ptr", len(arrays["lane_pt_ptr"]) - 1, len(arrays["lane_xy"])),
    ):
        starts = arrays[pointer].astype(np.int64)
        if (
            len(starts) != owners + 1
            or starts[0]
            or starts[-1] != owned
            or np.diff(starts).min(initial=0) < 0
        ):
            raise LogError(
                f"{path}: {pointer} does not rise from 0 to {owned}; the file is damaged"
            )
    if len(arrays["track_step"]) != len(arrays["track_xy"]) or len(arrays["orig"]) != scenes:
        raise LogError(f"{path}: track_step or orig has another length; the file is damaged")


def _recording(arrays: Arrays, scene: int, where: str) -> Recording:
    first, last = (int(i) for i in arrays["scene_track_ptr"][scene : scene + 2])
    if first == last:
        raise LogError(f"{where}: no tracks in it")
    count = last - first
    tracks = TrackGrid.empty(count, NUM_STEPS)
    origin = arrays["orig"][scene].astype(np.float64)
    for row in range(count):
        begin, end = (int(i) for i in arrays["track_pt_ptr"][first + row : first + row + 2])
        step = arrays["track_step"][begin:end].astype(np.int64)
        if len(step) and not 0 <= step.min() <= step.max() < NUM_STEPS:
            raise LogError(f"{where}: a step of track {row} is not within 0 to {NUM_STEPS - 1}")
        if len(np.unique(step)) != len(step):
            raise LogError(f"{where}: track {row} is seen twice at one step")
        tracks.positions[row, step] = arrays["track_xy"][begin:end] + origin
        tracks.valid[row, step] = True
    if not np.isfinite(tracks.positions).all():
        raise LogError(f"{where}: a position is not a number")
    identity = str(arrays["seq_id"][scene])
    return Recording(
        name=identity,
        group=identity,
        dt_s=DT_S,
        tracks=tracks,
        track_ids=tuple(("AGENT", "AV")[row] if row < 2 else str(row) for row in range(count)),
        may_be_target=np.ones(count, np.bool_),
        focal=np.arange(count) == 0,
        now_steps=(NOW_STEP,),
        lanes=_lanes(arrays, scene, origin, where),
    )


def _lanes(arrays: Arrays, scene: int, origin: Float64, where: str) -> LaneMap | None:
    """The scene's lanes, or None if it has none."""
    first, last = (int(i) for i in arrays["scene_lane_ptr"][scene : scene + 2])
    starts = arrays["lane_pt_ptr"][first : last + 1].astype(np.int64)
    lines = [arrays["lane_xy"][a:b].astype(np.float64) for a, b in pairwise(starts)]
    if not all(np.isfinite(line).all() for line in lines):
        raise LogError(f"{where}: a point of a lane is not a number")
    lines = [line for line in lines if len(line) > 1 and arclength(line)[-1] > SAME_POINT_M]
    if not lines:
        return None
    follows = _successors(lines)
    return build_lane_map(
        (
            Lane(lane_id=i, centerline=evenly_spaced(line) + origin, successors=follows[i])
            for i, line in enumerate(lines)
        ),
        where,
    )


def _successors(lines: list[Float64]) -> list[list[int]]:
    """For every line the lines that begin where it ends."""
    begin = np.array([line[0] for line in lines])
    end = np.array([line[-1] for line in lines])
    gap = np.linalg.norm(end[:, None] - begin[None], axis=-1)
    np.fill_diagonal(gap, np.inf)
    return [np.flatnonzero(row <= SAME_POINT_M).tolist() for row in gap]
