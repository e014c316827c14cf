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
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from can_recordings import detections_of, feed_all, messages_of
from drives import DEMO, DRIVES, TILE, shipped_predictor
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.detections import Detections, EgoMotion, EgoPose
from eqrt.runtime.decoding.generic_objects import MAX_OBJECT_ID, encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.demo.score import Scoreboard
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay
from processes import PATIENCE_S, Heard, Serving, playing
from rav4_drive import read_drive

OBJECTS, SECONDS, STARTS = 32, 30.0, 9
ASIDE_M = 4.0  # between a recorded car and its copy
MESSAGE_S = 0.00025  # a classic message of eight bytes on a bus of 500 kbit/s
LAST_INPUT_ID = 0x5A5  # OBJECT_MOTION ends a cycle of the generic object list
STATUS_IDS, DETAIL_IDS = (0x6E0, 0x6E2), (0x6E1, 0x6E5)
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
            ("the pipeline by stage", stages(log)),
            ("service", service(log)),
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
    yield f"{'':14}{'log':>7} {'x real':>7} {'cycles':>7} {'predictions':>12} {'scored':>7}" + (
        f"{'ADE 3 s eqrt, const. velocity':>32}{'FDE 3 s':>16}"
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
    """How many could be scored, and ADE and FDE of eqrt and of constant velocity."""
    board = Scoreboard()
    for forecast in forecasts:
        board.add(forecast)
    if not board.count:
        return "none"
    ours, baseline = board.tables()
    ade, fde = (f"{ours[key]:7.2f} {baseline[key]:7.2f}" for key in ("ade_3s", "fde_3s"))
    return f"{board.count:7,} {ade:>31} {fde:>15}"


def stages(log: Path) -> Iterator[str]:
    """Medians over the busy drive, in this process."""
    pipeline = Pipeline(
        load_profile("generic"), shipped_predictor(), load_tile(TILE), clock=time.perf_counter
    )
    spent: dict[str, list[float]] = defaultdict(list)
    for message in read_log(log):
        for forecast in pipeline.feed(message, message.timestamp):
            spent["all"].append(forecast.compute_s)
            spent["tracks"].append(pipeline.times.tracks_s)
            spent["scene"].append(pipeline.times.scene_s)
            spent["inference"].append(pipeline.times.infer_s)
            spent["guard"].append(pipeline.times.guard_s)
    yield f"{OBJECTS} objects, ms: " + ", ".join(
        f"{name} {1e3 * np.median(values):.2f}" for name, values in spent.items()
    )


# --- the service, in a process of its own


def service(log: Path) -> Iterator[str]:
    """32 objects at 10 Hz, played by one process, served by a second, heard by this one."""
    for name, options in (("CAN FD", ["--fd"]), ("classic CAN", ["--no-fd"])):
        channel = next(CHANNELS)
        bus = ["--can", channel, "--can-interface", LOCAL]
        with (
            Heard(channel) as heard,
            Serving(*bus, *options, "--profile", "generic", "--tile", str(TILE)) as serving,
        ):
            with playing(log, "--can", channel) as player:
                player.wait()
            memory = memory_mib(serving.pid)
            serving.end()
        latency_ms = 1e3 * np.array(latencies_s(heard.messages))
        p50, p99 = np.quantile(latency_ms, [0.5, 0.99])
        yield (
            f"{name:12} last message of a cycle to the last of its predictions on the bus: "
            f"p50 {p50:.1f} ms, p99 {p99:.1f} ms ({len(latency_ms)} cycles of {OBJECTS} objects)"
        )
        yield (
            f"{name:12} memory of the process after {SECONDS:.0f} s: "
            f"{memory['VmRSS']:.1f} MiB, at most {memory['VmHWM']:.1f} MiB"
        )


def latencies_s(messages: list[can.Message]) -> list[float]:
    """By the kernel's stamps at the listener; cycles of fewer objects are left out."""
    found: list[float] = []
    asked_s = said_s = 0.0
    objects = 0
    for message in sorted(messages, key=lambda one: one.timestamp):
        if message.arbitration_id in STATUS_IDS:
            objects = message.data[5 if message.arbitration_id == STATUS_IDS[0] else 3]
            started_s = asked_s
        elif message.arbitration_id in DETAIL_IDS:
            said_s = message.timestamp
        elif message.arbitration_id == LAST_INPUT_ID:
            if objects >= OBJECTS:  # more: some were there a moment ago
                found.append(said_s - started_s)
            objects, asked_s = 0, message.timestamp
    return found


def memory_mib(pid: int) -> dict[str, float]:
    """VmRSS and VmHWM of a process; the kernel's kB are of 1,024 bytes."""
    text = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    return {key: int(kb) / 1024 for key, kb in re.findall(r"(Vm(?:RSS|HWM)):\s+(\d+) kB", text)}


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
        if message is not None and message.arbitration_id == DETAIL_IDS[0]:
            return
    raise TimeoutError("no prediction came")


# --- the drive that keeps it busy


def busy_messages() -> Iterator[can.Message]:
    """Half a minute of the demo's NGSIM drive with 32 cars in every cycle: those that were
    recorded, nearest first, and copies of them some metres aside.
    """
    decoder, ids = Decoder(load_profile("generic")), Ids()
    motion, pose, end_s, counter = None, None, None, 0
    for message in read_log(DRIVES["ngsim"].log):
        end_s = end_s or message.timestamp + SECONDS
        if message.timestamp >= end_s:
            return
        for event in decoder.feed(message, message.timestamp):
            if isinstance(event, EgoMotion):
                motion = event
            elif isinstance(event, EgoPose):
                pose = event
            elif motion and pose and len(event.object_id):
                counter += 1
                yield from encode_cycle(
                    crowded(event, ids),
                    timestamp_s=event.timestamp_s,
                    counter=counter,
                    speed_mps=motion.speed_mps,
                    yaw_rate_rad_s=motion.yaw_rate_rad_s,
                    map_from_ego=pose.map_from_ego,
                    message_s=MESSAGE_S,
                    channel="can0",
                )


class Ids:
    """Numbers for (object id, copy), kept as long as both are there."""

    def __init__(self) -> None:
        self._numbers: dict[tuple[int, int], int] = {}

    def assign(self, keys: list[tuple[int, int]]) -> tuple[list[int], list[bool]]:
        """The numbers, and whether each is new."""
        before = self._numbers
        self._numbers = {key: before[key] for key in keys if key in before}
        used = set(before.values())
        free = (number for number in range(MAX_OBJECT_ID + 1) if number not in used)
        for key in keys:
            if key not in self._numbers:
                self._numbers[key] = next(free)
        return [self._numbers[key] for key in keys], [key not in before for key in keys]


def crowded(seen: Detections, ids: Ids) -> Detections:
    """Exactly 32 objects."""
    near = np.argsort(np.linalg.norm(seen.position, axis=1), kind="stable")
    rows = np.resize(near, OBJECTS)
    copy = np.arange(OBJECTS) // len(near)
    keys = list(zip(seen.object_id[rows].tolist(), copy.tolist(), strict=True))
    numbers, is_new = ids.assign(keys)
    aside = np.stack([np.zeros(OBJECTS), ASIDE_M * copy], axis=-1)
    return replace(
        seen,
        object_id=np.array(numbers),
        is_new=np.array(is_new),
        position=seen.position[rows] + aside,
        velocity=seen.velocity[rows],
        heading_rad=seen.heading_rad[rows],
        length_m=seen.length_m[rows],
        width_m=seen.width_m[rows],
        object_class=seen.object_class[rows],
        existence=seen.existence[rows],
    )


def write_log(path: Path, messages: Iterable[can.Message]) -> None:
    """As candump text."""
    with can.CanutilsLogWriter(path) as writer:
        for message in messages:
            writer.on_message_received(message)


if __name__ == "__main__":
    sys.exit(main())
