"""The pictures of `--plot`: where objects are, how far, how fast, and how the car moves."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import EqrtError
from eqrt.core.files import write_whole
from eqrt.core.frames import Pose2
from eqrt.runtime.can_check.chart import Marks, Panel, figure
from eqrt.runtime.can_check.check import Checked
from eqrt.runtime.can_check.ego_course import EgoCourse
from eqrt.runtime.can_check.motion import Pairs, axis_pairs, distance_pairs
from eqrt.runtime.can_check.objects import Objects, along_sight
from eqrt.runtime.decoding.detections import VelocityKind
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.decoding.sensor_profile import SensorProfile

Float64 = NDArray[np.float64]

MOST_DRAWN = 12_000
"""Measurements in one picture; of a longer log every n-th cycle is drawn."""
_STILL_MPS = 1.0
_NO_PART_OF_A_NAME = re.compile(r"[\0/\\]")  # a sensor may be called front/left
_TRACK_COLORS = ("blue", "orange", "green", "grey")


def write_pictures(folder: Path, profile: Profile, checked: Checked) -> list[Path]:
    """One SVG file for each; gives the paths. Raises EqrtError if the folder cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = []
        for name, text in _pictures(profile, checked):
            path = folder / f"{_NO_PART_OF_A_NAME.sub('-', name)}.svg"
            write_whole(path, text.encode())
            written.append(path)
    except OSError as error:
        raise EqrtError(
            f"cannot write into {folder} ({error.strerror}); give --plot another folder"
        ) from error
    return written


def _pictures(profile: Profile, checked: Checked) -> Iterator[tuple[str, str]]:
    start_s = _start_s(checked)
    for sensor in profile.sensors:
        objects = checked.objects[sensor.name]
        if not len(objects.time_s):
            continue
        every = -(-len(objects.time_s) // MOST_DRAWN)
        drawn = objects.cycle % every == 0
        title = f"{sensor.name}: {len(objects.time_s)} measurements"
        title += f", one cycle in {every} drawn" if every > 1 else ""
        yield f"{sensor.name}-places", figure(title, [[_places(objects, drawn)]])
        yield f"{sensor.name}-range", figure(title, [[_ranges(objects, drawn, start_s)]])
        if panels := _velocities(objects, checked.course, sensor):
            yield f"{sensor.name}-velocity", figure(f"{sensor.name}: said and done", [panels])
    if panels := _ego(checked.course, start_s):
        yield "ego", figure("ego vehicle", [[panel] for panel in panels])


def _start_s(checked: Checked) -> float:
    """When the first thing was decoded."""
    times = [objects.time_s for objects in checked.objects.values()]
    times += [checked.course.speed_s, checked.course.yaw_rate_s]
    return min((float(some.min()) for some in times if len(some)), default=0.0)


def _places(objects: Objects, drawn: NDArray[np.bool_]) -> Panel:
    """From above, as the driver sees it: ahead is up, y grows to the left."""
    seen = np.stack([objects.position[:, 1], objects.position[:, 0]], axis=-1)
    rate = along_sight(objects)
    groups = {
        "comes nearer": ("orange", rate < -_STILL_MPS),
        "goes away": ("blue", rate > _STILL_MPS),
        "neither (within 1 m/s)": ("green", np.abs(rate) <= _STILL_MPS),
        "velocity not known": ("grey", ~np.isfinite(rate)),
    }
    marks = [
        Marks(lines=[seen[which & drawn]], color=color, label=label)
        for label, (color, which) in groups.items()
    ]
    sensor = Marks(lines=[np.zeros((1, 2))], color="ink", label="sensor", size=9)
    return Panel(
        title="where objects are, by the velocity along the line of sight",
        x_label="y, m (left is positive)",
        y_label="x, m (ahead)",
        marks=[*marks, sensor],
        width=760,
        height=640,
        equal=True,
        x_reversed=True,
    )


def _ranges(objects: Objects, drawn: NDArray[np.bool_], start_s: float) -> Panel:
    """A line for each track: unbroken and smooth where ids and cycles are right."""
    points = np.stack([objects.time_s - start_s, objects.range_m], axis=-1)[drawn]
    track = objects.track[drawn]
    lines = np.split(points, np.flatnonzero(np.diff(track)) + 1)
    marks = [
        Marks(lines=lines[i :: len(_TRACK_COLORS)], color=color, joined=True)
        for i, color in enumerate(_TRACK_COLORS)
    ]
    return Panel(
        title="distance of each object over time; colours only tell neighbours apart",
        x_label="s",
        y_label="distance, m",
        marks=marks,
        width=1000,
        height=460,
    )


def _velocities(objects: Objects, course: EgoCourse, sensor: SensorProfile) -> list[Panel]:
    """What the sensor says about motion, against what its positions do."""
    kind, mount = objects.kind, sensor.mount
    if kind is VelocityKind.NONE:
        return []
    panels = [_velocity(distance_pairs(objects, course, mount, kind), "distance")]
    if kind is not VelocityKind.RADIAL:
        panels += [_axis(objects, course, mount, axis) for axis in ("x", "y")]
    return [panel for panel in panels if panel.marks]


def _axis(objects: Objects, course: EgoCourse, mount: Pose2, axis: str) -> Panel:
    return _velocity(axis_pairs(objects, course, mount, axis), axis)


def _velocity(found: Pairs, what: str) -> Panel:
    points = np.stack([found.said, found.changed], axis=-1)
    points = points[:: -(-len(points) // MOST_DRAWN) or 1]
    marks = []
    if len(points):
        low, high = np.quantile(points, (0.002, 0.998))
        ends = np.array([[low, low], [high, high]])
        marks = [
            Marks(lines=[points], color="blue", label="measured"),
            Marks(lines=[ends], color="orange", label="right", joined=True, dashed=True),
        ]
    return Panel(
        title=f"velocity and change of {what}",
        x_label="velocity says, m/s",
        y_label=f"{what} changes by, m/s",
        marks=marks,
        equal=True,
    )


def _ego(course: EgoCourse, start_s: float) -> list[Panel]:
    rows = (
        ("speed", "m/s", 5.0, course.speed_s, course.speed_mps),
        ("yaw rate (left is positive)", "deg/s", 2.0, course.yaw_rate_s, course.yaw_rate_rad_s),
    )
    panels = []
    for title, unit, flat, time_s, numbers in rows:
        if not len(time_s):
            continue
        shown = np.degrees(numbers) if unit == "deg/s" else numbers
        line = np.stack([time_s - start_s, shown], axis=-1)
        line = line[:: -(-len(line) // MOST_DRAWN)]
        marks = [Marks(lines=[line], color="blue", joined=True)]
        panels.append(
            Panel(
                title=title,
                x_label="s",
                y_label=unit,
                marks=marks,
                width=1000,
                height=300,
                flat=flat,
            )
        )
    return panels
