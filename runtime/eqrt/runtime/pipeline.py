"""From CAN messages to predictions, as one function of its inputs.

    messages -> Decoder -> detections -> EgoTracker -> TrackStore -> Forecaster -> guard

The pipeline opens nothing and waits for nothing: `serve` gives it messages and the monotonic clock,
`replay` gives it a log and the log's clock, and the same messages make the same predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import can
import numpy as np

from eqrt.core.lane_choice import centerline_source
from eqrt.core.scene import CenterlineSource
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import Detections, EgoMotion, EgoPose
from eqrt.runtime.decoding.latency_checks import MAX_INPUT_AGE_S
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.prediction.forecaster import Deadline, Forecaster, Raw
from eqrt.runtime.prediction.guard import Guarded, guard
from eqrt.runtime.prediction.modes import ModeKeeper, agent_modes, cycle_reasons
from eqrt.runtime.prediction.targets import Targets
from eqrt.runtime.prediction.tiles import Tile
from eqrt.runtime.prediction.watched import Direct, Model, Runner, Watched
from eqrt.runtime.tracking.ego import EgoState, EgoTracker
from eqrt.runtime.tracking.track_history import MAX_GAP_S
from eqrt.runtime.tracking.tracks import TrackStore

SENSOR_TRACKS = 256
"""There is room for so many objects at a time, times the number of sensors: sensors count theirs in
eight bits."""
MIN_PERIOD = 0.6
"""Cycles closer together than this many model steps share a prediction: radars send up to 20 Hz."""
TARGET_AGE_S = MAX_GAP_S
"""A track unseen for longer is not predicted any more. How much later than those of other sensors
its sensor's cycles come is not held against it."""
NEIGHBOR_AGE_S = 0.5
"""A track unseen for longer does not stand in any target's scene: `scene.RECENT_STEPS`."""
SHED_PERIODS = 0.7
"""Of the model's period, counted from the arrival of a cycle's last message: what could not be
predicted by then is left to physics, so that the rest leaves in time and nothing queues up."""
SILENT_PERIODS = 3
"""After this many model steps without a prediction, everything said before is void."""
_FINISH_S = 1.0  # longer than any profile's timeout
_CONTROL_S = 0.01  # how often silence and unfinished cycles are looked for
_MAX_CLOCK_STEP_S = 1.0  # a cycle older than the newest by more: the clock was set back


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
    """Targets that the model failed on, or whose prediction the guard refused."""
    shed: int = 0
    """Targets for which there was no time."""
    model_errors: int = 0
    """Runs of the model that raised an error."""
    model_overruns: int = 0
    """Runs that were given up because their time was over."""
    model_restarts: int = 0
    """Times that the model was loaded anew because it was stuck or kept failing."""
    stale: int = 0
    """Cycles and ego messages that say themselves that they are older than MAX_INPUT_AGE_S."""
    skipped: int = 0
    """Sensor cycles measured before or too soon after a prediction to get their own."""


class Pipeline:
    """The state between messages: open cycles, ego motion, tracks."""

    def __init__(
        self,
        profile: Profile,
        predictor: Model,
        tile: Tile | None = None,
        *,
        channels: Mapping[str, str | int] | None = None,
        stationary: bool = False,
        clock: Callable[[], float] | None = None,
        run_by: Callable[[Model], Runner] | None = None,
    ) -> None:
        """`channels`: role of a bus in the profile -> channel; None = every role is anywhere.

        `stationary`: the sensor stands still, and nothing on the bus says so. `clock` tells the
        pipeline's time while it computes; None = no time passes (replay). `run_by` makes what runs
        the model; None = Watched with a clock, Direct without.
        """
        self.decoder = Decoder(profile, channels, _origin_of(tile))
        self.ego = EgoTracker(
            yaw_rate_bias_rad_s=profile.yaw_rate_bias_rad_s,
            stationary=stationary or not profile.has_ego,
        )
        steps, dt_s = predictor.contract.history_steps, predictor.contract.dt_s
        self.tracks = TrackStore(steps, dt_s, capacity=SENSOR_TRACKS * len(profile.sensors))
        self.counters = PipelineCounters()
        self.times = StageTimes()
        self.profile = profile
        self.predictor = predictor
        self.tile = tile
        self._clock = clock
        run_by = run_by or (Direct if clock is None else Watched)
        self._runner = run_by(predictor)
        self._forecaster = Forecaster(
            predictor.contract, self._runner, lanes_for(tile, predictor), self.tracks, self.ego
        )
        self._modes = ModeKeeper()
        self._nobody = Raw.silent(Targets.none(predictor.contract), predictor.contract)
        self._controlled_s = self._predicted_s = np.nan  # never
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
        dt_s = self.predictor.contract.dt_s
        if np.isfinite(self._silent_due_s):  # a clock that was set back
            self._silent_due_s = min(self._silent_due_s, now_s + SILENT_PERIODS * dt_s)
        if now_s >= self._silent_due_s:  # so nothing was made now
            self._silent_due_s = now_s + dt_s - (now_s - self._silent_due_s) % dt_s
            made.append(self._silence(now_s))
        return made

    def finish(self, now_s: float) -> list[ForecastSet]:
        """Nothing more will come: close the cycles that are open."""
        return self._handle_all(self.decoder.poll(now_s + _FINISH_S), now_s)

    def exchange(self, predictor: Model, tile: Tile | None, lanes: CenterlineSource | None) -> None:
        """From the next cycle on, predict with these; `lanes` are `lanes_for` the two.

        Tracks and ego motion stay, unless poses come as latitude and longitude and the new tile's
        map frame has its origin elsewhere: then poses begin anew there, and histories with them.
        """
        origin_before, origin = _origin_of(self.tile), _origin_of(tile)
        self.predictor, self.tile = predictor, tile
        self._runner = self._runner.succeeded_by(predictor)
        self.tracks.reach(predictor.contract.history_steps, predictor.contract.dt_s)
        self._forecaster = Forecaster(
            predictor.contract, self._runner, lanes, self.tracks, self.ego
        )
        self._nobody = Raw.silent(Targets.none(predictor.contract), predictor.contract)
        if origin != origin_before and self.decoder.set_map_origin(origin):
            self.ego.leave_map()

    def _handle_all(self, events: list[Event], now_s: float) -> list[ForecastSet]:
        return [made for event in events if (made := self._handle(event, now_s)) is not None]

    def _handle(self, event: Event, now_s: float) -> ForecastSet | None:
        if now_s - event.timestamp_s > MAX_INPUT_AGE_S:
            self.counters.stale += 1
            return None
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
        since_s = timestamp_s - self._predicted_s
        if -_MAX_CLOCK_STEP_S <= since_s < MIN_PERIOD * self.predictor.contract.dt_s:
            self.counters.skipped += 1
            return None
        self._predicted_s = timestamp_s
        self._silent_due_s = now_s + SILENT_PERIODS * self.predictor.contract.dt_s
        self.times.tracks_s = self._time(now_s) - started_s
        received_s = min(detections.received_s, now_s)  # later only if the clock was set back
        return self._predict(ego, _Moment(timestamp_s, received_s, now_s, started_s))

    def _predict(self, ego: EgoState | None, moment: _Moment) -> ForecastSet:
        tracks = self.tracks.snapshot(moment.measured_s, NEIGHBOR_AGE_S)
        alive = tracks.timestamp_s >= tracks.told_until_s - TARGET_AGE_S
        if ego is None or not alive.any():
            return self._forecast(self._nobody, ego, moment)
        raw = self._forecaster.predict(tracks, alive, ego, self._deadline(moment))
        self.times.scene_s, self.times.infer_s = raw.scene_s, raw.infer_s
        return self._forecast(raw, ego, moment)

    def _deadline(self, moment: _Moment) -> Deadline:
        if self._clock is None:
            return Deadline(lambda: moment.now_s, np.inf, np.inf)
        dt_s, received_s = self.predictor.contract.dt_s, moment.received_s
        return Deadline(self._clock, received_s + SHED_PERIODS * dt_s, received_s + dt_s)

    def _forecast(
        self, raw: Raw, ego: EgoState | None, moment: _Moment, *, silent: bool = False
    ) -> ForecastSet:
        begun_s = self._time(moment.now_s)
        targets, dt_s = raw.targets, self.predictor.contract.dt_s
        guarded = guard(
            raw.trajectories,
            raw.probabilities,
            targets.history,
            targets.valid,
            dt_s,
            object_class=targets.object_class,
            measured=targets.velocity,
            covariances=raw.covariances,
        )
        made_s = self._time(moment.now_s)
        self.times.guard_s = made_s - begun_s
        self._count(raw, guarded)
        mode = Mode.SILENT
        if not silent:
            overdue = self._clock is not None and made_s - moment.received_s > dt_s
            has_tile = self.tile is not None
            reasons = cycle_reasons(raw, guarded, ego, has_tile=has_tile, overdue=overdue)
            mode = self._modes.cycle(reasons, moment.now_s)
        used_tile = self.tile if raw.has_lanes else None
        return ForecastSet(
            cycle=self.counters.cycles - 1,
            timestamp_s=moment.measured_s,
            received_s=moment.received_s,
            made_s=made_s,
            compute_s=made_s - moment.started_s,
            mode=mode,
            model_id=self.predictor.model_id,
            tile_id=used_tile.info.tile_id if used_tile else "",
            map_from_ego=ego.map_from_ego if ego else None,
            ego_speed_mps=ego.velocity[0] if ego else np.nan,
            dt_s=dt_s,
            track_id=targets.track_id,
            object_id=targets.object_id,
            anchor_s=targets.anchor_s,
            agent_mode=agent_modes(raw, guarded),
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
            covariances=guarded.covariances,
        )

    def _count(self, raw: Raw, guarded: Guarded) -> None:
        counters = self.counters
        counters.cycles += 1
        counters.targets += len(raw.targets)
        counters.shed += int(np.count_nonzero(raw.late))
        counters.fallbacks += int(np.count_nonzero(~guarded.accepted & ~raw.late))
        counters.model_errors = self._runner.errors
        counters.model_overruns = self._runner.overruns
        counters.model_restarts = self._runner.restarts

    def _silence(self, now_s: float) -> ForecastSet:
        moment = _Moment(self._predicted_s, np.nan, now_s, now_s)
        return self._forecast(self._nobody, None, moment, silent=True)

    def _time(self, now_s: float) -> float:
        return now_s if self._clock is None else self._clock()


@dataclass(frozen=True, slots=True)
class _Moment:
    """When a prediction is made, on the pipeline's clock."""

    measured_s: float
    """The newest measurement in it."""
    received_s: float
    """The cycle's last message arrived; NaN = there is no cycle."""
    now_s: float
    """The cycle was closed: with that message, or when the next ones had been waited for."""
    started_s: float
    """Work on it began."""


def _origin_of(tile: Tile | None) -> tuple[float, float] | None:
    """Of the map frame, as `Decoder` takes it: what a tile does not know is not the first pose."""
    return None if tile is None else tile.info.origin_deg or _NOWHERE


def lanes_for(tile: Tile | None, predictor: Model) -> CenterlineSource | None:
    """The tile's lanes as the model wants them chosen; takes milliseconds."""
    return centerline_source(tile.lane_map, predictor.contract) if tile else None


_NOTHING: list[ForecastSet] = []
_NOWHERE = (np.nan, np.nan)
