"""`eqrt serve`: predict from a CAN bus, publish on CAN and as local datagrams."""

from __future__ import annotations

import argparse
import contextlib
import gc
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from queue import Empty, Queue

import can

from eqrt.core.errors import UsageError
from eqrt.runtime.bus.buses import open_bus
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.decoding.profile import Profile, load_profile
from eqrt.runtime.operation.changes import Changes
from eqrt.runtime.operation.endpoint import Endpoint
from eqrt.runtime.operation.event_log import LEVELS, EventLog, Level
from eqrt.runtime.operation.realtime import Realtime, Sweeper, parse_cpus, refuse
from eqrt.runtime.operation.reload import Reloader, identity
from eqrt.runtime.operation.service_manager import ServiceManager
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.output.publish_can import CanPublisher
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.serve_options import NO_CHANNEL, add_arguments
from eqrt.runtime.service import Chore, Observer, Publisher, Receiver, Service
from eqrt.runtime.settings import as_toml, namespace
from eqrt.runtime.signals import asked_to_reload, until_told_to_stop
from eqrt.runtime.status_book import status_line

__all__ = ["add_arguments", "run"]
_NOTICE_END_S = 0.1  # how often a thread of python-can looks whether it is to end


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
    settings = args.settings.resolve(args)
    if args.print_config:
        print(as_toml(settings), end="")
        return 0
    return _serve(namespace(settings))


def _serve(args: argparse.Namespace) -> int:
    log = EventLog(args.log_format, LEVELS[args.log_level])
    profile = load_profile(args.profile)
    channels = parse_channels(args.can, profile.roles)
    with contextlib.ExitStack() as stack:
        should_stop = stack.enter_context(until_told_to_stop())
        is_asked = stack.enter_context(asked_to_reload())
        _become_realtime(args, log)
        buses = _open_buses(args, profile, sorted(set(channels.values())), stack)
        several = channels if len(buses) > 1 else None
        pipeline = load_pipeline(args, profile, several, clock=time.monotonic)
        publishers = _publishers(args, buses, stack)
        receiver = _receiver(buses, stack)
        manager = stack.enter_context(ServiceManager.of())
        reloader = Reloader(
            pipeline, args.model, args.tile, is_asked=is_asked, log=log, tell=manager.reload
        )
        endpoint = _endpoint(args, stack)
        observers, chores = _surroundings(args, pipeline, publishers, log, endpoint)
        service = Service(
            pipeline,
            receiver,
            publishers,
            [*observers, manager.report],
            chores=[*chores, reloader, manager],
        )
        gc.freeze()  # what is loaded now stays: the collector need not look at it again
        log.line("ready", f"eqrt serve: {profile.name} on {', '.join(buses)}; Ctrl-C ends")
        log.say(Level.INFO, "running", identity(pipeline.predictor, pipeline.tile))
        if endpoint is not None:
            log.say(Level.INFO, "metrics", f"http://{endpoint.address}/metrics and /health answer")
        manager.ready()
        service.run(should_stop)
        manager.stopping()
    log.line("end", f"eqrt serve: {_summary(pipeline)}")
    return 0


def _become_realtime(args: argparse.Namespace, log: EventLog) -> None:
    problems = Realtime(
        priority=args.realtime_priority,
        lock_memory=args.realtime_lock_memory,
        cpus=parse_cpus(args.realtime_cpus) if args.realtime_cpus else None,
    ).apply()
    if args.realtime_strict:
        refuse(problems)
    for problem in problems:
        log.say(Level.WARNING, "realtime", f"realtime {problem}")


def _endpoint(args: argparse.Namespace, stack: contextlib.ExitStack) -> Endpoint | None:
    if not args.metrics:
        return None
    return stack.enter_context(Endpoint(args.metrics, anywhere=args.metrics_anywhere))


def _surroundings(
    args: argparse.Namespace,
    pipeline: Pipeline,
    publishers: Sequence[Publisher],
    log: EventLog,
    endpoint: Endpoint | None,
) -> tuple[list[Observer], list[Chore]]:
    """Who is told every second, and what is done between messages."""
    observers: list[Observer] = [] if args.quiet else [partial(_say, log)]
    observers.append(Changes(log))
    observers += [one.report for one in publishers if isinstance(one, DatagramPublisher)]
    chores: list[Chore] = []
    if args.realtime_gc_between_cycles:
        chores.append(Sweeper(lambda: pipeline.counters.cycles))
    if endpoint is not None:
        observers.append(endpoint.observe)
        chores.append(endpoint)
    return observers, chores


def _open_buses(
    args: argparse.Namespace, profile: Profile, channels: list[str], stack: contextlib.ExitStack
) -> dict[str, can.BusABC]:
    return {
        channel: stack.enter_context(
            open_bus(channel, args.can_interface, fd=args.fd, receive_ids=profile.arbitration_ids)
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
        # Not SimpleQueue: up to Python 3.12, a signal late in its wait makes the wait endless.
        self._heard: Queue[can.Message | Exception] = Queue()
        self._notifiers = [
            can.Notifier(bus, [_Ear(channel, self._heard)], timeout=_NOTICE_END_S)
            for channel, bus in buses.items()
        ]

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message of any bus; its channel is the name that the bus was opened by.

        Raises can.CanOperationError if a bus can no longer be read.
        """
        try:
            heard = self._heard.get(timeout=timeout)
        except Empty:
            return None
        if isinstance(heard, Exception):
            raise can.CanOperationError(str(heard)) from heard
        return heard

    def __enter__(self) -> Merged:
        return self

    def __exit__(self, *_: object) -> None:
        for notifier in self._notifiers:
            notifier.stop()


class _Ear(can.Listener):
    """Puts what a bus's thread hears where the main thread reads."""

    def __init__(self, channel: str, heard: Queue[can.Message | Exception]) -> None:
        self._channel = channel
        self._heard = heard

    def on_message_received(self, msg: can.Message) -> None:
        msg.channel = self._channel  # some interfaces keep the sender's name for it
        self._heard.put(msg)

    def on_error(self, exc: Exception) -> None:
        self._heard.put(exc)


def _publishers(
    args: argparse.Namespace, buses: dict[str, can.BusABC], stack: contextlib.ExitStack
) -> list[Publisher]:
    publishers: list[Publisher] = []
    if args.out_can != NO_CHANNEL:
        channel = args.out_can or args.can[0].rpartition("=")[2]
        bus = buses.get(channel)
        if bus is None:
            bus = stack.enter_context(
                open_bus(channel, args.can_interface, fd=args.fd, receive_ids=[])
            )
        publishers.append(CanPublisher(bus, base_id=args.out_id, num_modes=args.out_modes))
    elif not args.datagrams:
        raise UsageError("--out-can none and no --datagrams: the predictions would go nowhere")
    if args.datagrams:
        publishers.append(stack.enter_context(DatagramPublisher(args.datagrams)))
    return publishers


def _say(log: EventLog, status: ServiceStatus) -> None:
    text = status_line(status)
    if log.is_json:
        log.line(
            "status",
            text,
            mode=Mode(status.mode).name,
            objects=status.objects,
            messages=status.messages,
            latency_ms=[round(1e3 * latency_s, 2) for latency_s in status.latencies_s],
        )
    else:
        log.line("status", f"{time.strftime('%H:%M:%S')} {text}")


def _summary(pipeline: Pipeline) -> str:
    counters, decoded = pipeline.counters, pipeline.decoder.counters
    return (
        f"{decoded.messages} messages, {decoded.cycles} cycles, {counters.targets} predictions, "
        f"{counters.fallbacks} fallbacks; {decoded.other_id + decoded.wrong_bus} other messages, "
        f"{decoded.not_data + decoded.stray + decoded.short + decoded.bad_checksum} unusable"
    )
