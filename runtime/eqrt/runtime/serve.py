"""`eqrt serve`: predict from a CAN bus, publish on CAN and as local datagrams."""

from __future__ import annotations

import argparse
import contextlib
import gc
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from eqrt.core.errors import UsageError
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.bus.health import in_sum, trouble
from eqrt.runtime.bus.ids import Ids
from eqrt.runtime.bus.links import opener
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.decoding.profile import Profile, builtin_profiles, load_profile
from eqrt.runtime.output.datagrams import DEFAULT_ADDRESS, DatagramPublisher
from eqrt.runtime.output.publish_can import BASE_ID, CanPublisher
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.recording.options import add_record_arguments, start_recorder
from eqrt.runtime.recording.recorder import Recorder
from eqrt.runtime.recording.steps import TapedClock
from eqrt.runtime.service import Observer, Publisher, Service
from eqrt.runtime.signals import until_told_to_stop
from eqrt.runtime.status_book import status_line

NO_CHANNEL = "none"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt serve`."""
    parser.epilog = "example: eqrt serve --can can0 --profile ars408 --tile town.tile"
    add_pipeline_arguments(parser)
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
    parser.add_argument(
        "--out-can",
        metavar="CHANNEL",
        help="the channel to send predictions on (default: the first --can); "
        f"{NO_CHANNEL!r} = not on CAN",
    )
    parser.add_argument(
        "--out-id",
        type=_arbitration_id,
        default=BASE_ID,
        metavar="ID",
        help=f"the first CAN id of the predictions (default {BASE_ID:#x})",
    )
    parser.add_argument(
        "--out-modes",
        type=int,
        default=1,
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
    parser.add_argument(
        "--wait-for-bus",
        action="store_true",
        help="at the start, wait for channels that are not there yet, or down (default: an error); "
        "one that is lost later is waited for in any case",
    )
    parser.add_argument("--quiet", action="store_true", help="no status line every second")
    add_record_arguments(parser)


def _arbitration_id(text: str) -> int:
    """A CAN id, decimal or with 0x."""
    try:
        return int(text, 0)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a CAN id such as 0x6e0") from error


def add_pipeline_arguments(parser: argparse.ArgumentParser, *, of_recordings: bool = False) -> None:
    """What `serve` and `replay` have in common.

    `of_recordings`: where input may be a recording, which says itself what it was made with;
    profile and model are None if not given.
    """
    recorded = "; a recording has its own" if of_recordings else ""
    parser.add_argument(
        "--profile",
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
        help="the map around, from `eqrt tile build` (default: predict without a map)",
    )
    parser.add_argument(
        "--stationary",
        action="store_true",
        help="the sensor stands still: predict although no message tells its motion",
    )


def load_pipeline(
    args: argparse.Namespace,
    profile: Profile,
    channels: dict[str, str] | None,
    clock: Callable[[], float] | None,
) -> Pipeline:
    """The pipeline that `add_pipeline_arguments` describes; the others are as for Pipeline."""
    predictor = Predictor.load(args.model)
    if predictor.license_notice:
        print(f"eqrt: {predictor.license_notice}", file=sys.stderr)
    return Pipeline(
        profile,
        predictor,
        load_tile(args.tile) if args.tile else None,
        channels=channels,
        stationary=args.stationary,
        clock=clock,
    )


def run(args: argparse.Namespace) -> int:
    """Open everything, then serve until SIGTERM or Ctrl-C."""
    profile = load_profile(args.profile)
    channels = parse_channels(args.can, profile.roles)
    with contextlib.ExitStack() as stack:
        should_stop = stack.enter_context(until_told_to_stop())
        heard = sorted(set(channels.values()))
        receiver = stack.enter_context(_receiver(args, profile, heard))
        several = channels if len(heard) > 1 else None
        clock = TapedClock(time.monotonic) if args.record else None
        pipeline = load_pipeline(args, profile, several, clock=clock or time.monotonic)
        publishers = _publishers(args, receiver, stack)
        recorder = None
        if clock:
            recorder = stack.enter_context(start_recorder(args, pipeline, several, clock))
            publishers.append(recorder)
        observers = _observers(args, publishers, receiver)
        service = Service(pipeline, receiver, publishers, observers, witness=recorder)
        gc.freeze()  # what is loaded now stays: the collector need not look at it again
        print(f"eqrt serve: {profile.name} on {', '.join(heard)}; Ctrl-C ends", flush=True)
        service.run(should_stop)
        troubles = in_sum(receiver.health())
    print(f"eqrt serve: {_summary(pipeline)}" + (f"; {troubles}" if troubles else ""))
    return 0


def _receiver(args: argparse.Namespace, profile: Profile, channels: Sequence[str]) -> Receiver:
    """Reads `channels`, and opens the one that predictions go to, if it is another, for sending."""
    wanted: dict[str, Ids | None] = dict.fromkeys(channels, profile.ids)
    if (out := _out_channel(args)) is not None:
        wanted.setdefault(out, ())
    return Receiver(opener(args.can_interface, fd=args.fd), wanted, _warn, wait=args.wait_for_bus)


def _out_channel(args: argparse.Namespace) -> str | None:
    """Where predictions go on CAN; None = nowhere."""
    if args.out_can == NO_CHANNEL:
        return None
    return str(args.out_can or args.can[0].rpartition("=")[2])


def _publishers(
    args: argparse.Namespace, receiver: Receiver, stack: contextlib.ExitStack
) -> list[Publisher]:
    publishers: list[Publisher] = []
    if (out := _out_channel(args)) is not None:
        bus = receiver.connection(out)
        publishers.append(CanPublisher(bus, base_id=args.out_id, num_modes=args.out_modes))
    elif not args.datagrams and not args.record:
        raise UsageError("--out-can none, no --datagrams, no --record: predictions go nowhere")
    if args.datagrams:
        publishers.append(stack.enter_context(DatagramPublisher(args.datagrams)))
    return publishers


def _observers(
    args: argparse.Namespace, publishers: Sequence[Publisher], receiver: Receiver
) -> list[Observer]:
    observers: list[Observer] = [] if args.quiet else [_Terminal(receiver).say]
    observers += [one.report for one in publishers if isinstance(one, DatagramPublisher | Recorder)]
    return observers


class _Terminal:
    """A line every second: how the service is, and what is wrong with its channels."""

    def __init__(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._before = receiver.health()

    def say(self, status: ServiceStatus) -> None:
        """With what has happened to the channels since the last line."""
        health = self._receiver.health()
        text = trouble(self._before, health, time.monotonic())
        self._before = health
        line = status_line(status) + (f"  {text}" if text else "")
        print(f"{time.strftime('%H:%M:%S')} {line}", flush=True)


def _warn(line: str) -> None:
    print(f"eqrt serve: {line}", file=sys.stderr, flush=True)


def _summary(pipeline: Pipeline) -> str:
    counters, decoded = pipeline.counters, pipeline.decoder.counters
    return (
        f"{decoded.messages} messages, {decoded.cycles} cycles, {counters.targets} predictions, "
        f"{counters.fallbacks} fallbacks; {decoded.other_id + decoded.wrong_bus} other messages, "
        f"{decoded.not_data + decoded.stray + decoded.short + decoded.bad_checksum} unusable"
    )
