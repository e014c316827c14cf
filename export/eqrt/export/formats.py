"""Every format of recorded traffic that is read, CAN logs included."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from eqrt.core.contract import ModelContract
from eqrt.core.errors import UsageError
from eqrt.runtime.bus import logs
from eqrt.training.recordings import formats
from eqrt.training.recordings.formats import Format, ReaderOptions
from eqrt.training.recordings.recording import Reader


def _can(_: Path, options: ReaderOptions, contract: ModelContract) -> Reader:
    from eqrt.export.can_recordings import CanLogReader  # noqa: PLC0415

    if options.profile is None:
        raise UsageError("CAN logs need --profile, the sensor that was recorded")
    usual = CanLogReader(profile=options.profile, contract=contract)
    return replace(
        usual,
        tile=options.tile,
        channels=options.can,
        stationary=options.stationary,
        stride=options.stride or usual.stride,
        license=options.license or usual.license,
        credits=options.credits or usual.credits,
    )


_LOGS = tuple(f"*{suffix}{packed}" for suffix in logs.FORMATS for packed in ("", ".gz"))

CAN = Format(
    name="can",
    holds=f"CAN logs ({', '.join(logs.FORMATS)}, also with .gz)",
    files=_LOGS,
    folders=tuple(f"**/{name}" for pattern in _LOGS for name in (pattern, pattern.upper())),
    takes=("profile", "tile", "can", "stationary", "stride", "license", "credits"),
    open=_can,
)
FORMATS: tuple[Format, ...] = (*formats.FORMATS, CAN)
"""The first that fits counts."""


def add_reader_arguments(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """What `ReaderOptions` asks for, for every command that reads recorded traffic."""
    reader = parser.add_argument_group("reading recorded traffic")
    reader.add_argument(
        "--maps", type=Path, metavar="FOLDER", help="Argoverse 1: the cities' maps, map_files"
    )
    reader.add_argument("--profile", metavar="NAME|FILE", help="CAN logs: which sensor sent")
    reader.add_argument("--tile", type=Path, metavar="FILE", help="CAN logs: the map around")
    reader.add_argument(
        "--can",
        action="append",
        default=[],
        metavar="[ROLE=]NAME",
        help="CAN logs: read only the channel NAME (repeatable)",
    )
    reader.add_argument(
        "--stationary", action="store_true", help="CAN logs: the sensor stood still"
    )
    return reader
