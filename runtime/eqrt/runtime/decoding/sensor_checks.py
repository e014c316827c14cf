"""What the keys of a sensor must be together, before any name is looked up in a DBC."""

from __future__ import annotations

import math

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding.profile_schema import PartTable, SensorTable
from eqrt.runtime.protection.source_health import DEFAULT_SILENCE_S

SLOT_ID = "slot"
"""The `id` of objects that are known by their slot."""

MAX_TIME_S = 10.0
"""Of timeouts; more is a slip of the unit."""


def check_sensor(table: SensorTable, where: str) -> None:
    """Raises ProfileError, led by `where`."""
    for check in (_framing, _parts, _position, _velocity, _numbers):
        for problem in check(table):
            raise ProfileError(f"{where}: {problem}")


def _framing(table: SensorTable) -> list[str]:
    problems = []
    counted, slots = table.framing == "counted", table.framing == "slots"
    if counted and (table.header is None or table.header.count is None):
        problems.append('framing = "counted" needs a [sensor.header] with message and count')
    if table.framing == "single" and table.header is not None:
        problems.append('framing = "single" has no header; remove [sensor.header]')
    if slots and table.slots is None:
        problems.append('framing = "slots" needs slots = { first = ..., last = ... }')
    if not slots and table.slots is not None:
        problems.append(f'slots belongs to framing = "slots", and framing is "{table.framing}"')
    if counted and table.fields.id == SLOT_ID:
        problems.append('framing = "counted" has no slots; fields.id must name a signal')
    return problems


def _parts(table: SensorTable) -> list[str]:
    problems = [] if table.messages else ["messages is empty; name the messages of an object"]
    if table.framing == "single" and len(table.messages) > 1:
        problems.append('framing = "single" has one message; use "slots" to join several')
    for i, (name, part) in enumerate(table.messages.items()):
        if not isinstance(part, PartTable):
            continue
        if part.optional and i == 0:
            problems.append(f"messages.{name}: the first message has every object, not optional")
        if part.per_cycle is not None and (table.framing != "counted" or part.per_cycle < 1):
            problems.append(f'messages.{name}: per_cycle is for "counted" framing, and at least 1')
        if part.id is not None and table.framing != "counted":
            problems.append(f'messages.{name}: id joins messages of "counted" framing only')
    return problems


def _position(table: SensorTable) -> list[str]:
    fields = table.fields
    cartesian = (fields.x is not None) + (fields.y is not None)
    polar = (fields.range is not None) + (fields.azimuth is not None)
    if (cartesian, polar) in ((2, 0), (0, 2)):
        return []
    return ["fields must have a position: x and y, or range and azimuth"]


def _velocity(table: SensorTable) -> list[str]:
    fields, kind = table.fields, table.velocity
    has_vector = fields.velocity_x is not None or fields.velocity_y is not None
    has_rate = fields.range_rate is not None
    wanted = {"none": (False, False), "radial": (False, True)}.get(kind, (True, False))
    if (has_vector, has_rate) == wanted:
        return []
    needs = {"none": "no velocity field", "radial": "fields.range_rate and no velocity_x or _y"}
    need = needs.get(kind, "fields.velocity_x or velocity_y (both if known) and no range_rate")
    return [f'velocity = "{kind}" goes with {need}']


def silence_of(table: SensorTable) -> float:
    """Time without a cycle that means that the sensor is silent."""
    if table.silence_s is not None:
        return table.silence_s
    return max(DEFAULT_SILENCE_S, 2.0 * table.timeout_s)


def _numbers(table: SensorTable) -> list[str]:
    problems = []
    if table.silence_s is not None and not table.timeout_s < table.silence_s <= MAX_TIME_S:
        problems.append(
            f"silence_s is {table.silence_s}, expected above timeout_s ({table.timeout_s:g}) to "
            f"{MAX_TIME_S:g}"
        )
    if not 0.0 < table.timeout_s <= MAX_TIME_S:
        problems.append(f"timeout_s is {table.timeout_s}, expected above 0 to {MAX_TIME_S:g}")
    mount = table.mount
    if not all(map(math.isfinite, (mount.x_m, mount.y_m, mount.yaw_deg))):
        problems.append("mount must be finite numbers")
    return problems
