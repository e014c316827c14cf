"""`eqrt bridge`: what a running service says, for other programs while it runs.

    eqrt serve  --datagrams-->  eqrt bridge  -->  PlotJuggler, zenoh

A process of its own that only listens: it may come, go and be slow, and the service does not know.
"""

from __future__ import annotations

import argparse
import select
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

from eqrt.core.errors import UsageError
from eqrt.export.bridges.to_plotjuggler import PLOTJUGGLER_ADDRESS, ToPlotJuggler
from eqrt.runtime.output.datagrams import DEFAULT_ADDRESS
from eqrt.runtime.signals import until_told_to_stop
from eqrt.runtime.view.guests import is_loopback
from eqrt.runtime.view.hearing import Ear, listen

DEFAULT_KEY = "eqrt"
DEFAULT_LISTEN = "tcp/127.0.0.1:7447"
"""Zenoh's usual port, on this machine alone."""
_LOOK_S = 0.2  # how soon a signal is seen
_ONLY_FOR = {
    "send": "plotjuggler",
    "key": "zenoh",
    "listen": "zenoh",
    "connect": "zenoh",
    "zenoh_config": "zenoh",
}


class Bridge(Protocol):
    """Passes on what an ear hears."""

    def pass_on(self, ear: Ear) -> None:
        """Everything that has come since; never waits for anybody."""

    def told(self) -> str:
        """What was passed on since the start, in words."""

    @property
    def where(self) -> str:
        """Where to, in words."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt bridge`."""
    parser.epilog = (
        f"start the service with --datagrams {DEFAULT_ADDRESS}; example: "
        "eqrt bridge --to plotjuggler"
    )
    parser.add_argument(
        "--to",
        required=True,
        choices=tuple(_KINDS),
        help="plotjuggler: numbers to plot, as MessagePack over UDP; zenoh: predictions and "
        "status on two keys (extra: bridges)",
    )
    parser.add_argument(
        "--datagrams",
        default=DEFAULT_ADDRESS,
        metavar="HOST:PORT",
        help=f"where the service sends its datagrams to (default {DEFAULT_ADDRESS})",
    )
    parser.add_argument(
        "--send",
        metavar="HOST:PORT",
        help=f"plotjuggler: where its UDP server listens (default {PLOTJUGGLER_ADDRESS})",
    )
    _add_zenoh_arguments(parser)


def _add_zenoh_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--key",
        metavar="PREFIX",
        help=f"zenoh: what the keys begin with (default {DEFAULT_KEY})",
    )
    parser.add_argument(
        "--listen",
        action="append",
        metavar="ENDPOINT",
        help="zenoh: where subscribers may connect to; can be repeated (default "
        f"{DEFAULT_LISTEN}, nowhere with --connect, the file's with --zenoh-config)",
    )
    parser.add_argument(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="zenoh: a router or peer to connect to, such as tcp/192.168.1.5:7447; can be repeated",
    )
    parser.add_argument(
        "--zenoh-config",
        metavar="FILE",
        help="zenoh: a session configuration (JSON5, YAML), used as it is instead of our own",
    )


def run(args: argparse.Namespace) -> int:
    """Pass on until SIGTERM or Ctrl-C."""
    for option, kind in _ONLY_FOR.items():
        if getattr(args, option) is not None and args.to != kind:
            name = option.replace("_", "-")
            raise UsageError(f"--{name} is for --to {kind}; leave it out with --to {args.to}")
    with (
        until_told_to_stop() as should_stop,
        listen(args.datagrams) as receiver,
        _KINDS[args.to](args) as bridge,
    ):
        ear, said = Ear(receiver), 0
        print(
            f"eqrt bridge: from {args.datagrams} to {bridge.where}  Ctrl-C ends",
            flush=True,
        )
        while not should_stop():
            select.select([receiver], [], [], _LOOK_S)
            bridge.pass_on(ear)
            for reason in list(ear.refused)[said:]:
                print(f"eqrt bridge: not passed on: {reason}", file=sys.stderr, flush=True)
            said = len(ear.refused)
    print(f"eqrt bridge: ended; {bridge.told()}")
    return 0


def _plotjuggler(args: argparse.Namespace) -> AbstractContextManager[Bridge]:
    return ToPlotJuggler(args.send or PLOTJUGGLER_ADDRESS)


def _zenoh(args: argparse.Namespace) -> AbstractContextManager[Bridge]:
    try:
        from eqrt.export.bridges.to_zenoh import ToZenoh, session_config  # noqa: PLC0415 (an extra)
    except ModuleNotFoundError as error:
        raise UsageError(
            f"eqrt bridge --to zenoh needs the package {error.name!r}, which is not installed; "
            "install it with: pip install 'eqrt[bridges]'"
        ) from error
    listens = args.listen
    if listens is None and args.zenoh_config is None:
        listens = [] if args.connect else [DEFAULT_LISTEN]
    for endpoint in listens or []:
        host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
        if host and not is_loopback(host):
            print(f"eqrt bridge: everybody who can reach {host} can listen", file=sys.stderr)
    config = session_config(file=args.zenoh_config, listens=listens, connects=args.connect)
    return ToZenoh(config, key=DEFAULT_KEY if args.key is None else args.key)


_KINDS: dict[str, Callable[[argparse.Namespace], AbstractContextManager[Bridge]]] = {
    "plotjuggler": _plotjuggler,
    "zenoh": _zenoh,
}
