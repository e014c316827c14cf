"""Velocities against the change of positions: a wrong sign, unit or kind shows there at once.

A sensor that moves with velocity v and turns with rate w sees an object with velocity u move by
dp/dt = (u - v) - w x p in its own axes. The turn does not change the distance. `relative`
velocities are u - v, `absolute` ones u.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.can_check.ego_course import EgoCourse
from eqrt.runtime.can_check.objects import Objects, along_sight
from eqrt.runtime.can_check.report import Fit
from eqrt.runtime.decoding.detections import VelocityKind

Float64 = NDArray[np.float64]

STANDING = "y of what stands"

BASE_S = 0.5  # between the two positions: longer than most cycles, so that noise and steps average
_STANDING_MPS = 1.0  # over ground, along the line of sight
_TRACK_APART_S = 1e7  # puts one track behind the other on one axis; a log is shorter
_MAX_STEP_MPS = 90.0  # no two vehicles meet faster
_STEP_NOISE_M = 3.0  # of one measurement to the next


@dataclass(frozen=True, slots=True)
class Pairs:
    """Two measurements of one object, for n of them."""

    changed: Float64
    """(n,) change of the position per second."""
    said: Float64
    """(n,) mean of what the sensor said meanwhile."""


def object_fits(objects: Objects, course: EgoCourse, mount: Pose2) -> tuple[Fit, ...]:
    """Of the distance, of x and y where the whole velocity is known, and of what stands."""
    if objects.kind is VelocityKind.NONE:
        return ()
    fits = [fit("distance", distance_pairs(objects, course, mount, objects.kind))]
    if objects.kind is not VelocityKind.RADIAL:
        fits += [fit(axis, axis_pairs(objects, course, mount, axis)) for axis in ("x", "y")]
    if len(course.yaw_rate_s):
        fits.append(fit(STANDING, standing_pairs(objects, course, mount)))
    return tuple(fits)


def distance_pairs(objects: Objects, course: EgoCourse, mount: Pose2, kind: VelocityKind) -> Pairs:
    """Distances, with the velocities taken for `kind`."""
    said = along_sight(objects)
    if kind is VelocityKind.ABSOLUTE:
        own = np.nan_to_num(course.sensor_velocity(objects.time_s, mount))
        said = said - (own * objects.line_of_sight).sum(axis=1)
    return pairs(objects.time_s, objects.track, objects.range_m, said)


def axis_pairs(objects: Objects, course: EgoCourse, mount: Pose2, axis: str) -> Pairs:
    """x or y, with what the sensor's own turn adds."""
    i = "xy".index(axis)
    said = objects.velocity[:, i]
    if objects.kind is VelocityKind.ABSOLUTE:
        said = said - np.nan_to_num(course.sensor_velocity(objects.time_s, mount))[:, i]
    turn = course.yaw_rate_at(objects.time_s) * objects.position[:, 1 - i]
    said = said + turn if axis == "x" else said - turn
    return pairs(objects.time_s, objects.track, objects.position[:, i], said)


def standing_pairs(objects: Objects, course: EgoCourse, mount: Pose2) -> Pairs:
    """y of what stands on the ground moves as the car turns: -w x, if y and w have their signs."""
    own = course.sensor_velocity(objects.time_s, mount)
    said = -own[:, 1] - course.yaw_rate_at(objects.time_s) * objects.position[:, 0]
    said = np.where(is_standing(objects, own), said, np.nan)
    return pairs(objects.time_s, objects.track, objects.position[:, 1], said, base_s=2 * BASE_S)


def is_standing(objects: Objects, own: Float64) -> NDArray[np.bool_]:
    """(M,) what does not move along the line of sight; `own`: the sensor over ground, (M, 2)."""
    over_ground = along_sight(objects)
    if objects.kind is not VelocityKind.ABSOLUTE:
        over_ground = over_ground + (own * objects.line_of_sight).sum(axis=1)
    standing: NDArray[np.bool_] = np.abs(over_ground) < _STANDING_MPS
    return standing


def ego_fits(course: EgoCourse) -> tuple[Fit, ...]:
    """Speed and yaw rate against the poses, where there are any."""
    if len(course.pose_s) < 2:
        return ()
    one_track = np.zeros(len(course.pose_s), np.int64)
    fits = []
    if len(course.speed_s):
        said = course.speed_at(course.pose_s)
        fits.append(fit("speed", pairs(course.pose_s, one_track, _driven_m(course), said)))
    if len(course.yaw_rate_s):
        said = np.degrees(course.yaw_rate_at(course.pose_s))
        turned = np.degrees(course.yaw_rad)
        fits.append(fit("yaw rate", pairs(course.pose_s, one_track, turned, said)))
    return tuple(fits)


def _driven_m(course: EgoCourse) -> Float64:
    """(p,) way along the car's own axis; backward counts as minus."""
    steps = np.diff(course.position, axis=0)
    ahead = np.stack([np.cos(course.yaw_rad), np.sin(course.yaw_rad)], axis=-1)[:-1]
    return np.concatenate([[0.0], np.cumsum((steps * ahead).sum(axis=1))])


def pairs(
    time_s: Float64,
    track: NDArray[np.int64],
    place: Float64,
    said: Float64,
    base_s: float = BASE_S,
) -> Pairs:
    """Of each measurement and the first one of its track that is `base_s` or more later.

    Arrays (M,), track after track. Pairs between which something is not known are left out.
    """
    if len(time_s) < 2:
        return Pairs(np.empty(0), np.empty(0))
    axis_s = (time_s - time_s.min()) + track * _TRACK_APART_S
    later = np.searchsorted(axis_s, axis_s + base_s)
    first = np.flatnonzero(later < len(axis_s))
    first = first[track[later[first]] == track[first]]
    later = later[first]
    seconds = time_s[later] - time_s[first]
    unknown = np.cumsum(~np.isfinite(said) | ~np.isfinite(place))
    steps = np.where(np.diff(track) == 0, np.diff(time_s), 0.0)
    known = np.where(np.isfinite(said), said, 0.0)
    area = np.concatenate([[0.0], np.cumsum(0.5 * (known[1:] + known[:-1]) * steps)])
    whole = (unknown[later] == unknown[first]) & np.isfinite(place[first] + said[first])
    changed, told = place[later] - place[first], area[later] - area[first]
    return Pairs((changed / seconds)[whole], (told / seconds)[whole])


def fit(what: str, found: Pairs) -> Fit:
    """How well the two agree. Pairs that jump by more than any vehicle can are left out."""
    possible = np.abs(found.changed) < _MAX_STEP_MPS
    changed, said = found.changed[possible], found.said[possible]
    correlation = slope = residual = None
    if len(said) > 2:
        residual = float(np.median(np.abs(changed - said)))
        if said.std() > 0.0 and changed.std() > 0.0:
            correlation = float(np.corrcoef(changed, said)[0, 1])
            slope = correlation * float(changed.std() / said.std())
    return Fit(
        what=what,
        pairs=len(said),
        spread=float(said.std()) if len(said) else 0.0,
        correlation=correlation,
        slope=slope,
        residual=residual,
    )


def share_of_jumps(objects: Objects) -> float:
    """Of the steps from one cycle to the next, those that no vehicle can make."""
    steps_m = np.hypot(*np.diff(objects.position, axis=0).T)
    seconds = np.diff(objects.time_s)
    goes_on = objects.goes_on & np.isfinite(steps_m)
    if not goes_on.any():
        return 0.0
    too_far = steps_m > _STEP_NOISE_M + _MAX_STEP_MPS * seconds
    return float(too_far[goes_on].mean())


def standing_share(objects: Objects, course: EgoCourse, mount: Pose2, factor: float) -> float:
    """Share of the objects that stand on the ground if the ego is `factor` times as fast."""
    own = factor * course.sensor_velocity(objects.time_s, mount)
    return float(is_standing(objects, own).mean()) if len(objects.time_s) else 0.0
