"""`eqrt serve`: predict from a CAN bus, publish on CAN and as local datagrams."""

from __future__ import annotations

import argparse
import contextlib
import gc
import sys
import time
from collections.abc import Callable, Sequence

from eqrt.runtime.advice import taken_to_stand, unused_map
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.bus.health import in_sum, trouble
from eqrt.runtime.bus.ids import Ids
from eqrt.runtime.bus.links import opener
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.decoding.profile import Profile, load_profile
from eqrt.runtime.operation.changes import BusTeller, Changes
from eqrt.runtime.operation.endpoint import Endpoint
from eqrt.runtime.operation.event_log import LEVELS, EventLog, Level
from eqrt.runtime.operation.outlet import Outlet
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
from eqrt.runtime.prediction.watched import Model, Runner, Watched
from eqrt.runtime.recording.identity import exchanged
from eqrt.runtime.recording.options import start_recorder
from eqrt.runtime.recording.recorder import Recorder
from eqrt.runtime.recording.runs import RunTape, TapedRunner
from eqrt.runtime.recording.steps import TapedClock
from eqrt.runtime.serve_options import add_arguments, check_outputs, out_channel
from eqrt.runtime.service import Chore, Observer, Publisher, Service
from eqrt.runtime.settings import as_toml, namespace
from eqrt.runtime.signals import asked_to_reload, until_told_to_stop
from eqrt.runtime.status_book import status_line

__all__ = ["add_arguments", "run"]


def load_pipeline(
    args: argparse.Namespace,
    profile: Profile,
    channels: dict[str, str] | None,
    clock: Callable[[], float] | None,
    run_by: Callable[[Model], Runner] | None = None,
) -> Pipeline:
    """The pipeline that `add_pipeline_arguments` describes; the others are as for Pipeline."""
    predictor = Predictor.load(args.model)
    if predictor.license_notice:
        Outlet(sys.stderr).put(f"eqrt: {predictor.license_notice}")
    tile = load_tile(args.tile) if args.tile else None
    standing = taken_to_stand(profile, stationary=args.stationary)
    for warning in filter(None, (unused_map(profile, tile), standing)):
        Outlet(sys.stderr).put(f"eqrt: {warning}")
    return Pipeline(
        profile,
        predictor,
        tile,
        channels=channels,
        stationary=args.stationary,
        clock=clock,
        run_by=run_by,
    )


def run(args: argparse.Namespace) -> int:
    """Open everything, then serve until SIGTERM or Ctrl-C."""
    settings = args.settings.resolve(args)
    if args.print_config:
        print(as_toml(settings), end="")
        return 0
    return _serve(namespace(settings))


def _serve(args: argparse.Namespace) -> int:
    check_outputs(args)
    log = EventLog(args.log_format, LEVELS[args.log_level])
    profile = load_profile(args.profile)
    channels = parse_channels(args.can, profile.roles)
    with contextlib.ExitStack() as stack:
        should_stop = stack.enter_context(until_told_to_stop())
        is_asked = stack.enter_context(asked_to_reload())
        _become_realtime(args, log)
        heard = sorted(set(channels.values()))
        receiver = stack.enter_context(_receiver(args, profile, heard, log))
        several = channels if len(heard) > 1 else None
        pipeline, recorder = _pipeline(args, profile, several, stack)
        publishers = _publishers(args, receiver, stack)
        if recorder is not None:
            publishers.append(recorder)
        manager = stack.enter_context(ServiceManager.of())
        reloader = Reloader(
            pipeline,
            args.model,
            args.tile,
            is_asked=is_asked,
            log=log,
            tell=manager.reload,
            exchanged=_noted(pipeline, recorder),
        )
        endpoint = _endpoint(args, stack)
        observers, chores = _surroundings(
            args, pipeline, receiver, publishers, log=log, endpoint=endpoint
        )
        service = Service(
            pipeline,
            receiver,
            publishers,
            [*observers, manager.report],
            chores=[*chores, reloader, manager],
            witness=recorder,
        )
        gc.freeze()  # what is loaded now stays: the collector need not look at it again
        log.line("ready", f"eqrt serve: {profile.name} on {', '.join(heard)}; Ctrl-C ends")
        log.say(Level.INFO, "running", identity(pipeline.predictor, pipeline.tile))
        for sensor in profile.sensors:
            log.say(Level.INFO, f"mount-{sensor.name}", f"{sensor.name}: mount {sensor.place}")
        if endpoint is not None:
            log.say(Level.INFO, "metrics", f"http://{endpoint.address}/metrics and /health answer")
        manager.ready()
        service.run(should_stop)
        manager.stopping()
        troubles = in_sum(receiver.health())
    log.line("end", f"eqrt serve: {_summary(pipeline)}" + (f"; {troubles}" if troubles else ""))
    return 0


def _pipeline(
    args: argparse.Namespace,
    profile: Profile,
    channels: dict[str, str] | None,
    stack: contextlib.ExitStack,
) -> tuple[Pipeline, Recorder | None]:
    """The pipeline, and who records what decides its predictions, if it is to be recorded."""
    if not args.record:
        return load_pipeline(args, profile, channels, clock=time.monotonic), None
    clock, runs = TapedClock(time.monotonic), RunTape()

    def taped(model: Model) -> Runner:
        return TapedRunner(Watched(model), runs)

    pipeline = load_pipeline(args, profile, channels, clock=clock, run_by=taped)
    return pipeline, stack.enter_context(start_recorder(args, pipeline, channels, clock, runs))


def _noted(pipeline: Pipeline, recorder: Recorder | None) -> Callable[[], None]:
    """Has the recording say that the pipeline has got another tile or model."""

    def note() -> None:
        if recorder is not None:
            recorder.describe(exchanged(recorder.description, pipeline))

    return note


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
    receiver: Receiver,
    publishers: Sequence[Publisher],
    *,
    log: EventLog,
    endpoint: Endpoint | None,
) -> tuple[list[Observer], list[Chore]]:
    """Who is told every second, and what is done between messages."""
    observers: list[Observer] = [] if args.quiet else [_Teller(log, receiver).say]
    observers.append(Changes(log))
    observers += [one.report for one in publishers if isinstance(one, DatagramPublisher | Recorder)]
    chores: list[Chore] = []
    if args.realtime_gc_between_cycles:
        chores.append(Sweeper(lambda: pipeline.counters.cycles))
    if endpoint is not None:
        observers.append(endpoint.observe)
        chores.append(endpoint)
    return observers, chores


def _receiver(
    args: argparse.Namespace, profile: Profile, channels: Sequence[str], log: EventLog
) -> Receiver:
    """Reads `channels`, and opens the one that predictions go to, if it is another, for sending."""
    wanted: dict[str, Ids | None] = dict.fromkeys(channels, profile.ids)
    if (out := out_channel(args)) is not None:
        wanted.setdefault(out, ())
    say = BusTeller(log, sys.stderr)
    return Receiver(opener(args.can_interface, fd=args.fd), wanted, say, wait=args.wait_for_bus)


def _publishers(
    args: argparse.Namespace, receiver: Receiver, stack: contextlib.ExitStack
) -> list[Publisher]:
    publishers: list[Publisher] = []
    if (out := out_channel(args)) is not None:
        outbox = receiver.connection(out).outbox
        publishers.append(CanPublisher(outbox, base_id=args.out_id, num_modes=args.out_modes))
    if args.datagrams:
        publishers.append(stack.enter_context(DatagramPublisher(args.datagrams)))
    return publishers


class _Teller:
    """Says every second how the service is, and what is wrong with its channels."""

    def __init__(self, log: EventLog, receiver: Receiver) -> None:
        self._log = log
        self._receiver = receiver
        self._before = receiver.health()

    def say(self, status: ServiceStatus) -> None:
        """With what has happened to the channels since the last line."""
        health = self._receiver.health()
        text = trouble(self._before, health, time.monotonic())
        self._before = health
        line = status_line(status) + (f"  {text}" if text else "")
        if not self._log.is_json:
            self._log.line("status", f"{time.strftime('%H:%M:%S')} {line}")
            return
        self._log.line(
            "status",
            line,
            mode=Mode(status.mode).name,
            objects=status.objects,
            messages=status.messages,
            latency_ms=[round(1e3 * latency_s, 2) for latency_s in status.latencies_s],
        )


def _summary(pipeline: Pipeline) -> str:
    counters, decoded = pipeline.counters, pipeline.decoder.counters
    return (
        f"{decoded.messages} messages, {decoded.cycles} cycles, {counters.targets} predictions, "
        f"{counters.fallbacks} fallbacks; {decoded.other_id + decoded.wrong_bus} other messages, "
        f"{decoded.not_data + decoded.stray + decoded.short + decoded.bad_checksum} unusable"
    )
