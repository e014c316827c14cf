"""A recording replayed: the pipeline that made it, told the same again."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from eqrt.core.errors import ContractError, LogError
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.decoding.profile import Profile, load_profile
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.prediction.tiles import Tile, load_tile
from eqrt.runtime.recording.reader import Recording
from eqrt.runtime.recording.steps import ReplayedClock
from eqrt.runtime.recording.topics import PROFILE_FILES, TILE_FILE


@dataclass(frozen=True, slots=True, kw_only=True)
class Instead:
    """What a replay uses in place of what was recorded; None = as recorded."""

    profile: str | None = None
    model: Path | None = None
    tile: Path | None = None
    can: tuple[str, ...] = ()
    """Options `--can`; empty = as recorded."""
    stationary: bool = False
    """True: although it was not said so then."""


def replay_recording(
    recording: Recording, pipeline: Pipeline, clock: ReplayedClock
) -> Iterator[ForecastSet]:
    """Every prediction that the service made, bit for bit, if the pipeline is as it was then.

    `clock` is the pipeline's. Raises LogError if the recording cannot be read.
    """
    for step in recording.steps():
        clock.begin(step)
        yield from pipeline.poll(step.now_s)
        if step.message is not None:
            yield from pipeline.feed(step.message, step.now_s)


def recorded_pipeline(recording: Recording, instead: Instead, clock: ReplayedClock) -> Pipeline:
    """The pipeline as it was when the recording began.

    Raises LogError if the recording does not bring what it needs, and what loading profile, model
    and tile raises.
    """
    identity = recording.identity
    with _unpacked(recording) as folder:
        profile = _profile(recording, instead, folder)
        return Pipeline(
            profile,
            _predictor(recording, instead),
            _tile(recording, instead, folder),
            channels=parse_channels(instead.can, profile.roles) or identity.channel_of,
            stationary=identity.is_stationary or instead.stationary,
            clock=clock,
        )


def _profile(recording: Recording, instead: Instead, folder: Path) -> Profile:
    if instead.profile is not None:
        return load_profile(instead.profile)
    return load_profile(str(folder / PROFILE_FILES / f"{recording.identity.profile}.toml"))


def _tile(recording: Recording, instead: Instead, folder: Path) -> Tile | None:
    if instead.tile is not None:
        return load_tile(instead.tile)
    return load_tile(folder / TILE_FILE) if recording.identity.tile else None


def _predictor(recording: Recording, instead: Instead) -> Predictor:
    """The recorded model, where it was or among eqrt's own; what it is called proves nothing."""
    if instead.model is not None:
        return Predictor.load(instead.model)
    identity = recording.identity
    for folder in (Path(identity.model_folder), DEFAULT_ARTIFACT):
        with contextlib.suppress(ContractError):
            predictor = Predictor.load(folder)
            if predictor.model_id == identity.model_id:
                return predictor
    raise LogError(
        f"{recording.paths[0]}: was recorded with the model {identity.model} "
        f"({identity.model_id}), which is no more at {identity.model_folder}; give it with --model"
    )


@contextlib.contextmanager
def _unpacked(recording: Recording) -> Iterator[Path]:
    """A folder with the files that travel in the recording."""
    with tempfile.TemporaryDirectory(prefix="eqrt-") as name:
        folder = Path(name)
        for attached, content in recording.attached.items():
            path = folder / _inside(attached, recording)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        yield folder


def _inside(name: str, recording: Recording) -> PurePosixPath:
    """The name, if it cannot lead out of the folder."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.parts:
        raise LogError(
            f"{recording.paths[0]}: a file in it is named {name!r}, which leads elsewhere; give "
            "the profile with --profile"
        )
    return path
