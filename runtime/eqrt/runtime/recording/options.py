"""`--record` and what belongs to it: the options of a recording, and the recorder they describe."""

from __future__ import annotations

import argparse
import re
import secrets
from collections.abc import Mapping
from pathlib import Path

from eqrt.core.errors import RecordingError
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.recording.folder import free_bytes, total_bytes
from eqrt.runtime.recording.identity import attached_files, identity_of
from eqrt.runtime.recording.json_schemas import json_schema
from eqrt.runtime.recording.order import Description, Order
from eqrt.runtime.recording.recorder import Recorder
from eqrt.runtime.recording.runs import RunTape
from eqrt.runtime.recording.steps import Lost, TapedClock
from eqrt.runtime.recording.topics import NAMES, Topic

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
_SIZE = re.compile(r"(\d+(?:\.\d+)?)([KMGT]?)B?", re.IGNORECASE)
_FILE_SECONDS = 600.0


def add_record_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt serve` about recording."""
    group = parser.add_argument_group("recording", "docs/recording.md")
    group.add_argument(
        "--record",
        type=Path,
        metavar="DIR",
        help="write all that comes in and goes out into MCAP files in DIR, by a process of its own",
    )
    group.add_argument(
        "--record-limit",
        type=size,
        default=size("20G"),
        metavar="SIZE",
        help="what the recordings in DIR may have together (default 20G)",
    )
    group.add_argument(
        "--record-keep-free",
        type=size,
        default=size("1G"),
        metavar="SIZE",
        help="what the file system keeps free (default 1G)",
    )
    group.add_argument(
        "--record-when-full",
        choices=("stop", "delete-oldest"),
        default="stop",
        help="at a limit, end the recording, or delete the oldest ones (default stop); predictions "
        "go on in any case",
    )
    group.add_argument(
        "--record-file-size",
        type=size,
        default=size("256M"),
        metavar="SIZE",
        help="begin a new file when one is as large, or ten minutes old (default 256M)",
    )


def size(text: str) -> int:
    """Bytes, from `500M` or `2.5G` (powers of 1,000)."""
    found = _SIZE.fullmatch(text.strip())
    if not found or (size_bytes := int(float(found[1]) * _UNITS[found[2].upper()])) <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 500M or 20G")
    return size_bytes


def start_recorder(
    args: argparse.Namespace,
    pipeline: Pipeline,
    channels: Mapping[str, str] | None,
    clock: TapedClock,
    runs: RunTape,
) -> Recorder:
    """The recorder that the options describe, its writer started.

    `channels`, `clock` and `runs` are those of the pipeline. Raises RecordingError if nothing can
    be written there.
    """
    check_folder(args)
    order = Order(
        folder=str(args.record.absolute()),
        run=secrets.token_hex(4),
        description=Description(
            identity=identity_of(
                pipeline, model_folder=args.model, channels=channels, stationary=args.stationary
            ),
            attached=attached_files(args.profile, pipeline),
        ),
        schemas={
            NAMES[Topic.STATUS]: json_schema(ServiceStatus),
            NAMES[Topic.LOST]: json_schema(Lost),
        },
        file_bytes=args.record_file_size,
        file_seconds=_FILE_SECONDS,
        total_bytes=args.record_limit,
        free_bytes=args.record_keep_free,
        delete_oldest=args.record_when_full == "delete-oldest",
    )
    return Recorder(order, clock, runs)


def check_folder(args: argparse.Namespace) -> None:
    """What can be known before the first entry is said at the start, where somebody reads it.

    Makes the folder. Raises RecordingError if nothing can be written there.
    """
    folder: Path = args.record
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".eqrt-{secrets.token_hex(4)}"
        probe.touch()
        probe.unlink()
        free, total = free_bytes(folder), total_bytes(folder)
    except OSError as error:
        raise RecordingError(
            f"cannot record in {folder} ({error.strerror}); give --record a folder that can be "
            "written"
        ) from error
    if args.record_when_full == "delete-oldest":
        return
    if free <= args.record_keep_free:
        raise RecordingError(
            f"cannot record in {folder}: its file system has {free / 1e9:.2f} GB left, to be kept "
            f"are {args.record_keep_free / 1e9:.2f} (--record-keep-free); make room"
        )
    if total >= args.record_limit:
        raise RecordingError(
            f"cannot record in {folder}: its recordings have {total / 1e9:.2f} GB, allowed are "
            f"{args.record_limit / 1e9:.2f} (--record-limit); delete some, or give "
            "--record-when-full delete-oldest"
        )
