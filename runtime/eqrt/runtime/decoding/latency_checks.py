"""How late input may come to be of use, and whether the latencies of a profile leave it any."""

from __future__ import annotations

from collections.abc import Iterator

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding.profile_schema import EgoTable, ProfileTable, SensorTable

MAX_INPUT_AGE_S = 1.0
"""Input that is older when it comes is not used: sensors may say how old their measurements are,
and a bit that is flipped there must not undo everything that came since."""
MAX_EXTRAPOLATION_S = 0.2
"""How far past the time when speed and yaw rate (or, without them, the pose) were last known, they
are held."""
MAX_POSE_AGE_S = 0.5
"""So long after the newest map pose, dead reckoning from it still counts as a place in the map."""


def check_latencies(table: ProfileTable, where: str) -> None:
    """Raises ProfileError, led by `where`, for a latency with which a source is never of use."""
    tables: list[SensorTable | EgoTable] = [*table.sensor, *table.ego]
    names = [f"sensor[{i}]" for i in range(len(table.sensor))]
    names += [f"ego[{i}]" for i in range(len(table.ego))]
    for name, source in zip(names, tables, strict=True):
        if not 0.0 <= source.latency_s < MAX_INPUT_AGE_S:
            raise ProfileError(
                f"{where}: {name}: latency_s is {source.latency_s}, expected 0 to below "
                f"{MAX_INPUT_AGE_S:g}: older input is not used"
            )
    for name, ego, held_s, what in _held(table.ego):
        for sensor in table.sensor:
            limit_s = round(sensor.latency_s + held_s, 6)
            if ego.latency_s > limit_s:
                raise ProfileError(
                    f"{where}: {name}: latency_s is {ego.latency_s}, expected at most {limit_s:g}: "
                    f"the sensor {sensor.name!r} has latency_s = {sensor.latency_s:g}, and {what} "
                    f"for {held_s:g} s at most"
                )


def _held(egos: list[EgoTable]) -> Iterator[tuple[str, EgoTable, float, str]]:
    """Of each source of the ego's motion or pose: how long its word is good for, and why."""
    reckons = any(x.fields.speed is not None for x in egos) and any(
        x.fields.yaw_rate is not None for x in egos
    )
    for i, ego in enumerate(egos):
        moves = ego.fields.speed is not None or ego.fields.yaw_rate is not None
        has_pose = ego.fields.x is not None or ego.fields.latitude is not None
        if moves if reckons else has_pose:
            yield f"ego[{i}]", ego, MAX_EXTRAPOLATION_S, "the ego motion is extrapolated"
        elif has_pose:
            yield f"ego[{i}]", ego, MAX_POSE_AGE_S, "a pose is believed"
