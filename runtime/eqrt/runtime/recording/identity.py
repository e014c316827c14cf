"""What a recording is of: the model, profile and tile, the options, and the machine."""

from __future__ import annotations

import importlib.metadata
import platform
import shlex
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import msgspec

from eqrt.core.errors import LogError, in_one_line
from eqrt.runtime.decoding.profile import profile_files
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.recording.order import Attached, Description
from eqrt.runtime.recording.topics import PROFILE_FILES, TILE_FILE

_MOST_SHOWN = 200


class Identity(msgspec.Struct, frozen=True, kw_only=True):
    """The metadata record `eqrt` of every file of a recording; all values are text."""

    format: str
    run: str
    """Which start of the service."""
    part: Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,9}$")]
    """Which file of the run, from 0."""
    eqrt: str
    """Version of the program."""
    begun: str
    """When the service started: UTC, ISO 8601."""
    command: str
    """How it was started."""
    profile: Annotated[str, msgspec.Meta(pattern=r"^[^/\x00-\x1f]{1,255}$")]
    """A file's name without its ending."""
    model: str
    """The name in the model's contract."""
    model_id: str
    model_folder: str
    """Absolute, on the machine that recorded."""
    tile: str
    """Likewise the tile's file; empty = without a map."""
    tile_id: str
    stationary: str
    """`true` or `false`."""
    channels: str
    """JSON: role of a bus -> channel; null = every role is on any."""
    numpy: str
    onnxruntime: str
    python: str
    machine: str
    """The processor and its system: another may round differently."""

    @property
    def is_stationary(self) -> bool:
        """Whether the sensor was said to stand still."""
        return self.stationary == "true"

    @property
    def predicting(self) -> tuple[str, str, str]:
        """What tells whether the same model and tile predict."""
        return self.model, self.model_id, self.tile_id

    @property
    def channel_of(self) -> dict[str, str] | None:
        """Role of a bus -> channel, as for Pipeline."""
        return msgspec.json.decode(self.channels, type=dict[str, str] | None)


def identity_of(
    pipeline: Pipeline,
    *,
    model_folder: Path,
    channels: Mapping[str, str] | None,
    stationary: bool,
) -> dict[str, str]:
    """What `Identity` says of a pipeline; run, part and format are the writer's to add."""
    return {
        "eqrt": importlib.metadata.version("eqrt"),
        "begun": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "command": shlex.join(["eqrt", *sys.argv[1:]]),
        "profile": pipeline.profile.name,
        "model_folder": str(model_folder.absolute()),
        "stationary": "true" if stationary else "false",
        "channels": msgspec.json.encode(channels).decode(),
        "numpy": importlib.metadata.version("numpy"),
        "onnxruntime": importlib.metadata.version("onnxruntime"),
        "python": platform.python_version(),
        "machine": f"{_processor()}, {platform.system()} {platform.machine()}",
        **_exchangeable(pipeline),
    }


def _exchangeable(pipeline: Pipeline) -> dict[str, str]:
    """What of it a reload may change."""
    tile, predictor = pipeline.tile, pipeline.predictor
    return {
        "model": predictor.contract.name,
        "model_id": predictor.model_id,
        "tile": str(tile.path.absolute()) if tile else "",
        "tile_id": tile.info.tile_id if tile else "",
    }


def exchanged(before: Description, pipeline: Pipeline) -> Description:
    """What the recording goes on with when the pipeline has got another tile or model."""
    return Description(
        identity=before.identity | _exchangeable(pipeline),
        attached=[file for file in before.attached if file.name != TILE_FILE] + _tile(pipeline),
    )


def attached_files(profile: str, pipeline: Pipeline) -> list[Attached]:
    """The profile with its DBCs, and the tile: what a replay needs beside the model."""
    files = [
        Attached(PROFILE_FILES + name, "text/plain", content)
        for name, content in profile_files(profile).items()
    ]
    return files + _tile(pipeline)


def _tile(pipeline: Pipeline) -> list[Attached]:
    if pipeline.tile is None:
        return []
    path = str(pipeline.tile.path.absolute())
    return [Attached(TILE_FILE, "application/octet-stream", path=path)]


def read_identity(values: Mapping[str, str], path: Path) -> Identity:
    """The metadata record as an Identity. Raises LogError if it is another version's."""
    try:
        identity = msgspec.convert(dict(values), Identity)
        _ = identity.channel_of
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        version = one_line(values.get("eqrt", "which it does not say"))
        raise LogError(
            f"{path}: its description is not of this version of eqrt ({in_one_line(error)}); "
            f"read it with the version that wrote it, {version}"
        ) from error
    return identity


def one_line(text: object) -> str:
    """What a file says, or what is said of it, fit to be printed within a line."""
    words = " ".join(f"{text}".split())[:_MOST_SHOWN]
    return "".join(char if char.isprintable() else "?" for char in words)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
