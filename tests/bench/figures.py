"""`make figures`: what eqrt does on this machine, measured, each with how it was measured.

Uses what is in the repository only. Wants a quiet machine; nothing here is a test.
"""

from __future__ import annotations

import itertools
import os
import platform
import re
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from can_recordings import detections_of, feed_all, messages_of
from drives import DEMO, DRIVES, TILE, shipped_predictor
from eqrt.runtime.bench.environment import Environment, read_environment
from eqrt.runtime.bench.report import PERIODIC, SERVICE, Settings
from eqrt.runtime.bench.service.case import Setup, measure_service
from eqrt.runtime.bench.service.crowd import PROFILE, crowded_cycles
from eqrt.runtime.bench.service.orders import BusOrder
from eqrt.runtime.bench.table import ms
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.demo.score import Scoreboard
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay
from processes import PATIENCE_S, Serving, playing
from rav4_drive import read_drive

OBJECTS, SECONDS, LOG_S, STARTS = 32, 70.0, 30.0, 9
TRAJECTORY_ID = 0x6E1  # of CAN FD
SETTINGS = Settings(
    benchmark=SERVICE,
    targets=(OBJECTS,),
    seconds=SECONDS,
    schedule=PERIODIC,
    rate_hz=10.0,
    threads=1,
)
CHANNELS = (f"figures-{os.getpid()}-{number}" for number in itertools.count())

Float64 = NDArray[np.float64]


def main() -> int:
    """Measure and print, one section after the other."""
    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "busy.log"
        write_log(log, busy_messages())
        for title, lines in (
            ("decoding", decode_counts()),
            ("ego motion", ego_drift()),
            ("replay, not in real time", replays()),
            ("service", service()),
            ("start", starts(log)),
        ):
            print(f"\n{title}")
            for line in lines:
                print(f"  {line}", flush=True)
    return 0


def machine() -> str:
    """What the figures hold for."""
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        model = re.search(r"model name\s*: (.*)", file.read())
    packages = ", ".join(f"{name} {version(name)}" for name in ("onnxruntime", "numpy"))
    return (
        f"{model[1] if model else platform.processor()}, {os.cpu_count()} cores, "
        f"load {os.getloadavg()[0]:.1f}; Python {platform.python_version()}, {packages}; "
        f"model {shipped_predictor().model_id}"
    )


def decode_counts() -> Iterator[str]:
    """Against what the recordings' publishers decoded."""
    truth = {"ars408": "5,609 in 2,001", "rav4": "10,100 in 1,200", "srr520": "40 in 1"}
    names = {"ars408": "ars408", "rav4": "toyota-rav4", "srr520": "srr520"}
    for recording, profile in names.items():
        messages = messages_of(recording)
        decoder = Decoder(load_profile(profile))
        events = feed_all(decoder, messages)
        cycles = detections_of(events + decoder.poll(messages[-1].timestamp + 1.0))
        objects = sum(len(cycle.object_id) for cycle in cycles)
        yield (
            f"{recording:8} {objects:,} objects in {len(cycles):,} cycles "
            f"(truth {truth[recording]}), of {len(messages):,} messages"
        )


def ego_drift() -> Iterator[str]:
    """Dead reckoning of the RAV4 against its GNSS track, median over windows from true poses."""
    drive = read_drive()
    raw = drive.drift([(0.0, 1.0)] * len(drive.window_starts_s))
    learned = drive.drift(drive.learn())
    for name, drift in (("as measured", raw), ("bias and scale learned", learned)):
        figures = ", ".join(f"{away:.2f} m after {after:.0f} s" for after, away in drift.items())
        yield f"RAV4 against GNSS, {name:22} {figures}"


def replays() -> Iterator[str]:
    """Speed on each recording, and errors against where the tracks were measured later."""
    logs = {
        "ngsim (demo)": DRIVES["ngsim"],
        "rav4 (demo)": replace(DRIVES["rav4"], log=DEMO / "rav4.log.gz"),
        "rav4": DRIVES["rav4"],
        "ars408": DRIVES["ars408"],
    }
    yield (
        f"{'':14}{'log':>7} {'x real':>7} {'cycles':>7} {'predictions':>12} {'scored':>7} "
        f"{'young':>7}{'ADE 3 s eqrt, const. velocity':>32}{'FDE 3 s':>16}"
    )
    for name, drive in logs.items():
        messages = list(read_log(drive.log))
        tile = load_tile(drive.tile) if drive.tile else None
        pipeline = Pipeline(load_profile(drive.profile), shipped_predictor(), tile)
        started_s = time.perf_counter()
        forecasts = list(replay(pipeline, messages))
        spent_s = time.perf_counter() - started_s
        lasts_s = messages[-1].timestamp - messages[0].timestamp
        yield (
            f"{name:14}{lasts_s:5.0f} s {lasts_s / spent_s:7.1f} {pipeline.counters.cycles:7,} "
            f"{pipeline.counters.targets:12,} {scores(forecasts)}"
        )


def scores(forecasts: Iterable[ForecastSet]) -> str:
    """How many could be scored, and how many could not but for the youth of their tracks; ADE and
    FDE of eqrt and of constant velocity.
    """
    board = Scoreboard()
    for forecast in forecasts:
        board.add(forecast)
    if not board.count:
        return "none"
    ours, baseline = board.tables()
    ade, fde = (f"{ours[key]:7.2f} {baseline[key]:7.2f}" for key in ("ade_3s", "fde_3s"))
    return f"{board.count:7,} {board.too_young:7,} {ade:>31} {fde:>15}"


# --- the service, in a process of its own


def service() -> Iterator[str]:
    """32 objects at 10 Hz, sent by one process and answered by another: `eqrt bench --service`."""
    environment = read_environment()
    for name, fd in (("CAN FD", True), ("classic CAN", False)):
        bus = BusOrder(channel=next(CHANNELS), interface=LOCAL, fd=fd)
        case = measure_service(setup_on(bus, environment), OBJECTS, SETTINGS, environment, never)
        assert case is not None
        total, memory = case.judged.total.percentiles, case.resources
        yield (
            f"{name:12} last message of a cycle to the last of its predictions on the bus: "
            f"p50 {ms(total['p50'].value_ns)} ms, p99 {ms(total['p99'].value_ns)} ms "
            f"({case.judged.samples} cycles of {OBJECTS} objects)"
        )
        yield f"{name:12} of which, medians, ms: " + ", ".join(
            f"{stage} {ms(found.percentiles['p50'].value_ns)}"
            for stage, found in case.judged.stages.items()
        )
        yield (
            f"{name:12} memory of the process after {SECONDS:.0f} s: "
            f"{memory.rss_end_mib:.1f} MiB, at most {memory.rss_peak_mib:.1f} MiB"
        )


def never() -> bool:
    """Measure to the end."""
    return False


def setup_on(bus: BusOrder, environment: Environment) -> Setup:
    """The service on this bus, and its traffic."""
    return Setup(
        bus=bus,
        profile=PROFILE,
        model=DEFAULT_ARTIFACT,
        tile=TILE,
        stationary=False,
        log=None,
        traffic_cores=environment.cores_allowed,
    )


def starts(log: Path) -> Iterator[str]:
    """From creating the process to the first prediction on the bus, while a drive is playing."""
    channel, spent_s = next(CHANNELS), []
    with playing(log, "--can", channel, "--loop"), open_bus(channel, LOCAL) as ear:
        for _ in range(STARTS):
            started_s = time.monotonic()
            options = ["--can", channel, "--can-interface", LOCAL, "--profile", "generic"]
            serving = Serving(*options, "--tile", str(TILE), "--quiet")
            wait_for_prediction(ear)
            spent_s.append(time.monotonic() - started_s)
            serving.end()
            while ear.recv(0.0) is not None:  # what it has said until then
                pass
    yield (
        f"process to first prediction: median {np.median(spent_s):.2f} s, "
        f"{min(spent_s):.2f} to {max(spent_s):.2f} s ({STARTS} starts, files in the page cache)"
    )


def wait_for_prediction(ear: can.BusABC) -> None:
    """Until somebody has sent the prediction of an object."""
    give_up_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up_s:
        message = ear.recv(1.0)
        if message is not None and message.arbitration_id == TRAJECTORY_ID:
            return
    raise TimeoutError("no prediction came")


def busy_messages() -> Iterator[can.Message]:
    """Half a minute of traffic that never has fewer objects."""
    for number, cycle in enumerate(itertools.islice(crowded_cycles(OBJECTS), round(10 * LOG_S))):
        for message in cycle:
            message.timestamp += number / 10
            message.channel = "can0"
            yield message


def write_log(path: Path, messages: Iterable[can.Message]) -> None:
    """As candump text."""
    with can.CanutilsLogWriter(path) as writer:
        for message in messages:
            writer.on_message_received(message)


if __name__ == "__main__":
    sys.exit(main())
