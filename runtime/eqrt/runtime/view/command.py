"""`eqrt view`: the service, or a recorded file, in a browser.

    eqrt serve  --datagrams-->  eqrt view  --http, web socket-->  browser

A process of its own that the service does not know: it may come, go and be slow.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import sys
import webbrowser
from collections.abc import Awaitable
from pathlib import Path

from eqrt.core.errors import UsageError
from eqrt.runtime.output.datagrams import DEFAULT_ADDRESS
from eqrt.runtime.view.guests import is_loopback
from eqrt.runtime.view.hearing import Ear, listen
from eqrt.runtime.view.live import Live, follow
from eqrt.runtime.view.playback import Playback
from eqrt.runtime.view.recorded import READERS, read_records
from eqrt.runtime.view.server import ViewServer

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 47320


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt view`."""
    parser.epilog = f"start the service with --datagrams {DEFAULT_ADDRESS} for it to be seen"
    parser.add_argument(
        "file",
        nargs="?",
        type=Path,
        metavar="FILE",
        help=f"watch this instead of a running service: {', '.join(READERS)}, or a "
        "folder of `eqrt serve --record` (docs/view.md)",
    )
    add_datagram_argument(parser)
    parser.add_argument(
        "--tile",
        type=Path,
        metavar="FILE",
        help="show the lanes of this tile (default: of the tile that the service uses)",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=DEFAULT_PORT,
        metavar="N",
        help=f"of the page (default {DEFAULT_PORT}; 0 = any that is free)",
    )
    parser.add_argument(
        "--host",
        default=DEFAULT_HOST,
        metavar="ADDRESS",
        help="of the page; another one than this machine's own lets everybody on that network "
        f"watch (default {DEFAULT_HOST})",
    )
    parser.add_argument("--open", action="store_true", help="open the page in a browser here")


def add_datagram_argument(parser: argparse.ArgumentParser) -> None:
    """What `view` and `top` have in common."""
    parser.add_argument(
        "--datagrams",
        default=DEFAULT_ADDRESS,
        metavar="HOST:PORT",
        help=f"where the service sends its datagrams to (default {DEFAULT_ADDRESS})",
    )


def run(args: argparse.Namespace) -> int:
    """Serve the page until SIGTERM or Ctrl-C."""
    if not 0 <= args.port < 65_536:
        raise UsageError(f"--port is {args.port}; give a number from 0 to 65535")
    with contextlib.ExitStack() as stack:
        if args.file is not None:
            playback = Playback(read_records(args.file), args.file.name, args.tile)
            stack.enter_context(playback)
            server = ViewServer(playback, host=args.host, port=args.port)
            work = playback.tell_progress(server)
        else:
            receiver = stack.enter_context(listen(args.datagrams))
            live = Live(Ear(receiver), args.datagrams, args.tile)
            server = ViewServer(live, host=args.host, port=args.port)
            work = follow(live, receiver, server)
        asyncio.run(_serve(server, work, open_page=args.open))
    print("eqrt view: ended")
    return 0


async def _serve(server: ViewServer, work: Awaitable[None], *, open_page: bool) -> None:
    told = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, told.set)
    working = asyncio.ensure_future(work)
    try:
        async with server:
            _say(server, open_page=open_page)
            await told.wait()
    finally:
        working.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await working


def _say(server: ViewServer, *, open_page: bool) -> None:
    address = server.address
    host, _, port = address.removeprefix("http://").rstrip("/").rpartition(":")
    hint = ""
    if is_loopback(host.strip("[]")) and "SSH_CONNECTION" in os.environ:
        hint = f"; from your own machine: ssh -L {port}:{host}:{port} THIS_MACHINE"
    print(f"eqrt view: {address}  Ctrl-C ends{hint}", flush=True)
    if not is_loopback(host.strip("[]")):
        print(f"eqrt view: everybody who can reach {host} can watch", file=sys.stderr)
    if open_page and not webbrowser.open(address):
        print("eqrt view: no browser here; open the address yourself", file=sys.stderr)
