"""What a recording is of: the model, profile and tile, the options, and the machine."""

from __future__ import annotations

import importlib.metadata
import platform
import shlex
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import msgspec

from eqrt.core.errors import LogError, in_one_line
from eqrt.runtime.decoding.profile import profile_files
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.recording.order import Attached
from eqrt.runtime.recording.topics import PROFILE_FILES, TILE_FILE


class Identity(msgspec.Struct, frozen=True, kw_only=True):
    """The metadata record `eqrt` of every file of a recording; all values are text."""

    format: str
    run: str
    """Which start of the service."""
    part: str
    """Which file of the run, from 0."""
    eqrt: str
    """Version of the program."""
    begun: str
    """When the service started: UTC, ISO 8601."""
    command: str
    """How it was started."""
    profile: str
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
    tile, predictor = pipeline.tile, pipeline.predictor
    return {
        "eqrt": importlib.metadata.version("eqrt"),
        "begun": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "command": shlex.join(["eqrt", *sys.argv[1:]]),
        "profile": pipeline.profile.name,
        "model": predictor.contract.name,
        "model_id": predictor.model_id,
        "model_folder": str(model_folder.absolute()),
        "tile": str(tile.path.absolute()) if tile else "",
        "tile_id": tile.info.tile_id if tile else "",
        "stationary": "true" if stationary else "false",
        "channels": msgspec.json.encode(channels).decode(),
        "numpy": importlib.metadata.version("numpy"),
        "onnxruntime": importlib.metadata.version("onnxruntime"),
        "python": platform.python_version(),
        "machine": f"{_processor()}, {platform.system()} {platform.machine()}",
    }


def attached_files(profile: str, pipeline: Pipeline) -> list[Attached]:
    """The profile with its DBCs, and the tile: what a replay needs beside the model."""
    files = [
        Attached(PROFILE_FILES + name, "text/plain", content)
        for name, content in profile_files(profile).items()
    ]
    if pipeline.tile:
        content = pipeline.tile.path.read_bytes()
        files.append(Attached(TILE_FILE, "application/octet-stream", content))
    return files


def read_identity(values: Mapping[str, str], path: Path) -> Identity:
    """The metadata record as an Identity. Raises LogError if it is another version's."""
    try:
        return msgspec.convert(dict(values), Identity)
    except msgspec.ValidationError as error:
        raise LogError(
            f"{path}: its description is not of this version of eqrt ({in_one_line(error)}); "
            f"read it with the version that wrote it, {values.get('eqrt', 'which it does not say')}"
        ) from error


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
