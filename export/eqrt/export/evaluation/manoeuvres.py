"""What a target does and how fast it goes: the rows that errors are split into.

A manoeuvre is geometry of what truly happened, not of any prediction, decided in this order:

- stopped: it stays within STOPPED_M of where it is now;
- turn left, turn right: its direction of travel changes by TURN_RAD or more;
- lane change: it leaves the lane lines that it is on (by LANE_SHIFT_M, sideways) and ends on
  another that runs its way;
- straight: everything else, so also what follows a bend gently.

The lane lines are those of the model's input, without which nothing counts as a lane change; the
rest does not depend on the model. Turning the world changes none of it.

Axes: W windows, T history steps, H horizon steps, Q lines, L points per line. Tile frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eqrt.core.kinematics import fit_motion
from eqrt.training.dataset.windows import Windows

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

SPEED_BANDS_MPS = (2.0, 5.0, 10.0, 15.0, 20.0)
"""Where one band of speeds ends and the next begins."""
SPEED_BANDS = (
    *(
        f"{a:g} to {b:g} m/s"
        for a, b in zip((0.0, *SPEED_BANDS_MPS), SPEED_BANDS_MPS, strict=False)
    ),
    f"over {SPEED_BANDS_MPS[-1]:g} m/s",
)
MANOEUVRES = ("straight", "lane change", "turn left", "turn right", "stopped")
STRAIGHT, LANE_CHANGE, TURN_LEFT, TURN_RIGHT, STOPPED = range(len(MANOEUVRES))

STOPPED_M = 2.0
"""In 3 s: slower than a walk. Standing vehicles wander by decimetres in every dataset."""
TURN_RAD = np.radians(20.0)
"""A bend of a motorway turns a car by up to 10 degrees in 3 s, a junction by 30 and more."""
ON_LINE_M = 1.75
"""Half the width of a lane."""
LANE_SHIFT_M = 2.0
"""Most of a lane's width: changes take 4 to 6 s, and 3 s of one show about so much."""
CHORD_M = 1.0
"""A direction of travel is that of a chord at least so long: noise of 0.1 m turns it by 6 deg."""
CHORD_STEPS = 5
"""... and of at least so many steps."""
RECENT_STEPS = 10
"""The direction now is that of the last second."""
_SAME_WAY = 0.5  # cosine: a line that runs a target's way is within 60 degrees of its heading
_JOINT_M = 2.0  # a line that begins so near to another's end continues it


def speed_bands(windows: Windows, dt_s: float) -> Index:
    """(W,) which of SPEED_BANDS each target is in now: the fitted speed of its last second."""
    history = windows.history[:, 0].astype(np.float64)
    velocity, _ = fit_motion(history, windows.history_valid[:, 0], dt_s)
    speed = np.nan_to_num(np.linalg.norm(velocity, axis=1))  # who was seen once counts as standing
    return np.asarray(np.searchsorted(SPEED_BANDS_MPS, speed, side="right"))


def manoeuvres(windows: Windows) -> Index:
    """(W,) which of MANOEUVRES each target makes. Its history and future must be complete."""
    now = windows.history[:, 0, -1].astype(np.float64)  # (W, 2)
    future = windows.future.astype(np.float64)  # (W, H, 2)
    end = future[:, -1]
    heading = heading_now(windows)
    end_heading = heading_at_end(windows)
    turned = _angle_between(heading, end_heading)
    lines = _Lines(windows.centerlines.astype(np.float64), windows.centerlines_valid)
    changed = _changes_lane(lines, (now, heading), (end, end_heading))
    reach = np.linalg.norm(future - now[:, None], axis=-1).max(axis=1)
    return np.select(
        [reach < STOPPED_M, turned >= TURN_RAD, turned <= -TURN_RAD, changed],
        [STOPPED, TURN_LEFT, TURN_RIGHT, LANE_CHANGE],
        STRAIGHT,
    )


def heading_now(windows: Windows) -> Float64:
    """(W, 2) unit direction of travel: of the last second, else as measured, else of what follows.

    A way shorter than CHORD_M defines none; what follows is the first CHORD_M of the future.
    """
    history = windows.history[:, 0].astype(np.float64)
    future = windows.future.astype(np.float64)
    measured = windows.heading.astype(np.float64)
    now = history[:, -1]
    moved = now - history[:, -min(RECENT_STEPS, history.shape[1] - 1) - 1]
    away = np.linalg.norm(future - now[:, None], axis=-1) >= CHORD_M
    leaves = np.take_along_axis(future, np.argmax(away, axis=1)[:, None, None], axis=1)[:, 0] - now
    standing = np.linalg.norm(moved, axis=1, keepdims=True) < CHORD_M
    unknown = ~measured.any(axis=1, keepdims=True)
    return _unit(np.where(standing, np.where(unknown, leaves, measured), moved))


def heading_at_end(windows: Windows) -> Float64:
    """(W, 2) unit direction of the last chord of CHORD_STEPS and CHORD_M, or of the whole way."""
    now = windows.history[:, 0, -1].astype(np.float64)
    future = windows.future.astype(np.float64)
    path = np.concatenate([now[:, None], future], axis=1)  # (W, H + 1, 2)
    chord = path[:, -1:] - path  # (W, H + 1, 2)
    enough = np.linalg.norm(chord, axis=-1) >= CHORD_M
    enough[:, path.shape[1] - CHORD_STEPS :] = False
    latest = path.shape[1] - 1 - np.argmax(enough[:, ::-1], axis=1)
    start = np.where(enough.any(axis=1), latest, 0)
    return _unit(np.take_along_axis(chord, start[:, None, None], axis=1)[:, 0])


class _Place(NamedTuple):
    """Where one position per window lies beside each line."""

    distance: Float64
    """(W, Q) metres; inf for a line that does not exist."""
    left: Float64
    """(W, Q) metres to the left of the line, prolonged where it ends."""
    direction: Float64
    """(W, Q, 2) of the line there, unit."""


class _Lines:
    """Polylines (W, Q, L, 2), valid (W, Q, L)."""

    def __init__(self, points: Float64, valid: Bool) -> None:
        self._start = points[..., :-1, :]
        self._along = points[..., 1:, :] - self._start  # (W, Q, L - 1, 2)
        length = np.linalg.norm(self._along, axis=-1)
        self._exists = valid[..., :-1] & valid[..., 1:] & (length > 0.0)
        self._direction = self._along / np.maximum(length, 1e-9)[..., None]
        first, last = np.argmax(valid, axis=-1), _last_true(valid)
        self._first = np.take_along_axis(points, first[..., None, None], axis=-2)[..., 0, :]
        self._last = np.take_along_axis(points, last[..., None, None], axis=-2)[..., 0, :]

    def place(self, position: Float64) -> _Place:
        """Beside each line, at its segment that is nearest to the position (W, 2)."""
        offset = position[:, None, None] - self._start  # (W, Q, L - 1, 2)
        length2 = np.maximum(np.square(self._along).sum(-1), 1e-18)
        share = np.clip((offset * self._along).sum(-1) / length2, 0.0, 1.0)
        apart = np.linalg.norm(offset - share[..., None] * self._along, axis=-1)
        apart = np.where(self._exists, apart, np.inf)
        nearest = np.argmin(apart, axis=-1)[..., None]  # (W, Q, 1)
        direction = np.take_along_axis(self._direction, nearest[..., None], axis=2)[:, :, 0]
        from_start = np.take_along_axis(offset, nearest[..., None], axis=2)[:, :, 0]
        left = direction[..., 0] * from_start[..., 1] - direction[..., 1] * from_start[..., 0]
        return _Place(np.take_along_axis(apart, nearest, axis=2)[..., 0], left, direction)

    def with_continuations(self, chosen: Bool) -> Bool:
        """The lines chosen (W, Q), and those that begin where a chosen one ends, and so on."""
        gap = np.linalg.norm(self._last[:, :, None] - self._first[:, None], axis=-1)  # (W, Q, Q)
        follows = gap <= _JOINT_M
        for _ in range(chosen.shape[1]):
            chosen = chosen | (chosen[:, :, None] & follows).any(axis=1)
        return chosen


def _changes_lane(
    lines: _Lines, now: tuple[Float64, Float64], end: tuple[Float64, Float64]
) -> Bool:
    """(W,) whether it leaves its lines for another; `now`, `end`: position and heading (W, 2)."""
    before, after = lines.place(now[0]), lines.place(end[0])
    at_first = _is_on(before, now[1])
    own = lines.with_continuations(at_first)
    shift = np.where(at_first, np.abs(after.left - before.left), np.inf)
    left_all = at_first.any(axis=1) & (shift.min(axis=1, initial=np.inf) >= LANE_SHIFT_M)
    on_own = (_is_on(after, end[1]) & own).any(axis=1)
    on_another = (_is_on(after, end[1]) & ~own).any(axis=1)
    return np.asarray(left_all & on_another & ~on_own)


def _is_on(place: _Place, heading: Float64) -> Bool:
    same_way = (place.direction * heading[:, None]).sum(-1) >= _SAME_WAY
    return np.asarray((place.distance <= ON_LINE_M) & same_way)


def _last_true(mask: Bool) -> Index:
    return np.asarray(mask.shape[-1] - 1 - np.argmax(mask[..., ::-1], axis=-1))


def _unit(vectors: Float64) -> Float64:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9))


def _angle_between(a: Float64, b: Float64) -> Float64:
    """(W,) radians from `a` to `b` (W, 2), counter-clockwise positive."""
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.asarray(np.arctan2(cross, (a * b).sum(-1)))
