"""Measures the whole service, one number of objects after the other."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.advice import never_came, without_motion
from eqrt.runtime.bench.environment import read_environment
from eqrt.runtime.bench.model import Say, identity, load_noticed
from eqrt.runtime.bench.options import artifact_of
from eqrt.runtime.bench.report import Case, Report, Settings, report_now
from eqrt.runtime.bench.service.case import Setup, measure_service, measure_service_start
from eqrt.runtime.bench.service.crowd import DRIVE, PROFILE
from eqrt.runtime.bench.service.orders import BusOrder
from eqrt.runtime.bench.table import case_lines, closing_lines, heading_lines
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.detections import EgoMotion, EgoPose
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.signals import until_told_to_stop
from eqrt.runtime.tracking.ego import EgoTracker


def setup_of(args: argparse.Namespace, before: Sequence[int], cores: Sequence[int]) -> Setup:
    """The service and traffic that the options ask for.

    `before`: the cores this process could use; `cores`: those it may now. Traffic takes the others,
    if there are any. Raises UsageError for options that do not fit, and what opening raises.
    """
    bus = BusOrder(
        channel=args.can or f"eqrt-bench-{os.getpid()}",
        interface=args.can_interface if args.can else LOCAL,
        fd=args.fd,
    )
    if args.can_interface and not args.can:
        raise UsageError("--can-interface needs --can, the channel to open through it")
    open_bus(bus.channel, bus.interface, fd=bus.fd, receive_ids=[]).shutdown()
    setup = Setup(
        bus=bus,
        profile=PROFILE,
        model=artifact_of(args),
        tile=DRIVE.tile,
        stationary=False,
        log=None,
        traffic_cores=tuple(sorted(set(before) - set(cores))) or tuple(cores),
    )
    return _of_log(args, setup)


def _of_log(args: argparse.Namespace, setup: Setup) -> Setup:
    given = {name: getattr(args, name) for name in ("profile", "tile", "stationary")}
    if args.log is None:
        for name, value in given.items():
            if value is not None:
                raise UsageError(f"--{name} needs --log; generated traffic has its own")
        return setup
    if args.profile is None:
        raise UsageError("--log needs --profile: which sensor's messages are in it?")
    if args.objects is not None:
        raise UsageError("--log has the objects it has: leave out --objects")
    load_profile(args.profile)
    if args.tile is not None:
        load_tile(args.tile)
    return replace(
        setup,
        log=args.log.resolve(),
        profile=args.profile,
        tile=args.tile,
        stationary=bool(args.stationary),
    )


def objects_in(log: Path, profile: str, *, stationary: bool = False) -> int:
    """The median number of objects in a cycle of a log, at least 1. Raises EqrtError if there is
    no cycle, or nothing tells how the car moves at any of them: then nothing would be predicted.
    """
    known = load_profile(profile)
    decoder, ego = Decoder(known), EgoTracker(stationary=stationary or not known.has_ego)
    counts, is_placed = [], False
    for message in read_log(log):
        for event in decoder.feed(message, message.timestamp):
            if isinstance(event, EgoMotion):
                ego.motion(event)
            elif isinstance(event, EgoPose):
                ego.pose(event)
            else:
                counts.append(len(event.object_id))
                is_placed = is_placed or ego.at(event.timestamp_s) is not None
    if not counts:
        raise EqrtError(f"{log}: no object cycle of the profile {profile} in it")
    if not is_placed:
        raise EqrtError(f"{log}: no prediction, NO_POSE: {without_motion(never_came(decoder))}")
    return max(1, round(float(np.median(counts))))


def bench_service(setup: Setup, settings: Settings, say: Say) -> Report:
    """Measure every case.

    A first Ctrl-C ends it early: what was measured until then is reported, as INVALID. Raises
    EqrtError if a process fails, or not a single case was measured.
    """
    environment = read_environment()
    model = identity(load_noticed(setup.model, settings.threads))
    if setup.log is not None:
        objects = objects_in(setup.log, setup.profile, stationary=setup.stationary)
        settings = replace(settings, targets=(objects,))
    settings = replace(settings, bus=_named(setup.bus))
    cases: list[Case] = []
    with until_told_to_stop() as should_stop:
        cold_start = measure_service_start(setup, settings, environment, should_stop)
        say(heading_lines(settings, environment, model, cold_start))
        for objects in settings.targets:
            case = measure_service(setup, objects, settings, environment, should_stop)
            if case is None:
                break
            cases.append(case)
            say(case_lines(case))
            if should_stop():
                break
    if not cases:
        raise EqrtError("stopped before anything was measured")
    report = report_now(settings, environment, model, cold_start, cases)
    say(closing_lines(report))
    return report


def _named(bus: BusOrder) -> str:
    kind = {None: "", True: ", CAN FD", False: ", classic CAN"}[bus.fd]
    channel = "" if bus.interface == LOCAL else f"{bus.channel} through "
    return f"{channel}{bus.interface or 'socketcan'}{kind}"
