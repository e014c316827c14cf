"""`eqrt convert`: a recording of `eqrt serve --record` as files of other programs."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bus.candump import candump_line
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.recording.reader import Recording, read_recordings
from eqrt.runtime.replay import output


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt convert`."""
    parser.epilog = "example: eqrt convert recordings/ --to foxglove --out drive.mcap"
    parser.add_argument(
        "recording", type=Path, metavar="RECORDING", help="a .mcap of eqrt, or a folder of them"
    )
    parser.add_argument(
        "--to",
        required=True,
        choices=tuple(_KINDS),
        help="foxglove: an MCAP for Foxglove and PlotJuggler; rosbag2: a folder with Autoware's "
        "PredictedObjects; candump: the CAN messages; jsonl: the predictions, a line each",
    )
    parser.add_argument(
        "--out", required=True, metavar="FILE", help="where to; - = standard output, where it can"
    )


def run(args: argparse.Namespace) -> int:
    """Convert, and say in one line what was written."""
    recordings = read_recordings(args.recording)
    try:
        count, what = _KINDS[args.to](recordings, args.out)
    except ModuleNotFoundError as error:
        raise UsageError(
            f"eqrt convert --to {args.to} needs the package {error.name!r}, which is not "
            "installed; install it with: pip install 'eqrt[bridges]'"
        ) from error
    if args.out != "-":
        print(f"eqrt convert: {count} {what} to {args.out}")
    for one in recordings:
        if one.remark:
            print(f"eqrt: {one.remark}", file=sys.stderr)
    return 0


def _foxglove(recordings: list[Recording], out: str) -> tuple[int, str]:
    from eqrt.export.bridges.foxglove import write_foxglove  # noqa: PLC0415 (an extra)

    with output(out) as stream:
        return write_foxglove(recordings, stream), "cycles"


def _rosbag2(recordings: list[Recording], out: str) -> tuple[int, str]:
    from eqrt.export.bridges.ros2 import write_rosbag2  # noqa: PLC0415 (an extra)

    if out == "-" or Path(out).exists():
        raise UsageError(f"--out {out}: a bag is a new folder; give one that does not exist yet")
    try:
        return write_rosbag2(recordings, Path(out)), "messages"
    except BaseException as error:
        shutil.rmtree(out, ignore_errors=True)  # half a bag is none, and would be in the way
        if isinstance(error, OSError):
            raise EqrtError(f"cannot write {out} ({error.strerror})") from error
        raise


def _candump(recordings: list[Recording], out: str) -> tuple[int, str]:
    count = 0
    with output(out) as stream:
        for recording in recordings:
            for step in recording.steps():
                if step.message is not None:
                    stream.write(candump_line(step.message).encode())
                    count += 1
    return count, "messages"


def _jsonl(recordings: list[Recording], out: str) -> tuple[int, str]:
    count = 0
    with output(out) as stream:
        for recording in recordings:
            for forecast in recording.forecasts():
                stream.write(json_lines(forecast))
                count += forecast.num_targets
    return count, "predictions"


_KINDS: dict[str, Callable[[list[Recording], str], tuple[int, str]]] = {
    "foxglove": _foxglove,
    "rosbag2": _rosbag2,
    "candump": _candump,
    "jsonl": _jsonl,
}
