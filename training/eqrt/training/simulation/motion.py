"""From where SUMO puts vehicles to how vehicles move.

SUMO moves the middle of the front bumper along drawn lanes: at their corners it turns on the spot,
between lanes it may jump, and its speed changes from one step to the next without end of jerk. The
front is therefore smoothed in time (with a positive kernel, so that a car that stops neither
overshoots nor rolls back), and the body follows it as a body on wheels must: the rear axle moves
only where it points. On each step that is the tractrix, which has a closed form.

Axes: A vehicles, S steps. Points are complex numbers x + iy, metres, network frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Complex = NDArray[np.complex128]

SMOOTH_STEPS = 4.0
"""Sigma of the kernel, 0.4 s."""
_REACH = 12  # steps each way, three sigma
_REAR_AXLE = 0.8  # of the length, behind the front


def plausible_motion(
    front: Complex, heading_rad: Float64, length_m: Float64, lives: NDArray[np.intp]
) -> tuple[Complex, Float64]:
    """Centers (A, S) and headings (A, S), radians counter-clockwise from +x.

    `front` (A, S) is where SUMO has the fronts from step `lives[:, 0]` up to `lives[:, 1]` without
    a gap, `heading_rad` (A,) where they point at first. What is returned outside is meaningless.
    """
    smooth = np.empty_like(front)
    for row, (first, end) in enumerate(lives):
        smooth[row, first:end] = _smoothed(front[row, first:end])
        smooth[row, :first] = smooth[row, first]  # standing there turns nobody
        smooth[row, end:] = smooth[row, end - 1]
    heading = _towed(smooth, heading_rad, _REAR_AXLE * length_m)
    return smooth - (length_m / 2.0)[:, None] * np.exp(1j * heading), heading


def _smoothed(path: Complex) -> Complex:
    """(n,) the same path without its corners. At its ends it goes on as it came, point-mirrored."""
    reach = min(_REACH, len(path) - 1)
    if reach < 1:
        return path
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTH_STEPS) ** 2)
    before = 2.0 * path[0] - path[reach:0:-1]
    after = 2.0 * path[-1] - path[-2 : -reach - 2 : -1]
    extended = np.concatenate([before, path, after])
    return np.convolve(extended, kernel / kernel.sum(), mode="valid")


def _towed(front: Complex, heading_rad: Float64, rear_axle_m: Float64) -> Float64:
    """(A, S) headings of bodies whose fronts are pulled along `front` (A, S).

    The angle between the pull and the body shrinks over a step of length d as
    tan(angle / 2) -> tan(angle / 2) exp(-d / axle), exactly.
    """
    step = np.diff(front, axis=1)  # (A, S - 1)
    decay = np.exp(-np.abs(step) / rear_axle_m[:, None])
    heading = np.empty(front.shape)
    heading[:, 0] = heading_rad
    for i in range(step.shape[1]):
        body = np.exp(1j * heading[:, i])
        angle = np.angle(step[:, i] * body.conj())  # 0 where it stands
        heading[:, i + 1] = heading[:, i] + angle
        heading[:, i + 1] -= 2.0 * np.arctan(np.tan(angle / 2.0) * decay[:, i])
    return heading
