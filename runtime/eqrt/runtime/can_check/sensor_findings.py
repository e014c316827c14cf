"""What looks wrong with the values of one sensor, in plain words that say what to look at."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from eqrt.core.frames import Pose2
from eqrt.runtime.can_check.ego_course import EgoCourse
from eqrt.runtime.can_check.motion_findings import motion_texts
from eqrt.runtime.can_check.objects import Objects
from eqrt.runtime.can_check.plain import plain
from eqrt.runtime.can_check.report import Finding, Sensor, Values

_MAX_SPEED_MPS, _MAX_RANGE_M = 90.0, 400.0
_FEW = 30


def sensor_findings(
    sensor: Sensor, objects: Objects, course: EgoCourse, mount: Pose2
) -> Iterator[Finding]:
    """Everything about one sensor's objects."""
    texts: list[str] = [*_cycle_texts(sensor)]
    if sensor.objects:
        texts += [text for check in _VALUE_CHECKS for text in check(_by_name(sensor.values))]
        texts += _constant_texts(sensor)
        texts += _place_texts(sensor, objects)
        texts += motion_texts(sensor, objects, course, mount)
    for text in texts:
        yield Finding(about=sensor.name, text=text)


def _cycle_texts(sensor: Sensor) -> Iterator[str]:
    cycles = sensor.cycles.count
    if not cycles:
        yield "no cycle was closed: without its first message (or header) nothing is decoded"
        return
    if sensor.incomplete > max(1, 0.05 * cycles):
        yield (
            f"{sensor.incomplete} of {cycles} cycles are incomplete: messages are missing, "
            "timeout_s is too short, or the framing is another"
        )
    if not sensor.objects:
        yield "no cycle has a valid object: is the condition `valid` right?"


def _speed_texts(rows: dict[str, Values]) -> Iterator[str]:
    for name in ("velocity_x", "velocity_y", "range_rate"):
        row = rows.get(name)
        if row is None or row.p5 is None or row.p95 is None:
            continue
        if max(abs(row.p5), abs(row.p95)) > _MAX_SPEED_MPS:
            span = f"{plain(row.low)} to {plain(row.high)}"
            yield f"{name} goes from {span} m/s: unit, sign or byte order"


def _range_texts(rows: dict[str, Values]) -> Iterator[str]:
    row = rows["range"]
    if row.median is not None and (row.p95 or 0.0) > _MAX_RANGE_M:
        yield (
            f"5 % of the objects are more than {plain(row.p95)} m away: unit or byte order of x, y"
        )
    if row.median is not None and row.count >= _FEW and (row.p95 or 0.0) < 2.0:
        yield f"95 % of the objects are nearer than {row.p95:.2f} m: is the unit right?"


def _constant_texts(sensor: Sensor) -> Iterator[str]:
    rows = _by_name(sensor.values)
    if sensor.cycles.count < _FEW:
        return
    for name in ("x", "y", "velocity_x", "velocity_y", "range_rate"):
        row = rows.get(name)
        if row is None or row.count < _FEW:
            continue
        if row.missing == 1.0:
            yield f"{name} is never known: `when` or the signal is wrong, or the sensor lacks it"
        elif row.low == row.high:
            yield f"{name} is always {row.low:g}: another signal, or the sensor does not fill it"


def _size_texts(rows: dict[str, Values]) -> Iterator[str]:
    for name in ("length", "width"):
        row = rows[name]
        if row.median is not None and not 0.0 <= row.median <= 30.0:
            yield f"{name} is {row.median:g} m in the middle: is the unit right?"
    row = rows["existence"]
    if row.low is not None and row.high is not None and not -0.001 < row.low <= row.high < 1.001:
        yield f"existence goes from {row.low:g} to {row.high:g}, expected 0 to 1: set its unit"


_VALUE_CHECKS: tuple[Callable[[dict[str, Values]], Iterator[str]], ...] = (
    _speed_texts,
    _range_texts,
    _size_texts,
)


def _place_texts(sensor: Sensor, objects: Objects) -> Iterator[str]:
    x, y = objects.position.T
    if len(x) >= _FEW and (share := float((x < 0.0).mean())) > 0.8:
        yield (
            f"{share:.0%} of the objects are behind the sensor (x < 0). x points where the sensor "
            "looks: is its sign right? A sensor that looks backward has mount.yaw_deg = 180"
        )
    if sensor.jumps > 0.02:
        yield (
            f"{sensor.jumps:.0%} of the steps from cycle to cycle are longer than a vehicle can "
            "move: byte order, start bit, or `id` is wrong"
        )
    if len(y) >= _FEW and max(float((y > 0.0).mean()), float((y < 0.0).mean())) > 0.98:
        side = "left" if y[0] > 0.0 else "right"
        yield f"nearly all objects are on the {side}: right for a corner radar, not for a front one"


def _by_name(values: tuple[Values, ...]) -> dict[str, Values]:
    return {row.name: row for row in values}
