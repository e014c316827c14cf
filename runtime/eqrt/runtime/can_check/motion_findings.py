"""What looks wrong when velocities, positions and the car's own motion are held together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from eqrt.core.frames import Pose2
from eqrt.runtime.can_check.ego_course import EgoCourse
from eqrt.runtime.can_check.motion import STANDING, distance_pairs, fit, standing_share
from eqrt.runtime.can_check.objects import Objects
from eqrt.runtime.can_check.report import Fit, Sensor
from eqrt.runtime.can_check.scale import FACTORS, tells, unit_hint, wrong_factor
from eqrt.runtime.decoding.detections import VelocityKind


def motion_texts(
    sensor: Sensor, objects: Objects, course: EgoCourse, mount: Pose2
) -> Iterator[str]:
    """Sign, unit and kind of the velocities; sign of y; unit of the car's speed."""
    for one in sensor.fits:
        yield from _fit_texts(one, objects.kind)
    yield from _kind_texts(sensor, objects, course, mount)
    yield from _scale_texts(sensor, objects, course, mount)
    yield from _ego_texts(objects, course, mount)


def _fit_texts(one: Fit, kind: VelocityKind) -> Iterator[str]:
    if not tells(one) or one.correlation is None or one.slope is None:
        return
    if one.what == STANDING:
        if one.correlation < -0.3:
            yield (
                "when the car turns, what stands beside the road moves the wrong way: the sign of "
                "y (positive to the left) or of the yaw rate (positive to the left) is wrong"
            )
        return
    said = _said(one.what, kind)
    if one.correlation < -0.3:
        yield (
            f"{one.what} changes against {said} (correlation {one.correlation:.2f}): "
            f"one of the two has the wrong sign"
        )
    elif one.correlation < 0.3:
        yield (
            f"{one.what} does not change as {said} says (correlation {one.correlation:.2f}): "
            "another signal, byte order, or kind of velocity"
        )
    elif factor := wrong_factor(one):
        yield (
            f"{one.what} changes by {one.slope:.3g} m for each metre that {said} says"
            f"{unit_hint(1.0 / factor, one)}"
        )


def _said(what: str, kind: VelocityKind) -> str:
    if kind is VelocityKind.RADIAL:
        return "range_rate"
    return "the velocity" if what == "distance" else f"velocity_{what}"


def _kind_texts(sensor: Sensor, objects: Objects, course: EgoCourse, mount: Pose2) -> Iterator[str]:
    """Whether the velocities fit better if they are taken for the other kind."""
    if not len(course.speed_s) or objects.kind in (VelocityKind.NONE, VelocityKind.RADIAL):
        return
    relative = objects.kind is VelocityKind.RELATIVE
    other = VelocityKind.ABSOLUTE if relative else VelocityKind.RELATIVE
    as_is = sensor.fits[0]
    as_other = fit("distance", distance_pairs(objects, course, mount, other))
    if _fits_better(as_other, as_is):
        yield (
            f'velocities fit the change of distance better as velocity = "{other.name.lower()}" '
            f"(off by {as_other.residual:.1f} m/s instead of {as_is.residual:.1f})"
        )


def _scale_texts(
    sensor: Sensor, objects: Objects, course: EgoCourse, mount: Pose2
) -> Iterator[str]:
    """Whether absolute velocities fit if they are scaled: the car's own speed is not."""
    if not len(course.speed_s) or objects.kind is not VelocityKind.ABSOLUTE:
        return
    for factor, reason in {**FACTORS, -1.0: "wrong sign"}.items():
        scaled = replace(objects, velocity=objects.velocity / factor)
        as_scaled = fit("distance", distance_pairs(scaled, course, mount, objects.kind))
        if _fits_better(as_scaled, sensor.fits[0]):
            yield (
                f"velocities fit the change of distance better if divided by {factor:.3g} "
                f"(off by {as_scaled.residual:.1f} m/s instead of {sensor.fits[0].residual:.1f}): "
                f"{reason}?"
            )
            return


def _fits_better(other: Fit, as_is: Fit) -> bool:
    """Clearly: as it is the fit is bad, and the other one is good by itself."""
    if not (tells(as_is) and tells(other)) or as_is.residual is None or other.residual is None:
        return False
    good = other.correlation is not None and other.correlation > 0.7 and not wrong_factor(other)
    return good and as_is.residual > 1.0 and other.residual < 0.3 * as_is.residual


def _ego_texts(objects: Objects, course: EgoCourse, mount: Pose2) -> Iterator[str]:
    """Whether more of the world stands still if the car's speed is another."""
    if objects.kind not in (VelocityKind.RELATIVE, VelocityKind.RADIAL) or not len(course.speed_s):
        return
    if float(np.median(np.abs(course.speed_mps))) < 2.0:
        return
    reasons = {1.0 / factor: reason for factor, reason in FACTORS.items() if 0.2 < factor < 5.0}
    reasons |= {1.0: "", -1.0: "is its sign wrong"}
    shares = {factor: standing_share(objects, course, mount, factor) for factor in reasons}
    best = max(shares, key=lambda factor: shares[factor])
    if best == 1.0 or shares[best] < max(0.05, 3.0 * shares[1.0]):
        return
    yield (
        f"{shares[best]:.0%} of the objects would stand on the ground if the car's speed were "
        f"{best:.3g} times what the profile says, {shares[1.0]:.0%} do: {reasons[best]}?"
    )
