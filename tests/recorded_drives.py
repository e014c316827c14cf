"""A drive that is played to a service which records it."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from drives import DRIVES, first_seconds
from eqrt.runtime.bus.buses import LOCAL
from processes import EQRT, PATIENCE_S, Heard, Serving, playing

CHANNELS = (f"record-{number}-{time.monotonic_ns()}" for number in itertools.count())
SECONDS = 4.0


@contextlib.contextmanager
def recorded_drive(
    name: str,
    folder: Path,
    log: Path,
    *options: str,
    seconds: float = SECONDS,
    until: int | None = None,
    command: Sequence[str] = EQRT,
) -> Iterator[tuple[Serving, Heard]]:
    """A service that records, and has been played some seconds of a drive, or so much of them
    that it has sent `until` cycles; then it is still being played. `command`: as of Serving.
    """
    drive = DRIVES[name]
    channels = {role: next(CHANNELS) for role in drive.roles}
    cans = [f"--can={role}={channel}" for role, channel in channels.items()]
    log.write_text(first_seconds(drive.log, seconds))
    with Heard(next(CHANNELS)) as heard:
        more = ["--can-interface", LOCAL, "--out-can=none", "--datagrams", heard.address]
        arguments = [*cans, *more, *drive.options, "--record", str(folder), *options]
        service = Serving(*arguments, command=command)
        with service:
            routes = [f"--can={drive.roles[role]}={channel}" for role, channel in channels.items()]
            with playing(log, *routes) as player:
                if until is None:
                    player.wait(PATIENCE_S)
                else:
                    patiently(lambda: len(heard.forecasts) >= until)
                yield service, heard


def patiently(condition: Callable[[], bool]) -> None:
    """Wait until it holds."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < give_up_s
        time.sleep(0.02)
