"""Checks of what the service is made of: profile, model, tile, where its words go."""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from eqrt.core.errors import EqrtError
from eqrt.runtime.advice import unused_map
from eqrt.runtime.decoding.profile import Profile, load_profile
from eqrt.runtime.doctor.finding import Finding, fail, ok, warn
from eqrt.runtime.operation.endpoint import Endpoint
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.runtime.prediction.stored_vectors import read_vector, vector_folders
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.recording.folder import free_bytes
from eqrt.runtime.recording.options import check_folder
from eqrt.runtime.serve_options import check_outputs, out_channel

_RUNS = 20
_MOST_OF_A_STEP = 0.25  # for the model; the rest is for decoding, tracks, scene and sending


def check_profile(name: str | None) -> tuple[Profile | None, Finding]:
    """The profile, if it can be used."""
    if name is None:
        return None, warn("profile", "none named", "name one with --profile or in --config")
    try:
        profile = load_profile(name)
    except EqrtError as error:
        return None, fail("profile", str(error))
    count, ids = len(profile.sensors), len(profile.arbitration_ids)
    gives = [f"{count or 'no'} sensor{'' if count == 1 else 's'}"]
    for key in ("speed", "yaw_rate", "pose"):
        words = key.replace("_", " ")
        gives.append(words if profile.gives(key) else f"no {words}")
    return profile, ok("profile", f"{profile.name}: {', '.join(gives)}; {ids} CAN ids")


def check_model(folder: Path) -> Finding:
    """Checksum, test vector, and the time of a run."""
    try:
        predictor = Predictor.load(folder)
        vector = read_vector(vector_folders(folder)[0], predictor.contract)
    except EqrtError as error:
        return fail("model", str(error))
    spent_s = []
    for _ in range(_RUNS):
        begun_s = time.perf_counter()
        predictor.predict(vector.scene)
        spent_s.append(time.perf_counter() - begun_s)
    targets, run_s = len(vector.scene.history), median(spent_s)
    found = f"{predictor.contract.name} {predictor.model_id}: checksum and test vector are right, "
    found += f"{1e3 * run_s:.1f} ms for a run of {targets} target{'s' if targets > 1 else ''}"
    if run_s > _MOST_OF_A_STEP * predictor.contract.dt_s:
        return warn("model", found, "too slow for this machine: predictions would come LATE")
    return ok("model", found)


def check_tile(path: Path | None, profile: Profile | None) -> Finding:
    """Whether it can be read, what is in it, and whether the profile lets it be used."""
    if path is None:
        return ok("tile", "none: predictions will be made without a map")
    try:
        tile = load_tile(path)
    except EqrtError as error:
        return fail("tile", str(error))
    info = tile.info
    origin = info.origin_deg
    where = f"origin {origin[0]:.5f}, {origin[1]:.5f}" if origin else "origin not on Earth"
    found = f"{info.name} {info.tile_id}: {tile.lane_map.num_lanes} lanes, {where}"
    if profile is not None and (advice := unused_map(profile, tile)):
        return warn("tile", found, advice)
    return ok("tile", found)


def check_metrics(address: str | None, anywhere: bool) -> Finding:
    """Whether the port is to be had."""
    if address is None:
        return ok("metrics", "not asked for")
    try:
        with Endpoint(address, anywhere=anywhere) as endpoint:
            return ok("metrics", f"{endpoint.address} is free")
    except EqrtError as error:
        cause = error.__cause__
        if isinstance(cause, OSError) and cause.errno == errno.EADDRINUSE:
            return warn("metrics", str(error), "is that the service itself, already running?")
        return fail("metrics", str(error))


def check_datagrams(addresses: Sequence[str]) -> Finding:
    """Whether there is a way to each."""
    if not addresses:
        return ok("datagrams", "not asked for")
    try:
        with DatagramPublisher(addresses):
            return ok("datagrams", f"can be sent to {', '.join(addresses)}")
    except EqrtError as error:
        return fail("datagrams", str(error))


def check_recording(asked: argparse.Namespace) -> Finding:
    """Whether this user may write there, and has room; leaves nothing behind."""
    if asked.record is None:
        return ok("recording", "not asked for")
    folder: Path = asked.record.absolute()
    made = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    try:
        check_folder(asked)
        return ok("recording", f"{folder}: can be written, {free_bytes(folder) / 1e9:.1f} GB free")
    except EqrtError as error:
        return fail("recording", str(error))
    finally:
        for path in made:
            with contextlib.suppress(OSError):  # it was not made, or is in use by now
                path.rmdir()


def check_output(asked: argparse.Namespace) -> Finding:
    """Where predictions go on CAN, and whether there are such ids."""
    try:
        check_outputs(asked)
    except EqrtError as error:
        return fail("output", str(error))
    channel = out_channel(asked)
    if channel is None:
        return ok("output", "not on CAN")
    return ok("output", f"on {channel}, CAN ids from {asked.out_id:#x} on")
