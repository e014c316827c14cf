"""The options of `eqrt serve`: each a flag, and a key of its configuration file (`settings`)."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path

from eqrt.core.errors import UsageError
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.decoding.profile import builtin_profiles
from eqrt.runtime.operation.endpoint import DEFAULT_ADDRESS as METRICS_ADDRESS
from eqrt.runtime.operation.event_log import FORMATS, LEVELS
from eqrt.runtime.operation.realtime import parse_cpus, parse_priority
from eqrt.runtime.output.datagrams import DEFAULT_ADDRESS
from eqrt.runtime.output.publish_can import BASE_ID, check_base_id
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.recording.options import add_record_arguments
from eqrt.runtime.settings import FileOrName, Settings, Switch

NO_CHANNEL = "none"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt serve`."""
    parser.epilog = "example: eqrt serve --can can0 --profile generic --tile town.tile"
    add_pipeline_arguments(parser)
    _add_channels(parser)
    _add_outputs(parser)
    parser.add_argument(
        "--wait-for-bus",
        action=Switch,
        help="at the start, wait for channels that are not there yet, or down (default: an error); "
        "one that is lost later is waited for in any case",
    )
    _add_reporting(parser)
    add_record_arguments(parser)
    _add_realtime(parser)
    Settings(parser, "serve")


def _add_channels(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--can",
        required=True,
        action="append",
        metavar="[ROLE=]CHANNEL",
        help="the channel to listen on, such as can0; with ROLE= that of one of the profile's "
        "buses, such as radar=can1 (repeatable)",
    )
    parser.add_argument(
        "--can-interface",
        metavar="IF",
        help=f"python-can's name of the kind of adapter (default: socketcan; {LOCAL} needs no CAN "
        "hardware)",
    )
    parser.add_argument(
        "--fd",
        action=argparse.BooleanOptionalAction,
        help="open channels for CAN FD, or not: then predictions are sent as classic messages "
        "(default: CAN FD if the channel can)",
    )


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out-can",
        metavar="CHANNEL",
        help="the channel to send predictions on (default: the first --can); "
        f"{NO_CHANNEL!r} = not on CAN",
    )
    parser.add_argument(
        "--out-id",
        type=_arbitration_id,
        default=ArbitrationId(BASE_ID),
        metavar="ID",
        help=f"the first CAN id of the predictions (default {BASE_ID:#x})",
    )
    parser.add_argument(
        "--out-modes",
        type=ModeCount,
        default=ModeCount(1),
        metavar="N",
        help="modes of each object sent on CAN FD, most probable first (default 1)",
    )
    parser.add_argument(
        "--datagrams",
        action="append",
        default=[],
        metavar="HOST:PORT",
        help="send predictions as UDP datagrams too, to a viewer or recorder, such as "
        f"{DEFAULT_ADDRESS} (repeatable)",
    )


def _add_reporting(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quiet", action=Switch, help="no status line every second, events only")
    parser.add_argument(
        "--log-format", choices=FORMATS, default=FORMATS[0], help="lines for people or for machines"
    )
    parser.add_argument(
        "--log-level", choices=[*LEVELS], default="info", help="events less bad are not said"
    )
    parser.add_argument(
        "--metrics",
        metavar="HOST:PORT",
        help=f"answer /metrics (Prometheus) and /health there, such as {METRICS_ADDRESS} "
        "(default: nowhere)",
    )
    parser.add_argument(
        "--metrics-anywhere",
        action=Switch,
        help="the host of --metrics may be another than this machine's loopback",
    )


def _add_realtime(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("realtime", "each needs a right: docs/operations.md")
    group.add_argument(
        "--realtime-priority",
        type=_priority,
        metavar="N",
        help="run before all ordinary programs (SCHED_FIFO), 1 to 99",
    )
    group.add_argument(
        "--realtime-lock-memory", action=Switch, help="keep all memory from being paged out"
    )
    group.add_argument(
        "--realtime-cpus",
        type=_cpus,
        metavar="LIST",
        help="the only cores to run on, such as 0 or 0,2-3 (default: any)",
    )
    group.add_argument(
        "--realtime-gc-between-cycles",
        action=Switch,
        help="collect Python's garbage between predictions, never during one",
    )
    group.add_argument(
        "--realtime-strict",
        action=Switch,
        help="do not start if one of these is refused (default: say so and go on)",
    )


def add_pipeline_arguments(parser: argparse.ArgumentParser, *, of_recordings: bool = False) -> None:
    """What `serve` and `replay` have in common.

    `of_recordings`: where input may be a recording, which says itself what it was made with;
    profile and model are None if not given.
    """
    recorded = "; a recording has its own" if of_recordings else ""
    parser.add_argument(
        "--profile",
        type=FileOrName,
        required=not of_recordings,
        metavar="NAME|FILE",
        help=f"which sensor sends: {', '.join(builtin_profiles())}, or a profile of your own, "
        f"a .toml file (docs/profiles.md){recorded}",
    )
    parser.add_argument(
        "--model",
        type=Path,
        default=None if of_recordings else DEFAULT_ARTIFACT,
        metavar="FOLDER",
        help="the predictor, as `eqrt export` writes it (default: the one that comes with eqrt"
        f"{recorded})",
    )
    parser.add_argument(
        "--tile",
        type=Path,
        metavar="FILE",
        help="the map around, from `eqrt tile build`; used where the profile gives poses (default: "
        "predict without a map)",
    )
    parser.add_argument(
        "--stationary",
        action=Switch,
        help="the sensor stands still: predict although no message tells its motion",
    )


def out_channel(args: argparse.Namespace) -> str | None:
    """Where predictions go on CAN; None = nowhere."""
    if args.out_can == NO_CHANNEL or not (args.out_can or args.can):
        return None
    return str(args.out_can or args.can[0].rpartition("=")[2])


def check_outputs(args: argparse.Namespace) -> None:
    """UsageError if the predictions would go nowhere, or by CAN ids that there are not."""
    if args.out_can != NO_CHANNEL:
        check_base_id(args.out_id)
    elif not args.datagrams and not args.record:
        raise UsageError(
            "--out-can none, no --datagrams, no --record: the predictions would go nowhere"
        )


class ModeCount(int):
    """How many modes of each object are sent."""

    __slots__ = ()

    def __new__(cls, text: str | int) -> ModeCount:
        """argparse.ArgumentTypeError if that is not a number, or none at all."""
        try:
            if (count := int(text)) >= 1:
                return super().__new__(cls, count)
        except ValueError:
            pass
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of modes; give 1 or more")


class ArbitrationId(int):
    """A CAN id, written in hexadecimal."""

    __slots__ = ()

    def __str__(self) -> str:
        return f"{self:#x}"


def _arbitration_id(text: str) -> ArbitrationId:
    """A CAN id, decimal or with 0x."""
    try:
        return ArbitrationId(text, 0)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a CAN id such as 0x6e0") from error


def _priority(text: str) -> int:
    with _as_argument_errors():
        return parse_priority(text)


def _cpus(text: str) -> str:
    with _as_argument_errors():
        parse_cpus(text)
    return text


@contextlib.contextmanager
def _as_argument_errors() -> Iterator[None]:
    """argparse shows the text of these."""
    try:
        yield
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
