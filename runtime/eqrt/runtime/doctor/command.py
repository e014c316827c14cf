"""`eqrt doctor`: is this machine fit for the service, and if not, what to do.

It takes the options of `eqrt serve`, so that with the same --config it looks at what the service
will use; what is not given is left out. Exit status: 0 nothing failed, 1 something did.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from eqrt.core.errors import EqrtError
from eqrt.runtime import serve_options
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.doctor.bus import check_channel
from eqrt.runtime.doctor.finding import Finding, Verdict, fail, has_failed, warn
from eqrt.runtime.doctor.machine import check_machine
from eqrt.runtime.doctor.parts import (
    check_datagrams,
    check_metrics,
    check_model,
    check_output,
    check_profile,
    check_recording,
    check_tile,
)
from eqrt.runtime.operation.realtime import Realtime, parse_cpus
from eqrt.runtime.serve_options import out_channel
from eqrt.runtime.settings import as_toml, namespace

LISTEN_S = 2.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of `eqrt serve`, and the doctor's own."""
    serve_options.add_arguments(parser)
    parser.epilog = "example: eqrt doctor --config /etc/eqrt/eqrt.toml"
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.add_argument(
        "--listen",
        type=_seconds,
        default=LISTEN_S,
        metavar="S",
        help=f"how long to listen on every channel, 0 = not at all (default: {LISTEN_S:g})",
    )


def _seconds(text: str) -> float:
    """A time to wait."""
    try:
        if 0.0 <= (seconds := float(text)) < math.inf:
            return seconds
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds, 0 or more")


def run(args: argparse.Namespace) -> int:
    """Look at everything, say what was found."""
    settings = args.settings.resolve(args, is_complete=False)
    if args.print_config:
        print(as_toml(settings), end="")
        return 0
    asked = namespace(settings)
    findings: list[Finding] = []
    for finding in examine(asked, args.listen):
        findings.append(finding)
        if not args.json:
            _say(finding)
    if args.json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        counts = {verdict: [f.verdict for f in findings].count(verdict) for verdict in Verdict}
        print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    return 1 if has_failed(findings) else 0


def examine(asked: argparse.Namespace, listen_s: float) -> Iterator[Finding]:
    """Finding by finding; `asked` are the options of `eqrt serve`."""
    realtime = Realtime(
        priority=asked.realtime_priority,
        lock_memory=asked.realtime_lock_memory,
        cpus=parse_cpus(asked.realtime_cpus) if asked.realtime_cpus else None,
    )
    state = Path(os.environ.get("STATE_DIRECTORY", ".")).absolute()
    yield from check_machine(realtime, state, strict=asked.realtime_strict)
    profile, finding = check_profile(asked.profile)
    yield finding
    yield check_model(asked.model)
    yield check_tile(asked.tile, profile)
    yield check_metrics(asked.metrics, asked.metrics_anywhere)
    yield check_datagrams(asked.datagrams)
    yield check_recording(asked)
    yield check_output(asked)
    yield from _channels(asked, profile, listen_s)


def _channels(
    asked: argparse.Namespace, profile: Profile | None, listen_s: float
) -> Iterator[Finding]:
    heard = {option.rpartition("=")[2] for option in asked.can or ()}
    roles = () if profile is None else profile.roles
    channels: dict[str, str] = {}
    if not heard:
        yield warn("channels", "none named", "name one with --can or in --config")
    elif profile is not None:
        try:
            channels = parse_channels(asked.can, roles)
        except EqrtError as error:
            yield fail("channels", str(error))
        heard = set(channels.values()) or heard
    out = out_channel(asked)
    for channel in sorted(heard if out is None else heard | {out}):
        yield from check_channel(
            channel,
            asked.can_interface,
            asked.fd,
            profile,
            listen_s if channel in heard else 0.0,
            buses=[role for role in roles if channels.get(role, channel) == channel],
            sends=channel == out,
        )


def _say(finding: Finding) -> None:
    print(f"{finding.verdict:<4}  {finding.check:<14} {finding.found}", flush=True)
    if finding.advice:
        print(f"{'':<21}-> {finding.advice}", flush=True)
