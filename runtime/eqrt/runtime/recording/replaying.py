"""A recording replayed: the pipeline that made it, told the same again."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from eqrt.core.errors import ContractError, LogError, ProfileError
from eqrt.core.tile import decode
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.decoding.profile import Profile, load_profile, parse_profile
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline, lanes_for
from eqrt.runtime.prediction.modes import HOLD_S
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.prediction.tiles import Tile, load_tile
from eqrt.runtime.recording.identity import Identity, one_line
from eqrt.runtime.recording.reader import Exchanged, Recording
from eqrt.runtime.recording.runs import ReplayedRunner
from eqrt.runtime.recording.steps import ReplayedClock, Step
from eqrt.runtime.recording.topics import PROFILE_FILES, TILE_FILE, Topic

_TOLD = frozenset({Topic.CAN, Topic.POLL, Topic.CLOCK, Topic.RUNS, Topic.FORECASTS})


@dataclass(frozen=True, slots=True, kw_only=True)
class Instead:
    """What a replay uses in place of what was recorded; None = as recorded."""

    profile: str | None = None
    model: Path | None = None
    """One that the recording was made with: where it is now. Another: predicts all of it."""
    other_model: Path | None = None
    """Predicts all of it, whatever it was made with."""
    tile: Path | None = None
    can: tuple[str, ...] = ()
    """Options `--can`; empty = as recorded."""
    stationary: bool = False
    """True: although it was not said so then."""


@dataclass(slots=True)
class LeftOut:
    """Cycles that cannot be made again."""

    reason: str
    times_s: dict[float, None] = field(default_factory=dict)
    """Of their newest measurements, to the microsecond, in their order."""

    def add(self, time_s: float) -> None:
        """One more."""
        self.times_s[round(time_s, 6)] = None

    def __str__(self) -> str:
        times_s = list(self.times_s)
        cycles = f"{len(times_s)} cycles, from {times_s[0]:.6f} to {times_s[-1]:.6f} s,"
        return f"{cycles} cannot be made again and are left out: {self.reason}"


class Replay:
    """One recording, from its start: every prediction that the service made, bit for bit.

    Where model and tile were exchanged, so they are here. Cycles of a model that is not here any
    more are left out, and the modes of the half second after them with them.
    """

    def __init__(self, recording: Recording, instead: Instead) -> None:
        """Raises LogError if the recording does not bring what it needs, and what loading profile,
        model and tile raises.
        """
        self.recording = recording
        self.left_out: list[LeftOut] = []
        self._instead = instead
        self._models = _Models(recording, instead)
        self._clock = ReplayedClock()
        self._is_exact = True
        """Whether the present step is as it was."""
        self._exact_from_s = -math.inf
        """On the pipeline's clock; inf = not as long as the same model and tile predict."""
        self.pipeline = self._pipeline()

    def _pipeline(self) -> Pipeline:
        """As it was when the recording began."""
        recording, instead, identity = self.recording, self._instead, self.recording.identity
        given = instead.profile
        profile = recorded_profile(recording) if given is None else load_profile(given)
        predictor, tile = self._predicting(identity, recording.attached)
        return Pipeline(
            profile,
            predictor,
            tile,
            channels=parse_channels(instead.can, profile.roles) or identity.channel_of,
            stationary=identity.is_stationary or instead.stationary,
            clock=self._clock,
            run_by=lambda model: ReplayedRunner(model, self._clock),
        )

    def _predicting(
        self, identity: Identity, attached: Mapping[str, bytes]
    ) -> tuple[Predictor, Tile | None]:
        """The model and tile that predict from here on; if one is not here, another, for nothing
        but to go on.
        """
        predictor, reason = self._models.find(identity)
        tile = None if self._instead.tile is None else load_tile(self._instead.tile)
        if tile is None and identity.tile:
            tile = recorded_tile(self.recording, attached)
            if tile is None or tile.info.tile_id != identity.tile_id:
                reason = (
                    reason or f"their tile, {one_line(identity.tile_id)}, is not in the recording"
                )
        if reason:
            self.left_out.append(LeftOut(reason))
            self._exact_from_s = math.inf
        return predictor, tile

    def __iter__(self) -> Iterator[ForecastSet]:
        """Raises LogError if the recording cannot be read."""
        for one in self.recording.entries(_TOLD):
            if isinstance(one.entry, Exchanged):
                self._exchange(one.entry)
            elif isinstance(one.entry, Step):
                made = self._told(one.entry)
                if self._is_exact:
                    yield from made
            elif isinstance(one.entry, ForecastSet) and not self._is_exact:
                self.left_out[-1].add(one.entry.timestamp_s)

    def _told(self, step: Step) -> list[ForecastSet]:
        if math.isnan(self._exact_from_s):
            self._exact_from_s = step.now_s + HOLD_S
        self._is_exact = step.now_s >= self._exact_from_s
        self._clock.begin(step)
        made = self.pipeline.poll(step.now_s)
        if step.message is None:
            return made
        return [*made, *self.pipeline.feed(step.message, step.now_s)]

    def _exchange(self, exchanged: Exchanged) -> None:
        if self._exact_from_s == math.inf:
            self._exact_from_s = math.nan  # until the next step tells the time
        predictor, tile = self._predicting(exchanged.identity, exchanged.attached)
        self.pipeline.exchange(predictor, tile, lanes_for(tile, predictor))


class _Models:
    """The models of a recording, as far as they are here; what one is called proves nothing."""

    def __init__(self, recording: Recording, instead: Instead) -> None:
        """Raises LogError if there is none at all, ContractError for one that was asked for."""
        self._by_id: dict[str, Predictor] = {}
        other = instead.other_model
        self._everywhere = None if other is None else Predictor.load(other)
        wanted = {identity.model_id: identity for identity in recording.identities}
        if instead.model is not None and self._everywhere is None:
            given = Predictor.load(instead.model)
            if given.model_id in wanted:
                self._by_id[given.model_id] = given
            else:
                self._everywhere = given
        if self._everywhere is None:
            for identity in wanted.values():
                self._look_for(identity)
            if not self._by_id:
                raise LogError(f"{recording.paths[0]}: was {_unknown(recording.identity)}")

    def _look_for(self, identity: Identity) -> None:
        """Where it was, and among eqrt's own."""
        for folder in (Path(identity.model_folder), DEFAULT_ARTIFACT):
            if identity.model_id not in self._by_id:
                with contextlib.suppress(ContractError):
                    predictor = Predictor.load(folder)
                    if predictor.model_id == identity.model_id:
                        self._by_id[identity.model_id] = predictor

    def find(self, identity: Identity) -> tuple[Predictor, str]:
        """The model, or another one and why."""
        if self._everywhere is not None:
            return self._everywhere, ""
        if identity.model_id in self._by_id:
            return self._by_id[identity.model_id], ""
        return next(iter(self._by_id.values())), f"they were {_unknown(identity)}"


def _unknown(identity: Identity) -> str:
    return (
        f"recorded with the model {one_line(identity.model)} ({one_line(identity.model_id)}), "
        f"which is no more at {one_line(identity.model_folder)}; give it with --model"
    )


def recorded_profile(recording: Recording) -> Profile:
    """The profile that travels in the recording, from what travels with it and no other file.

    Raises LogError if it cannot be used.
    """
    files = {
        name.removeprefix(PROFILE_FILES): content
        for name, content in recording.attached.items()
        if name.startswith(PROFILE_FILES)
    }
    try:
        return parse_profile(files, recording.identity.profile)
    except ProfileError as error:
        raise LogError(
            f"{recording.paths[0]}: the profile in it cannot be used ({one_line(error)}); give one "
            "with --profile"
        ) from error


def recorded_tile(recording: Recording, attached: Mapping[str, bytes]) -> Tile | None:
    """The tile among files that travel in the recording. Raises TileError if it is damaged."""
    if TILE_FILE not in attached:
        return None
    lane_map, info = decode(attached[TILE_FILE], f"{recording.paths[0]}: the tile in it")
    return Tile(lane_map, info, Path(TILE_FILE))
