"""What looks wrong with the car's own speed and yaw rate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from eqrt.runtime.can_check.ego_course import EgoCourse
from eqrt.runtime.can_check.observation import Observation
from eqrt.runtime.can_check.plain import plain
from eqrt.runtime.can_check.report import Finding, Fit, Values
from eqrt.runtime.can_check.scale import MIN_PAIRS, tells, unit_hint, wrong_factor
from eqrt.runtime.can_check.traffic import has_come
from eqrt.runtime.decoding.profile import Profile

_MAX_SPEED_MPS, _MAX_LATERAL_MPS2 = 90.0, 12.0
_FEW = 30
_STANDING_MPS = 0.5
_CLEAR = 1.0  # m/s, deg/s: a car that accelerates or turns, and no noise


def ego_findings(
    values: tuple[Values, ...], fits: tuple[Fit, ...], course: EgoCourse
) -> Iterator[Finding]:
    """Everything about the car's own motion."""
    rows = {row.name: row for row in values}
    texts = [*_ego_value_texts(rows, course), *(text for one in fits for text in _ego_fit(one))]
    for text in texts:
        yield Finding(about="ego", text=text)


def _ego_value_texts(rows: dict[str, Values], course: EgoCourse) -> Iterator[str]:
    speed, yaw = rows["speed"], rows["yaw rate"]
    if (
        speed.median is not None
        and max(abs(speed.p5 or 0.0), abs(speed.p95 or 0.0)) > _MAX_SPEED_MPS
    ):
        span = f"{plain(speed.low)} to {plain(speed.high)}"
        yield f"the speed goes from {span} m/s: is the unit right?"
    if speed.median is not None and speed.median < -2.0:
        yield f"the car mostly drives backward ({speed.median:.1f} m/s): sign, or `reverse`"
    if speed.count >= _FEW and speed.low == speed.high and speed.low:
        yield f"the speed is always {speed.low:g} m/s: is it the right signal?"
    if yaw.median is None:
        return
    if yaw.count >= _FEW and yaw.low == yaw.high and not _stands(speed):
        yield f"the yaw rate is always {yaw.low:g} deg/s: is it the right signal?"
    if len(course.speed_s):
        sideways = np.abs(course.yaw_rate_rad_s * course.speed_at(course.yaw_rate_s))
        if (hard := float(np.nanquantile(sideways, 0.95))) > _MAX_LATERAL_MPS2:
            yield (
                f"speed times yaw rate is {plain(hard)} m/s² and more for 5 % of the time, which "
                "no tyre holds: degrees taken for radians, or a wrong unit of the speed?"
            )
    if abs(yaw.median) > 60.0:
        yield f"the yaw rate is {plain(yaw.median)} deg/s in the middle: is the unit right?"


def _stands(speed: Values) -> bool:
    """Whether the car is known not to have moved: then many a yaw rate is 0 to the last bit."""
    return speed.high is not None and max(abs(speed.low or 0.0), abs(speed.high)) < _STANDING_MPS


def untold_findings(
    profile: Profile, asked: Mapping[str, str | int] | None, seen: Observation, course: EgoCourse
) -> Iterator[Finding]:
    """What an `[[ego]]` gives and never told, although its messages came."""
    told = {"speed": course.speed_s, "yaw rate": course.yaw_rate_s, "pose": course.pose_s}
    for ego in profile.ego:
        if not all(has_come(part.address, (asked or {}).get(ego.bus), seen) for part in ego.parts):
            continue
        gives = {"speed": "speed" in ego.numbers, "yaw rate": "yaw_rate" in ego.numbers}
        gives["pose"] = bool(ego.pose_columns)
        for what in (what for what in gives if gives[what] and not len(told[what])):
            yield Finding(
                about="ego",
                text=f"there is no {what}, although {ego.name.removeprefix('ego ')} came: `valid` "
                "or `when` never holds"
                + (", or hold_s is shorter than its messages are apart" if ego.parts[1:] else ""),
            )


def _ego_fit(one: Fit) -> Iterator[str]:
    if one.pairs >= MIN_PAIRS and one.spread >= _CLEAR and abs(one.correlation or 0.0) <= 0.3:
        yield f"the poses do not change as the {one.what} says: another signal, or byte order"
    if not tells(one) or one.correlation is None or one.slope is None:
        return
    if one.correlation < -0.3:
        yield f"the poses change against the {one.what}: one of the two has the wrong sign"
    elif one.correlation > 0.3 and (factor := wrong_factor(one)):
        yield (
            f"the poses change by {one.slope:.3g} of what the {one.what} says"
            f"{unit_hint(1.0 / factor, one)}"
        )
