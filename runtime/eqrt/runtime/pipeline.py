"""From CAN messages to predictions, as one function of its inputs.

    messages -> Decoder -> detections -> EgoTracker -> TrackStore -> scene -> Predictor -> guard

The pipeline opens nothing and waits for nothing: `serve` gives it messages and the monotonic clock,
`replay` gives it a log and the log's clock, and the same messages make the same predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import can
import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.frames import Pose2
from eqrt.core.lane_choice import centerline_source
from eqrt.core.scene import AgentHistories, Scene, build_scene, concatenate, tile_origin
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import Detections, EgoMotion, EgoPose
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.prediction.guard import Guarded, guard
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.runtime.prediction.tiles import Tile
from eqrt.runtime.tracking.ego import EgoState, EgoTracker
from eqrt.runtime.tracking.tracks import Tracks, TrackStore

MIN_PERIOD = 0.6
"""Cycles closer together than this many model steps share a prediction: radars send up to 20 Hz."""
TARGET_AGE_S = 0.3
"""A track unseen for longer is not predicted any more."""
NEIGHBOR_AGE_S = 0.5
"""A track unseen for longer does not stand in any target's scene: `scene.RECENT_STEPS`."""
SILENT_PERIODS = 3
"""After this many model steps without a cycle, everything said before is void."""
_FINISH_S = 1.0  # longer than any profile's timeout
_CONTROL_S = 0.01  # how often silence and unfinished cycles are looked for
_MAX_CLOCK_STEP_S = 1.0  # a cycle older than the newest by more: the clock was set back

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(slots=True)
class StageTimes:
    """Seconds that the newest prediction spent, by stage; all 0 without a clock."""

    tracks_s: float = 0.0
    scene_s: float = 0.0
    infer_s: float = 0.0
    guard_s: float = 0.0


@dataclass(slots=True)
class PipelineCounters:
    """What the pipeline made of its input; the parts have counters of their own."""

    cycles: int = 0
    """Predictions made, also those of nothing."""
    targets: int = 0
    fallbacks: int = 0
    """Targets whose prediction the guard refused."""
    skipped: int = 0
    """Sensor cycles measured before or too soon after a prediction to get their own."""


class Pipeline:
    """The state between messages: open cycles, ego motion, tracks."""

    def __init__(
        self,
        profile: Profile,
        predictor: Predictor,
        tile: Tile | None = None,
        *,
        channels: Mapping[str, str | int] | None = None,
        stationary: bool = False,
        clock: Callable[[], float] | None = None,
    ) -> None:
        """`channels`: role of a bus in the profile -> channel; None = every role is anywhere.

        `stationary`: the sensor stands still, and nothing on the bus says so. `clock` tells the
        pipeline's time while it computes; None = no time passes (replay).
        """
        self.decoder = Decoder(profile, channels, tile.info.origin_deg if tile else None)
        self.ego = EgoTracker(
            yaw_rate_bias_rad_s=profile.yaw_rate_bias_rad_s,
            stationary=stationary or not profile.has_ego,
        )
        self.tracks = TrackStore()
        self.counters = PipelineCounters()
        self.times = StageTimes()
        self.profile = profile
        self.predictor = predictor
        self.tile = tile
        self._lanes = centerline_source(tile.lane_map, predictor.contract) if tile else None
        self._clock = clock
        self._nobody = _nobody(predictor.contract)
        self._controlled_s = -np.inf
        self._predicted_s = -np.inf
        self._silent_due_s = np.inf

    def feed(self, message: can.Message, timestamp_s: float) -> list[ForecastSet]:
        """Take one message that arrived at `timestamp_s`; predict if it completed a cycle."""
        events = self.decoder.feed(message, timestamp_s)
        if not events:
            return _NOTHING
        return self._handle_all(events, timestamp_s)

    def poll(self, now_s: float) -> list[ForecastSet]:
        """Close cycles whose rest does not come, and say so when nothing comes any more."""
        if abs(now_s - self._controlled_s) < _CONTROL_S:
            return _NOTHING
        self._controlled_s = now_s
        made = self._handle_all(self.decoder.poll(now_s), now_s)
        if now_s >= self._silent_due_s and not made:
            dt_s = self.predictor.contract.dt_s
            self._silent_due_s = now_s + dt_s - (now_s - self._silent_due_s) % dt_s
            made.append(self._silence(now_s))
        return made

    def finish(self, now_s: float) -> list[ForecastSet]:
        """Nothing more will come: close the cycles that are open."""
        return self._handle_all(self.decoder.poll(now_s + _FINISH_S), now_s)

    def _handle_all(self, events: list[Event], now_s: float) -> list[ForecastSet]:
        return [made for event in events if (made := self._handle(event, now_s)) is not None]

    def _handle(self, event: Event, now_s: float) -> ForecastSet | None:
        if isinstance(event, EgoMotion):
            self.ego.motion(event)
            return None
        if isinstance(event, EgoPose):
            self.ego.pose(event)
            return None
        return self._cycle(event, now_s)

    def _cycle(self, detections: Detections, now_s: float) -> ForecastSet | None:
        started_s = self._time(now_s)
        timestamp_s = detections.timestamp_s
        ego = self.ego.at(timestamp_s)
        self.tracks.update(detections, ego, self.profile.sensor(detections.sensor).mount)
        self._silent_due_s = now_s + SILENT_PERIODS * self.predictor.contract.dt_s
        since_s = timestamp_s - self._predicted_s
        if -_MAX_CLOCK_STEP_S <= since_s < MIN_PERIOD * self.predictor.contract.dt_s:
            self.counters.skipped += 1
            return None
        self._predicted_s = timestamp_s
        self.times.tracks_s = self._time(now_s) - started_s
        return self._predict(ego, _Moment(timestamp_s, now_s, started_s))

    def _predict(self, ego: EgoState | None, moment: _Moment) -> ForecastSet:
        tracks = self.tracks.snapshot(moment.measured_s, NEIGHBOR_AGE_S)
        alive = tracks.timestamp_s >= moment.measured_s - TARGET_AGE_S
        if ego is None or not alive.any():
            return self._forecast(*self._nobody, ego, moment)
        begun_s = self._time(moment.now_s)
        scene, targets = self._targets(tracks, alive, ego)
        scene_s = self._time(moment.now_s)
        prediction = self.predictor.predict(scene)
        infer_s = self._time(moment.now_s)
        guarded = guard(
            prediction.trajectories,
            prediction.probabilities.astype(np.float64),
            targets.history,
            targets.valid,
            self.predictor.contract.dt_s,
        )
        self.times.scene_s, self.times.infer_s = scene_s - begun_s, infer_s - scene_s
        self.times.guard_s = self._time(moment.now_s) - infer_s
        self.counters.fallbacks += int(np.count_nonzero(~guarded.accepted))
        return self._forecast(targets, guarded, ego, moment)

    def _targets(self, tracks: Tracks, alive: Bool, ego: EgoState) -> tuple[Scene, _Targets]:
        """Every track that is alive as a target, its history ending at its own last measurement.

        Targets measured at the same time share a clock, so one scene is built per time.
        """
        origin = tile_origin(np.array([ego.map_from_ego.x_m, ego.map_from_ego.y_m]))
        scenes, parts = [], []
        for anchor_s in np.unique(tracks.timestamp_s[alive]):
            rows = np.flatnonzero(tracks.timestamp_s == anchor_s)
            agents = self._agents(tracks, float(anchor_s))
            scenes.append(self._scene(agents, rows, ego, origin))
            parts.append(_Targets.of(tracks, agents, rows))
        return concatenate(scenes), _Targets.join(parts)

    def _scene(
        self, agents: AgentHistories, targets: NDArray[np.intp], ego: EgoState, origin: Float64
    ) -> Scene:
        lanes = self._lanes if ego.has_map_pose else None
        return build_scene(agents, targets, self.predictor.contract, lanes, origin)

    def _agents(self, tracks: Tracks, anchor_s: float) -> AgentHistories:
        """All tracks, and the ego vehicle after them, on the clock that ends at `anchor_s`."""
        contract = self.predictor.contract
        steps, dt_s = contract.history_steps, contract.dt_s
        positions, valid = self.tracks.history(anchor_s, steps, dt_s, tracks.row)
        facing = np.stack([np.cos(tracks.heading_rad), np.sin(tracks.heading_rad)], axis=-1)
        heading = np.where(np.isfinite(facing), facing, 0.0)
        past = [self.ego.map_from_ego(anchor_s - k * dt_s) for k in range(steps - 1, -1, -1)]
        own = [(np.nan, np.nan) if pose is None else (pose.x_m, pose.y_m) for pose in past]
        seen = [pose is not None for pose in past]
        return AgentHistories(
            positions=np.concatenate([positions, np.array(own)[None]]),
            valid=np.concatenate([valid, np.array(seen)[None]]),
            heading=np.concatenate([heading, np.zeros((1, 2))]),
        )

    def _forecast(
        self, targets: _Targets, guarded: Guarded, ego: EgoState | None, moment: _Moment
    ) -> ForecastSet:
        made_s = self._time(moment.now_s)
        compute_s = made_s - moment.started_s
        self.counters.cycles += 1
        self.counters.targets += len(targets.track_id)
        seen = np.where(targets.valid.all(axis=1), Mode.RUN, Mode.PARTIAL)
        return ForecastSet(
            cycle=self.counters.cycles - 1,
            timestamp_s=moment.measured_s,
            made_s=made_s,
            compute_s=compute_s,
            mode=self._mode(ego, guarded, compute_s),
            model_id=self.predictor.model_id,
            tile_id=self.tile.info.tile_id if self.tile else "",
            map_from_ego=ego.map_from_ego if ego else Pose2(),
            ego_speed_mps=ego.velocity[0] if ego else np.nan,
            dt_s=self.predictor.contract.dt_s,
            track_id=targets.track_id,
            object_id=targets.object_id,
            anchor_s=targets.anchor_s,
            agent_mode=np.where(guarded.accepted, seen, Mode.FALLBACK).astype(np.uint8),
            position=targets.history[:, -1],
            velocity=guarded.velocity,
            heading_rad=targets.heading_rad,
            object_class=targets.object_class,
            length_m=targets.length_m,
            width_m=targets.width_m,
            history=targets.history,
            history_valid=targets.valid,
            trajectories=guarded.trajectories,
            probabilities=guarded.probabilities,
        )

    def _mode(self, ego: EgoState | None, guarded: Guarded, compute_s: float) -> Mode:
        if len(guarded.accepted) and not guarded.accepted.any():
            return Mode.FALLBACK
        if ego is None or (self.tile is not None and not ego.has_map_pose):
            return Mode.NO_POSE
        if compute_s > self.predictor.contract.dt_s:
            return Mode.LATE
        return Mode.RUN if self.tile else Mode.NO_MAP

    def _silence(self, now_s: float) -> ForecastSet:
        said = self._forecast(*self._nobody, None, _Moment(self._predicted_s, now_s, now_s))
        return replace(said, mode=Mode.SILENT)

    def _time(self, now_s: float) -> float:
        return now_s if self._clock is None else self._clock()


@dataclass(frozen=True, slots=True)
class _Moment:
    """When a prediction is made, on the pipeline's clock."""

    measured_s: float
    """The newest measurement in it."""
    now_s: float
    """The message that completed the cycle arrived."""
    started_s: float
    """Work on it began."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Targets:
    """The targets of one prediction, B of them."""

    track_id: NDArray[np.int64]
    object_id: NDArray[np.int64]
    anchor_s: Float64
    heading_rad: Float64
    object_class: NDArray[np.uint8]
    length_m: Float64
    width_m: Float64
    history: Float64
    """(B, T, 2) map frame; the last step is a measurement."""
    valid: Bool
    """(B, T)"""

    @classmethod
    def of(cls, tracks: Tracks, agents: AgentHistories, rows: NDArray[np.intp]) -> _Targets:
        """The tracks `rows`, on the clock of `agents`."""
        return cls(
            track_id=tracks.track_id[rows],
            object_id=tracks.object_id[rows],
            anchor_s=tracks.timestamp_s[rows],
            heading_rad=tracks.heading_rad[rows],
            object_class=tracks.object_class[rows],
            length_m=tracks.length_m[rows],
            width_m=tracks.width_m[rows],
            history=agents.positions[rows],
            valid=agents.valid[rows],
        )

    @classmethod
    def join(cls, parts: list[_Targets]) -> _Targets:
        """The targets of all parts."""
        names = [f.name for f in fields(cls)]
        return cls(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


def _nobody(contract: ModelContract) -> tuple[_Targets, Guarded]:
    """No targets, and the prediction of none."""
    targets = _Targets(
        track_id=np.zeros(0, np.int64),
        object_id=np.zeros(0, np.int64),
        anchor_s=np.zeros(0),
        heading_rad=np.zeros(0),
        object_class=np.zeros(0, np.uint8),
        length_m=np.zeros(0),
        width_m=np.zeros(0),
        history=np.zeros((0, contract.history_steps, 2)),
        valid=np.zeros((0, contract.history_steps), np.bool_),
    )
    shape = (0, contract.num_modes, contract.horizon_steps, 2)
    guarded = Guarded(np.zeros(shape), np.zeros(shape[:2]), np.zeros(0, np.bool_), np.zeros((0, 2)))
    return targets, guarded


_NOTHING: list[ForecastSet] = []
