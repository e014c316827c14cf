"""`eqrt serve`: predict from a CAN bus, publish on CAN and as local datagrams."""

from __future__ import annotations

import argparse
import contextlib
import gc
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue

import can

from eqrt.core.errors import UsageError
from eqrt.runtime.bus.buses import open_bus
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.decoding.profile import Profile, builtin_profiles, load_profile
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.publish_can import CanPublisher
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.service import Publisher, Receiver, Service
from eqrt.runtime.signals import until_told_to_stop

NO_CHANNEL = "none"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt serve`."""
    add_pipeline_arguments(parser)
    parser.add_argument(
        "--can",
        required=True,
        action="append",
        metavar="[ROLE=]CHANNEL",
        help="where the sensor is; with ROLE= the channel of one of the profile's buses",
    )
    parser.add_argument("--can-interface", metavar="IF", help="python-can's name; else socketcan")
    parser.add_argument(
        "--out-can",
        metavar="CHANNEL",
        help=f"where predictions go: the first --can unless given; {NO_CHANNEL!r} = not on CAN",
    )
    parser.add_argument(
        "--datagrams",
        action="append",
        default=[],
        metavar="HOST:PORT",
        help="also send predictions as UDP datagrams to a viewer or recorder (repeatable)",
    )
    parser.add_argument("--quiet", action="store_true", help="no status line every second")


def add_pipeline_arguments(parser: argparse.ArgumentParser) -> None:
    """What `serve` and `replay` have in common."""
    parser.add_argument(
        "--profile",
        required=True,
        metavar="NAME|FILE",
        help=f"how messages are read: {', '.join(builtin_profiles())}, or a TOML file",
    )
    parser.add_argument(
        "--model",
        type=Path,
        default=DEFAULT_ARTIFACT,
        metavar="FOLDER",
        help="a model artifact (default: the one that comes with eqrt)",
    )
    parser.add_argument("--tile", type=Path, metavar="FILE", help="map tile; else without a map")
    parser.add_argument(
        "--stationary", action="store_true", help="the sensor stands still, and no message says so"
    )


def load_pipeline(
    args: argparse.Namespace,
    profile: Profile,
    channels: dict[str, str],
    clock: Callable[[], float] | None,
) -> Pipeline:
    """The pipeline that `add_pipeline_arguments` describes."""
    return Pipeline(
        profile,
        Predictor.load(args.model),
        load_tile(args.tile) if args.tile else None,
        channels=channels if len(set(channels.values())) > 1 else None,
        stationary=args.stationary,
        clock=clock,
    )


def run(args: argparse.Namespace) -> int:
    """Open everything, then serve until SIGTERM or Ctrl-C."""
    profile = load_profile(args.profile)
    channels = parse_channels(args.can, profile.roles)
    with contextlib.ExitStack() as stack:
        should_stop = stack.enter_context(until_told_to_stop())
        buses = _open_buses(args, profile, sorted(set(channels.values())), stack)
        pipeline = load_pipeline(args, profile, channels, clock=time.monotonic)
        publishers = _publishers(args, buses, stack)
        receiver = _receiver(buses, stack)
        report = _say_nothing if args.quiet else _say
        service = Service(pipeline, receiver, publishers, report)
        gc.freeze()  # what is loaded now stays: the collector need not look at it again
        print(f"eqrt serve: {profile.name} on {', '.join(buses)}; Ctrl-C ends", flush=True)
        service.run(should_stop)
    print(f"eqrt serve: {_summary(pipeline)}")
    return 0


def _open_buses(
    args: argparse.Namespace, profile: Profile, channels: list[str], stack: contextlib.ExitStack
) -> dict[str, can.BusABC]:
    return {
        channel: stack.enter_context(
            open_bus(channel, args.can_interface, receive_ids=profile.arbitration_ids)
        )
        for channel in channels
    }


def _receiver(buses: Mapping[str, can.BusABC], stack: contextlib.ExitStack) -> Receiver:
    """One bus is read directly; several, in python-can's threads."""
    if len(buses) == 1:
        return next(iter(buses.values()))
    return stack.enter_context(Merged(buses))


class Merged:
    """Several buses read as one, each by a thread of python-can's."""

    def __init__(self, buses: Mapping[str, can.BusABC]) -> None:
        self._messages: SimpleQueue[can.Message] = SimpleQueue()
        self._notifiers = [
            can.Notifier(bus, [partial(self._put, channel)]) for channel, bus in buses.items()
        ]

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message of any bus; its channel is the name that the bus was opened by."""
        try:
            return self._messages.get(timeout=timeout)
        except Empty:
            return None

    def __enter__(self) -> Merged:
        return self

    def __exit__(self, *_: object) -> None:
        for notifier in self._notifiers:
            notifier.stop()

    def _put(self, channel: str, message: can.Message) -> None:
        message.channel = channel  # some interfaces keep the sender's name for it
        self._messages.put(message)


def _publishers(
    args: argparse.Namespace, buses: dict[str, can.BusABC], stack: contextlib.ExitStack
) -> list[Publisher]:
    publishers: list[Publisher] = []
    if args.out_can != NO_CHANNEL:
        channel = args.out_can or next(iter(buses))
        bus = buses.get(channel)
        if bus is None:
            bus = stack.enter_context(open_bus(channel, args.can_interface, receive_ids=[]))
        publishers.append(CanPublisher(bus))
    elif not args.datagrams:
        raise UsageError("--out-can none and no --datagrams: the predictions would go nowhere")
    if args.datagrams:
        publishers.append(stack.enter_context(DatagramPublisher(args.datagrams)))
    return publishers


def _say(line: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {line}", flush=True)


def _say_nothing(_line: str) -> None:
    pass


def _summary(pipeline: Pipeline) -> str:
    counters, decoded = pipeline.counters, pipeline.decoder.counters
    return (
        f"{decoded.messages} messages, {decoded.cycles} cycles, {counters.targets} predictions, "
        f"{counters.fallbacks} fallbacks; {decoded.other_id + decoded.wrong_bus} other messages, "
        f"{decoded.not_data + decoded.stray + decoded.short + decoded.bad_checksum} unusable"
    )
