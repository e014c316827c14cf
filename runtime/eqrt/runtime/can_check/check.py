"""From what was seen to the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from eqrt.runtime.can_check.ego_course import EgoCourse, course_of
from eqrt.runtime.can_check.ego_findings import ego_findings, untold_findings
from eqrt.runtime.can_check.message_findings import (
    both_bus_findings,
    clock_findings,
    left_out_findings,
    message_findings,
    other_bus_findings,
)
from eqrt.runtime.can_check.motion import ego_fits, object_fits, share_of_jumps
from eqrt.runtime.can_check.objects import Objects, classes, gather, object_values, values
from eqrt.runtime.can_check.observation import Observation
from eqrt.runtime.can_check.offsets import offset_findings
from eqrt.runtime.can_check.report import SCHEMA, Ego, Finding, Report, Sensor
from eqrt.runtime.can_check.sensor_findings import sensor_findings
from eqrt.runtime.can_check.traffic import channels, profile_messages, rhythm, unknown_messages
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.decoding.sensor_profile import SensorProfile


@dataclass(frozen=True, slots=True)
class Checked:
    """The report, and the arrays behind it, which are drawn."""

    report: Report
    objects: dict[str, Objects]
    """By the name of the sensor."""
    course: EgoCourse


def check(
    profile: Profile,
    seen: Observation,
    log: str,
    asked: Mapping[str, str | int] | None = None,
) -> Checked:
    """Everything that can be said about what was seen, of the channels `asked` for, by bus."""
    course = course_of(seen)
    objects = {sensor.name: _objects(sensor, seen) for sensor in profile.sensors}
    sensors = tuple(
        _sensor(sensor, objects[sensor.name], seen, course) for sensor in profile.sensors
    )
    rows = profile_messages(profile, seen)
    unknown, rest = unknown_messages(profile, seen)
    ego = _ego(seen, course)
    findings: list[Finding] = [*message_findings(rows), *offset_findings(profile, seen)]
    findings += other_bus_findings(profile, asked, seen) if asked else both_bus_findings(rows)
    findings += left_out_findings(profile, seen.counters)
    for bound, sensor in zip(profile.sensors, sensors, strict=True):
        findings += sensor_findings(sensor, objects[sensor.name], course, bound.mount)
    findings += ego_findings(ego.values, ego.fits, course)
    findings += untold_findings(profile, asked, seen, course)
    findings += clock_findings(seen)
    report = Report(
        schema=SCHEMA,
        log=log,
        profile=profile.name,
        messages=seen.counters.messages,
        seconds=seen.seconds,
        decoded=bool(seen.counters.objects or seen.motions or seen.poses),
        counters=asdict(seen.counters),
        channels=channels(profile, seen),
        profile_messages=rows,
        unknown=unknown,
        unknown_rest=rest,
        sensors=sensors,
        ego=ego,
        findings=tuple(findings),
    )
    return Checked(report, objects, course)


def _objects(sensor: SensorProfile, seen: Observation) -> Objects:
    cycles = [one for one in seen.detections if one.sensor == sensor.name]
    return gather(cycles, sensor.velocity_kind)


def _sensor(
    sensor: SensorProfile, objects: Objects, seen: Observation, course: EgoCourse
) -> Sensor:
    cycles = [one for one in seen.detections if one.sensor == sensor.name]
    counts = [len(one.object_id) for one in cycles]
    per_cycle = tuple(np.quantile(counts, (0.0, 0.5, 1.0)).tolist()) if counts else ()
    return Sensor(
        name=sensor.name,
        velocity=sensor.velocity_kind.name.lower(),
        mount=sensor.place,
        cycles=rhythm(np.array([one.timestamp_s for one in cycles]), seen),
        incomplete=sum(not one.complete for one in cycles),
        objects=len(objects.time_s),
        objects_per_cycle=per_cycle,
        ids=len(np.unique(objects.object_id)),
        values=object_values(objects),
        classes=classes(objects),
        fits=object_fits(objects, course, sensor.mount),
        jumps=share_of_jumps(objects),
    )


def _ego(seen: Observation, course: EgoCourse) -> Ego:
    return Ego(
        speed=rhythm(course.speed_s, seen),
        yaw_rate=rhythm(course.yaw_rate_s, seen),
        poses=rhythm(course.pose_s, seen),
        values=(
            values("speed", "m/s", course.speed_mps),
            values("yaw rate", "deg/s", np.degrees(course.yaw_rate_rad_s)),
        ),
        fits=ego_fits(course),
    )
