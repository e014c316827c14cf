"""What a page is told: one binary update per cycle, JSON text for everything else.

An update is a uint32 (the length of its head), the head as JSON, zeros up to a multiple of 4 bytes,
then int16 arrays, all little endian: places in steps of `STEP_M` from the head's `origin`, as in
`eqrt.dbc`; `UNKNOWN` where there is none. 64 targets with 6 modes of 3 s take 60 kB.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from eqrt.core.metrics import LENGTH_OF_SHARE
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.prediction.tiles import Tile
from eqrt.runtime.view.hindsight import LOOK_BACK_S, Ghosts, Score
from eqrt.runtime.view.words import (
    AGENT_LEVELS,
    AGENT_STANDS,
    AGENT_WORDS,
    GOOD,
    LEVELS,
    class_words,
    drops,
    mode_words,
)

Float64 = NDArray[np.float64]

STEP_M = 0.02
UNKNOWN = -(2**15)
_LENGTH = struct.Struct("<I")
_MOVING_MPS = 0.5  # slower, the direction of a velocity says little about a heading
_JSON = msgspec.json.Encoder()


class Agents(msgspec.Struct, kw_only=True):
    """Columns, one value per target; None = not known. SI units, map frame, radians."""

    track_id: list[int]
    object_id: list[int]
    kind: list[str]
    words: list[str]
    """How it was predicted."""
    level: list[str]
    age_s: list[float]
    """From its last measurement to the finished prediction."""
    range_m: list[float | None]
    """From the ego reference point."""
    speed_mps: list[float | None]
    heading_rad: list[float | None]
    """As measured, else where it moves to."""
    length_m: list[float | None]
    width_m: list[float | None]
    probabilities: list[list[float]]
    error_m: list[list[float | None]]
    """What was predicted `LOOK_BACK_S` ago for now, from what was measured."""
    constant_velocity_error_m: list[list[float | None]]
    ellipses: list[list[tuple[float, float, float]]] | None
    """Half axes in m and direction of the first in rad, that hold half of the most probable mode's
    distribution after `LOOK_BACK_S`; None = the model tells no covariances.
    """


class Head(msgspec.Struct, kw_only=True):
    """What an update says beside places."""

    stream: int
    """Counts the starts of the service: cycles and tracks of another one are not the same."""
    cycle: int
    time_s: float
    made_s: float
    compute_s: float
    mode: str
    mode_words: str
    mode_since_s: float
    """Time of the first cycle in this mode."""
    level: str
    on_map: bool
    """Whether the map frame is that of the tile, so that lanes may be drawn."""
    lanes: int
    """Number of the message with the lanes around here; -1 = there is none."""
    ego: tuple[float, float, float] | None
    """x, y in m, yaw in rad, map frame; None = not known."""
    ego_speed_mps: float | None
    origin: tuple[float, float]
    step_m: float = STEP_M
    dt_s: float
    shape: tuple[int, int, int, int]
    """A, T, K, H."""
    agents: Agents
    score: Score | None


def encode_update(
    forecast: ForecastSet,
    *,
    ghosts: Ghosts,
    score: Score | None,
    stream: int,
    time_s: float,
    mode_since_s: float,
    lanes: int,
) -> bytes:
    """One cycle, and when it is to be shown. Places: position (A, 2), history (A, T, 2), ghosts
    (A, 3, 2), trajectories (A, K, H, 2).
    """
    origin = _origin(forecast)
    head = Head(
        stream=stream,
        cycle=forecast.cycle,
        time_s=time_s,
        made_s=forecast.made_s,
        compute_s=forecast.compute_s,
        mode=forecast.mode.name,
        mode_words=mode_words(forecast.mode, forecast.num_targets),
        mode_since_s=mode_since_s,
        level=LEVELS[forecast.mode],
        on_map=is_on_map(forecast),
        lanes=lanes,
        ego=ego_pose(forecast),
        ego_speed_mps=_known(forecast.ego_speed_mps),
        origin=origin,
        dt_s=forecast.dt_s,
        shape=(
            forecast.num_targets,
            forecast.history.shape[1],
            *forecast.trajectories.shape[1:3],
        ),
        agents=_agents(forecast, ghosts),
        score=score,
    )
    history = np.where(forecast.history_valid[..., None], forecast.history, np.nan)
    places = (forecast.position, history, ghosts.position, forecast.trajectories)
    text = _JSON.encode(head)
    padding = bytes(-(_LENGTH.size + len(text)) % 4)
    return b"".join(
        [_LENGTH.pack(len(text)), text, padding, *(_steps(values - origin) for values in places)]
    )


def encode_status(status: ServiceStatus, *, lost_cycles: int, shift_s: float = 0.0) -> str:
    """The service's own word, for the panels; `shift_s`: from its clock to that of the cycles."""
    return _text(
        "status",
        time_s=status.time_s + shift_s,
        seconds=status.seconds,
        uptime_s=status.uptime_s,
        eqrt=status.eqrt,
        profile=status.profile,
        model=status.model,
        model_id=status.model_id,
        tile=status.tile,
        objects=status.objects,
        messages=status.messages,
        latencies_s=[round(latency_s, 5) for latency_s in status.latencies_s],
        stages_s={name: round(s, 5) for name, s in status.stages_s.items()},
        drops=drops(status.totals),
        lost_cycles=lost_cycles,
        buses=[
            {"name": bus.channel, "state": bus.state, "since_s": bus.since_s}
            for bus in status.buses
        ],
        sources=[
            {"name": one.name, "reason": one.reason, "since_s": one.since_s}
            for one in status.sources
            if not one.valid
        ],
    )


def encode_lanes(tile: Tile, *, centre: tuple[float, float], radius_m: float, number: int) -> str:
    """The centerlines that pass within `radius_m` of `centre`, in centimetres from there.

    `number` tells one such message from another.
    """
    points, starts = tile.lane_map.points, tile.lane_map.lane_start
    near = (np.abs(points - np.array(centre, np.float32)) <= radius_m).all(axis=1)
    touched = np.add.reduceat(near, starts[:-1]) > 0
    lanes = [
        np.rint(100.0 * (points[starts[lane] : starts[lane + 1]].astype(float) - centre))
        .astype(int)
        .ravel()
        .tolist()
        for lane in np.flatnonzero(touched)
    ]
    info = tile.info
    return _text(
        "lanes",
        number=number,
        origin=centre,
        lanes=lanes,
        tile=info.tile_id,
        name=info.name,
        credit=info.credit,
    )


def encode_text(kind: str, **values: object) -> str:
    """Any other message: hello, silence, an index of a file."""
    return _text(kind, **values)


def decode_update(payload: bytes) -> tuple[dict[str, Any], dict[str, Float64]]:
    """Head and places (map frame, NaN = unknown) of an update; what the page does, for tests."""
    (length,) = _LENGTH.unpack_from(payload)
    head = msgspec.json.decode(payload[_LENGTH.size : _LENGTH.size + length])
    offset = -(-(_LENGTH.size + length) // 4) * 4
    agents, steps, num_modes, horizon = head["shape"]
    places = {}
    for name, shape in (
        ("position", (agents, 2)),
        ("history", (agents, steps, 2)),
        ("ghosts", (agents, len(LOOK_BACK_S), 2)),
        ("trajectories", (agents, num_modes, horizon, 2)),
    ):
        count = math.prod(shape)
        raw = np.frombuffer(payload, "<i2", count, offset).reshape(shape)
        offset += 2 * count
        place = raw * head["step_m"] + np.array(head["origin"])
        places[name] = np.where(raw == UNKNOWN, np.nan, place)
    return head, places


def is_on_map(forecast: ForecastSet) -> bool:
    """Whether the map frame is known to be that of a tile."""
    if forecast.mode is Mode.RUN:  # also on an empty road, which no lanes were asked for
        return True
    return bool(forecast.tile_id) and forecast.mode is not Mode.NO_POSE


def ego_pose(forecast: ForecastSet) -> tuple[float, float, float] | None:
    """x, y in m and yaw in rad in the map frame; None = not known.

    Older recordings have a pose of zeros there, but no speed.
    """
    pose = forecast.map_from_ego
    if pose is None or math.isnan(forecast.ego_speed_mps):
        return None
    return pose.x_m, pose.y_m, pose.yaw_rad


def _agents(forecast: ForecastSet, ghosts: Ghosts) -> Agents:
    modes = [Mode(number) for number in forecast.agent_mode.tolist()]
    stands = forecast.is_standstill_assumed.tolist()
    ego = ego_pose(forecast) or (math.nan, math.nan)
    return Agents(
        track_id=forecast.track_id.tolist(),
        object_id=forecast.object_id.tolist(),
        kind=[class_words(number) for number in forecast.object_class.tolist()],
        words=[
            AGENT_STANDS if stands[row] else AGENT_WORDS.get(mode, mode.name)
            for row, mode in enumerate(modes)
        ],
        level=[AGENT_LEVELS.get(mode, GOOD) for mode in modes],
        age_s=_rounded(forecast.age_s, 3),
        range_m=_rounded(np.linalg.norm(forecast.position - ego[:2], axis=-1), 1),
        speed_mps=_rounded(np.linalg.norm(forecast.velocity, axis=-1), 2),
        heading_rad=_rounded(course_rad(forecast), 4),
        length_m=_rounded(forecast.length_m, 2),
        width_m=_rounded(forecast.width_m, 2),
        probabilities=_rounded(forecast.probabilities, 3),
        error_m=_rounded(ghosts.error_m, 2),
        constant_velocity_error_m=_rounded(ghosts.constant_velocity_error_m, 2),
        ellipses=_ellipses(forecast),
    )


def course_rad(forecast: ForecastSet) -> Float64:
    """(A,) heading as measured, else the direction of the velocity, NaN = neither is known."""
    velocity = forecast.velocity
    moving = np.linalg.norm(velocity, axis=-1) > _MOVING_MPS
    course = np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)
    return np.where(np.isnan(forecast.heading_rad), course, forecast.heading_rad)


def _ellipses(forecast: ForecastSet) -> list[list[tuple[float, float, float]]] | None:
    """Of the elliptical exponential distribution (eqrt.core.metrics): S = C / 3."""
    if forecast.covariances is None:
        return None
    steps = [round(s / forecast.dt_s) - 1 for s in LOOK_BACK_S]
    steps = [step for step in steps if step < forecast.trajectories.shape[2]]
    values, vectors = np.linalg.eigh(forecast.covariances[:, 0, steps])
    half_axes = LENGTH_OF_SHARE[50] * np.sqrt(values.clip(0.0) / 3.0)
    direction = np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1])
    table = np.stack([half_axes[..., 1], half_axes[..., 0], direction], axis=-1)
    rounded: list[list[tuple[float, float, float]]] = _rounded(table, 3)
    return rounded


def _origin(forecast: ForecastSet) -> tuple[float, float]:
    """Near everything: the ego vehicle, or where its pose is not told, the targets."""
    if (ego := ego_pose(forecast)) is not None:
        return ego[0], ego[1]
    if not forecast.num_targets:
        return 0.0, 0.0
    x_m, y_m = np.median(forecast.position, axis=0).tolist()
    return x_m, y_m


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _rounded(values: Float64, digits: int) -> Any:
    """Nested lists; msgspec writes NaN as null."""
    return np.round(values, digits).tolist()


def _steps(metres: Float64) -> bytes:
    steps = np.rint(metres / STEP_M)
    steps[~(np.abs(steps) < -UNKNOWN)] = UNKNOWN
    return steps.astype("<i2").tobytes()


def _text(kind: str, **values: object) -> str:
    return _JSON.encode({"kind": kind, **values}).decode()
