"""Killing the service, again and again, while traffic goes on: `python -m faults.restarts`.

SIGTERM must end it cleanly; SIGKILL may come at any moment, SIGSTOP holds it up for a while. After
each it is started anew, as a service manager does, and must predict at once.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from eqrt.runtime.bus.buses import LOCAL
from faults.machine import CHANNELS, PATIENCE_S, Sensor
from faults.promises import sound
from processes import Heard, Serving

LONGEST_RUN_S = 1.5
STOPPED_S = 0.5


@dataclass
class Restarts:
    """What was seen."""

    first_prediction_s: list[float] = field(default_factory=list)
    """From the start of the process."""
    end_s: list[float] = field(default_factory=list)
    """From SIGTERM to the end of the process."""
    unclean: list[str] = field(default_factory=list)
    """Ends by SIGTERM with another status than 0, or with a word on stderr."""
    signals: dict[str, int] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """For the terminal."""
        told = ", ".join(f"{count} {name}" for name, count in sorted(self.signals.items()))
        lines = [f"{len(self.first_prediction_s)} starts; {told}"]
        for name, values in (
            ("start to first prediction", self.first_prediction_s),
            ("SIGTERM to end", self.end_s),
        ):
            middle, worst = np.median(values), max(values)
            lines.append(f"{name}: median {middle:.2f} s, worst {worst:.2f} s of {len(values)}")
        lines.append(f"unclean ends: {'; '.join(self.unclean) or 'none'}")
        return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 1 if an end was not clean."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=100)
    args = parser.parse_args(arguments)
    seen = restarts(args.times)
    print("\n".join(seen.lines()))
    return int(bool(seen.unclean))


def restarts(times: int, seed: int = 0) -> Restarts:
    """Start it so many times, and end it in one of three ways."""
    dice, seen, channel = random.Random(seed), Restarts(), next(CHANNELS)
    with Sensor(channel):
        for number in range(times):
            name = ("SIGTERM", "SIGKILL", "SIGSTOP")[number % 3]
            seen.signals[name] = seen.signals.get(name, 0) + 1
            with Heard(channel, []) as heard:
                _one_life(channel, heard, signal.Signals[name], dice, seen)
                for forecast in heard.forecasts:
                    sound(forecast)
    return seen


def _one_life(
    channel: str, heard: Heard, end: signal.Signals, dice: random.Random, seen: Restarts
) -> None:
    begun_s = time.monotonic()
    options = ["--can", channel, "--can-interface", LOCAL, "--profile", "generic", "--quiet"]
    with Serving(*options, "--datagrams", heard.address) as service:
        while not any(forecast.num_targets for forecast in heard.forecasts):
            assert time.monotonic() < begun_s + PATIENCE_S, "no prediction"
            time.sleep(0.005)
        first = next(forecast for forecast in heard.forecasts if forecast.num_targets)
        seen.first_prediction_s.append(first.made_s - begun_s)
        time.sleep(dice.uniform(0.0, LONGEST_RUN_S))
        if end is signal.SIGSTOP:
            service.send(signal.SIGSTOP)
            time.sleep(STOPPED_S)
            service.send(signal.SIGCONT)
        if end is signal.SIGKILL:
            service.end(signal.SIGKILL)
            return
        told_s = time.monotonic()
        status, _, stderr = service.end()
        seen.end_s.append(time.monotonic() - told_s)
        if status or stderr:
            seen.unclean.append(f"status {status}, {stderr.strip()[:80]!r}")


if __name__ == "__main__":
    sys.exit(main())
