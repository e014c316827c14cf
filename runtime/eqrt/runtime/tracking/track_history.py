"""From measurements at a sensor's own times to the model's clock, and to a velocity.

Axes: A tracks, R measurements each, oldest first and right-aligned: unused ones come first, with a
time of -inf. T steps of the model's clock.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_GAP_S = 0.3
"""Two measurements further apart are not joined."""
SAME_TIME_S = 1e-6
"""Times closer than this are equal: float64 resolves a clock that counts from 1970 to 0.24 us."""
FIT_S = 1.0
"""A velocity is fitted to so much of the newest past."""
_FIT_MIN_S = 0.2
_FIT_MIN_COUNT = 3

Float64 = NDArray[np.float64]


def resample(
    times_s: Float64, positions: Float64, now_s: float, steps: int, dt_s: float
) -> tuple[Float64, NDArray[np.bool_]]:
    """Positions (A, T, 2) at now_s - k dt_s, k = T - 1 .. 0, and which are valid (A, T).

    `times_s` is (A, R), `positions` (A, R, 2). A step is the linear interpolation between the
    measurements before and after it, and valid if these are at most 0.3 s apart and the nearer one
    at most `dt_s` away, or if one lies at the step itself. Nothing is extrapolated: NaN instead.
    """
    tracks, ring = times_s.shape
    clock_s = now_s - dt_s * np.arange(steps - 1, -1, -1, dtype=np.float64)  # (T,)
    old = _num_older(times_s, clock_s[0] - MAX_GAP_S)
    # (A, T) measurements at or before the step
    count = old + _count_until(times_s[:, old:], clock_s, dt_s)
    row_start = ring * np.arange(tracks)[:, None]
    before = row_start + np.maximum(count - 1, 0)
    after = row_start + np.minimum(count, ring - 1)
    since_s = clock_s - times_s.take(before)
    until_s = times_s.take(after) - clock_s
    is_hit = since_s <= SAME_TIME_S
    is_between = (since_s + until_s <= MAX_GAP_S + SAME_TIME_S) & (count < ring)
    is_near = np.minimum(since_s, until_s) <= dt_s + SAME_TIME_S
    valid = (count > 0) & (is_hit | (is_between & is_near))
    weight = np.full(valid.shape, np.nan)
    np.divide(since_s, since_s + until_s, out=weight, where=valid & ~is_hit)
    weight[valid & is_hit] = 0.0
    places = positions.reshape(-1, 2)
    start = places.take(before, axis=0)  # (A, T, 2)
    return start + weight[..., None] * (places.take(after, axis=0) - start), valid


def fit_velocity(times_s: Float64, positions: Float64) -> Float64:
    """Velocity (A, 2) of the straight line through the last second; NaN from too few points.

    `times_s` is (A, R), `positions` (A, R, 2), with at least one measurement each.
    """
    newest_s = times_s[:, -1:]
    old = _num_older(times_s - newest_s, -FIT_S)
    age_s = times_s[:, old:] - newest_s
    used = age_s >= -FIT_S  # (A, R)
    count = used.sum(-1)
    age_s = np.where(used, age_s, 0.0)
    age_s = np.where(used, age_s - (age_s.sum(-1) / count)[:, None], 0.0)
    # Relative to the newest, because map coordinates are too large to be squared and subtracted.
    offset = np.where(used[..., None], positions[:, old:] - positions[:, -1:], 0.0)
    enough = (count >= _FIT_MIN_COUNT) & (np.ptp(age_s, axis=-1) >= _FIT_MIN_S)
    spread = np.where(enough, np.square(age_s).sum(-1), np.nan)
    velocity: Float64 = np.einsum("ar,arc->ac", age_s, offset) / spread[:, None]
    return velocity


def _num_older(times_s: Float64, limit_s: float) -> int:
    """Leading columns that are older than the limit in every row; the last one always stays."""
    _, ring = times_s.shape
    newer = np.count_nonzero(times_s >= limit_s, axis=-1)
    return int(ring - newer.max(initial=1))


def _count_until(times_s: Float64, clock_s: Float64, dt_s: float) -> NDArray[np.intp]:
    """How many of each track's measurements lie at or before each step of the clock, (A, T)."""
    tracks, steps = len(times_s), len(clock_s)
    first = np.ceil((times_s - (clock_s[0] + SAME_TIME_S)) / dt_s)  # first step not before it
    bucket = np.clip(first, 0, steps).astype(np.intp)
    bucket += (steps + 1) * np.arange(tracks)[:, None]
    counts = np.bincount(bucket.ravel(), minlength=tracks * (steps + 1))
    return counts.reshape(tracks, steps + 1)[:, :steps].cumsum(axis=1)
