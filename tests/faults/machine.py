"""Faults of the machine, of other programs and of the model, while `eqrt serve` is running."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from multiprocessing.synchronize import Event
from pathlib import Path

import can

from drives import TILE, Car, object_list, shipped_predictor
from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.core.tile import decode, encode
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.links import opener
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Prediction
from eqrt.runtime.prediction.tiles import save_tile
from eqrt.runtime.prediction.watched import Model
from eqrt.runtime.service import Service
from faults.outcome import Outcome
from faults.promises import sound
from processes import EQRT, Heard, Serving, fill_pipe

CARS = tuple(
    Car(object_id=n, x_m=8.0 + 12.0 * n, y_m=3.5 * (n % 3), speed_mps=2.0) for n in range(8)
)
PERIOD_S = 0.1
STEADY_S = 1.0
PATIENCE_S = 30.0
STALE_S = 0.25  # older input than two periods and a bit must be called late
CHANNELS = (f"faults-{number}-{time.monotonic_ns()}" for number in itertools.count())


class Sensor:
    """Sends the object list ten times a second on the local bus, until it is switched off."""

    def __init__(self, channel: str) -> None:
        self._bus = open_bus(channel, LOCAL)
        self._began_s = time.monotonic()
        self._over = threading.Event()
        self._silent = threading.Event()
        self._thread = threading.Thread(target=self._send)

    def silence(self) -> None:
        """Send nothing any more."""
        self._silent.set()

    def speak(self) -> None:
        """Again."""
        self._silent.clear()

    def _send(self) -> None:
        for number in itertools.count():
            due_s = self._began_s + PERIOD_S * number
            if self._over.wait(max(due_s - time.monotonic(), 0.0)):
                return
            if not self._silent.is_set():
                for message in _cycle(due_s - self._began_s, number):
                    with contextlib.suppress(can.CanError):
                        self._bus.send(message)

    def __enter__(self) -> Sensor:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._bus.shutdown()


def _cycle(time_s: float, number: int) -> list[can.Message]:
    return encode_cycle(
        object_list(CARS, time_s),
        timestamp_s=time_s,
        counter=number,
        speed_mps=0.0,
        yaw_rate_rad_s=0.0,
        map_from_ego=Pose2(0.0, 0.0, 0.0),
    )


@dataclass(frozen=True)
class Served:
    """The service, and what of it a fault can get its hands on."""

    pid: int
    model: Hanging | None = None
    """Where the service is in this process."""
    folder: Path = Path()
    """`model` and `map.tile`, where they are copies."""
    stop_reading: Callable[[], None] | None = None
    """Have what it says go nowhere: its log, or, where it records, its errors."""
    writer_pid: int = 0
    """Of the recording's writer."""


@dataclass(frozen=True)
class World:
    """All that a fault can get its hands on."""

    sensor: Sensor
    channel: str
    heard: Heard
    service: Served

    @property
    def pid(self) -> int:
        """The service's."""
        return self.service.pid

    @property
    def model(self) -> Hanging | None:
        """The service's."""
        return self.service.model

    @property
    def folder(self) -> Path:
        """The service's files."""
        return self.service.folder


Fault = Callable[[World], AbstractContextManager[str]]
"""While the block lasts, it is there; gives how much of it."""


@contextlib.contextmanager
def no_fault(_world: World) -> Iterator[str]:
    """To compare with."""
    yield ""


@contextlib.contextmanager
def sensor_silent(world: World) -> Iterator[str]:
    """It sends nothing."""
    world.sensor.silence()
    yield "1 sensor"
    world.sensor.speak()


@contextlib.contextmanager
def service_stopped(world: World) -> Iterator[str]:
    """As a debugger or a suspended machine does."""
    os.kill(world.pid, signal.SIGSTOP)
    yield "1 SIGSTOP"
    os.kill(world.pid, signal.SIGCONT)


@contextlib.contextmanager
def hogs(_world: World) -> Iterator[str]:
    """Three for every core."""
    count = 3 * (os.cpu_count() or 1)
    running = [multiprocessing.Process(target=_hog, daemon=True) for _ in range(count)]
    for hog in running:
        hog.start()
    yield f"{count} processes"
    for hog in running:
        hog.kill()
        hog.join()


def _hog() -> None:
    while True:
        pass


@contextlib.contextmanager
def flood(world: World) -> Iterator[str]:
    """Of messages that are nobody's, as fast as one process can send."""
    queue: multiprocessing.Queue[int] = multiprocessing.Queue()
    over = multiprocessing.Event()
    sender = multiprocessing.Process(target=_flood, args=(world.channel, over, queue), daemon=True)
    begun_s = time.monotonic()
    sender.start()
    yield "as fast as one core sends"
    over.set()
    print(f"# flood: {queue.get() / (time.monotonic() - begun_s):.0f} messages/s", flush=True)
    sender.join()


def _flood(channel: str, over: Event, queue: multiprocessing.Queue[int]) -> None:
    message = can.Message(arbitration_id=0x123, data=bytes(8), is_extended_id=False)
    sent = 0
    with open_bus(channel, LOCAL) as bus:
        while not over.is_set():
            for _ in range(100):
                with contextlib.suppress(can.CanError):
                    bus.send(message)
                    sent += 1
    queue.put(sent)


@contextlib.contextmanager
def other_listener_killed(world: World) -> Iterator[str]:
    """A second program on the bus dies, hard, twenty times a second."""
    over = threading.Event()
    killed: list[int] = []

    def kill() -> None:
        while not over.wait(0.05):
            listener = multiprocessing.Process(target=_listen, args=(world.channel,), daemon=True)
            listener.start()
            time.sleep(0.02)
            listener.kill()
            listener.join()
            killed.append(1)

    thread = threading.Thread(target=kill)
    thread.start()
    yield "SIGKILL, again and again"
    over.set()
    thread.join()


def _listen(channel: str) -> None:
    with open_bus(channel, LOCAL) as bus:
        while True:
            bus.recv(1.0)


class Hanging:
    """The shipped model, which does not come back while it is told so."""

    def __init__(self) -> None:
        self.contract = shipped_predictor().contract
        self.model_id = shipped_predictor().model_id
        self.back = threading.Event()
        self.back.set()

    def predict(self, scene: Scene) -> Prediction:
        self.back.wait()
        return shipped_predictor().predict(scene)

    def again(self) -> Model:
        return Hanging()  # loaded anew, it is well


@contextlib.contextmanager
def model_hangs(world: World) -> Iterator[str]:
    """For as long as the fault lasts."""
    assert world.model is not None
    world.model.back.clear()
    yield "1 run"
    world.model.back.set()


@contextlib.contextmanager
def model_hangs_for_good(world: World) -> Iterator[str]:
    """It never comes back; another is loaded."""
    assert world.model is not None
    world.model.back.clear()
    yield "1 run"


def _flip(path: Path) -> None:
    """A bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@contextlib.contextmanager
def model_file_damaged(world: World) -> Iterator[str]:
    """A bit of it is flipped, and the service told to load it."""
    _flip(world.folder / "model/model.onnx")
    os.kill(world.pid, signal.SIGHUP)
    yield "1 bit, SIGHUP"


@contextlib.contextmanager
def tile_file_damaged(world: World) -> Iterator[str]:
    """Likewise."""
    _flip(world.folder / "map.tile")
    os.kill(world.pid, signal.SIGHUP)
    yield "1 bit, SIGHUP"


@contextlib.contextmanager
def tile_exchanged(world: World) -> Iterator[str]:
    """Another one takes its place and it comes back, again and again."""
    over, times = threading.Event(), 15
    lane_map, info = decode(TILE.read_bytes(), "demo")
    versions = [TILE.read_bytes(), encode(lane_map, replace(info, name="other"))]

    def exchange() -> None:
        for number in range(times):
            save_tile(world.folder / "map.tile", versions[number % 2])
            os.kill(world.pid, signal.SIGHUP)
            if over.wait(0.2):
                return

    thread = threading.Thread(target=exchange)
    thread.start()
    yield f"{times} times, SIGHUP"
    over.set()
    thread.join()
    seen = {forecast.tile_id for forecast in world.heard.forecasts}
    assert len(seen - {""}) == 2, "the other tile was never used"


@contextlib.contextmanager
def recorder_killed(world: World) -> Iterator[str]:
    """The process that writes the recording."""
    os.kill(world.service.writer_pid, signal.SIGKILL)
    yield "1 SIGKILL"


@contextlib.contextmanager
def recorder_killed_unread(world: World) -> Iterator[str]:
    """It would be said on standard error, but that pipe is full."""
    filled = fill_pipe(world.pid, 2)
    os.kill(world.service.writer_pid, signal.SIGKILL)
    yield f"1 SIGKILL, {filled} bytes"


@contextlib.contextmanager
def recorder_killed_unheard(world: World) -> Iterator[str]:
    """Likewise, but the other end of that pipe is closed."""
    assert world.service.stop_reading is not None
    world.service.stop_reading()
    os.kill(world.service.writer_pid, signal.SIGKILL)
    yield "1 SIGKILL, 1 pipe"


@contextlib.contextmanager
def disk_stands_still(world: World) -> Iterator[str]:
    """Whoever writes to it stands still with it."""
    os.kill(world.service.writer_pid, signal.SIGSTOP)
    yield "1 SIGSTOP of the recorder"
    os.kill(world.service.writer_pid, signal.SIGCONT)


@contextlib.contextmanager
def disk_fills_up(world: World) -> Iterator[str]:
    """The recording has a file system of its own, which it fills by itself."""
    yield "256 kB of room"
    assert world.heard.statuses[-1].totals["recording_ended"] == 1, "there was room enough"


@contextlib.contextmanager
def log_not_read(world: World) -> Iterator[str]:
    """The pipe that it goes to is full."""
    yield f"{fill_pipe(world.pid, 1)} bytes"


@contextlib.contextmanager
def log_reader_gone(world: World) -> Iterator[str]:
    """Its end of the pipe is closed."""
    assert world.service.stop_reading is not None
    world.service.stop_reading()
    yield "1 pipe"


@contextlib.contextmanager
def served_in_a_process(channel: str, heard: Heard) -> Iterator[Served]:
    """`eqrt serve` as it is."""
    with Serving(*_options(channel, heard)) as service:
        yield Served(service.pid)


@contextlib.contextmanager
def served_talking(channel: str, heard: Heard) -> Iterator[Served]:
    """With a line every second, which goes into a pipe."""
    options = [option for option in _options(channel, heard) if option != "--quiet"]
    with Serving(*options) as service:
        yield Served(service.pid, stop_reading=service.stop_reading)


@contextlib.contextmanager
def served_from_files(channel: str, heard: Heard) -> Iterator[Served]:
    """With a model and a tile that are ours to change."""
    with tempfile.TemporaryDirectory(prefix="eqrt-faults-") as name:
        folder = Path(name)
        shutil.copytree(DEFAULT_ARTIFACT, folder / "model")
        shutil.copy(TILE, folder / "map.tile")
        files = ["--model", str(folder / "model"), "--tile", str(folder / "map.tile")]
        with Serving(*_options(channel, heard), *files) as service:
            yield Served(service.pid, folder=folder)


@contextlib.contextmanager
def served_and_recorded(channel: str, heard: Heard) -> Iterator[Served]:
    """Into a folder."""
    with tempfile.TemporaryDirectory(prefix="eqrt-faults-") as folder:
        record = ["--record", folder, "--record-keep-free", "1K"]
        with Serving(*_options(channel, heard), *record) as service:
            yield Served(
                service.pid,
                stop_reading=service.stop_reading_errors,
                writer_pid=service.writer_pid(),
            )


@contextlib.contextmanager
def served_and_recorded_into_little_room(channel: str, heard: Heard) -> Iterator[Served]:
    """Into a file system of 256 kB, in a mount namespace of the service's own."""
    with tempfile.TemporaryDirectory(prefix="eqrt-faults-") as folder:
        mount = f'mount -t tmpfs -o size=256k none {folder} && exec "$@"'
        record = ["--record", folder, "--record-keep-free", "1K"]
        before = ["unshare", "--mount", "--map-root-user", "sh", "-c", mount, "sh"]
        with Serving(*_options(channel, heard), *record, command=[*before, *EQRT]) as service:
            yield Served(service.pid)


def _options(channel: str, heard: Heard) -> list[str]:
    bus = ["--can", channel, "--can-interface", LOCAL, "--profile", "generic"]
    return [*bus, "--datagrams", heard.address, "--quiet"]


@contextlib.contextmanager
def served_in_a_thread(channel: str, heard: Heard) -> Iterator[Served]:
    """The same loop around a model that we have in hand."""
    model, over = Hanging(), threading.Event()
    profile = load_profile("generic")
    with (
        Receiver(opener(LOCAL, fd=None), {channel: profile.ids}, print) as receiver,
        DatagramPublisher([heard.address]) as publisher,
    ):
        pipeline = Pipeline(profile, model, clock=time.monotonic)
        service = Service(pipeline, receiver, [publisher])
        thread = threading.Thread(target=service.run, args=(over.is_set,))
        thread.start()
        yield Served(os.getpid(), model=model)
        over.set()
        model.back.set()
        thread.join()


FAULTS: dict[str, tuple[float, Fault, Callable[[str, Heard], AbstractContextManager[Served]]]] = {
    "none": (3.0, no_fault, served_in_a_process),
    "the sensor falls silent for 3 s": (3.0, sensor_silent, served_in_a_process),
    "the service stands still for 0.5 s": (0.5, service_stopped, served_in_a_process),
    "the service stands still for 3 s": (3.0, service_stopped, served_in_a_process),
    "the service stands still for 13 s": (13.0, service_stopped, served_in_a_process),
    "the CPU is starved for 5 s": (5.0, hogs, served_in_a_process),
    "the bus is flooded for 5 s": (5.0, flood, served_in_a_process),
    "listeners on the bus are killed for 3 s": (3.0, other_listener_killed, served_in_a_process),
    "the model hangs for 1 s": (1.0, model_hangs, served_in_a_thread),
    "the model hangs for good": (1.0, model_hangs_for_good, served_in_a_thread),
    "the model file is damaged": (2.0, model_file_damaged, served_from_files),
    "the tile file is damaged": (2.0, tile_file_damaged, served_from_files),
    "the tile is exchanged under way": (3.0, tile_exchanged, served_from_files),
    "the recorder is killed": (2.0, recorder_killed, served_and_recorded),
    "the recorder is killed, errors are not read": (
        2.0,
        recorder_killed_unread,
        served_and_recorded,
    ),
    "the recorder is killed, the errors' reader is gone": (
        2.0,
        recorder_killed_unheard,
        served_and_recorded,
    ),
    "nobody reads the log": (3.0, log_not_read, served_talking),
    "the log's reader goes away": (3.0, log_reader_gone, served_talking),
    "the disk stands still for 3 s": (3.0, disk_stands_still, served_and_recorded),
    "the disk fills up": (6.0, disk_fills_up, served_and_recorded_into_little_room),
}


def process_faults() -> Iterator[Outcome]:
    """All of them, one after the other."""
    for name in FAULTS:
        yield process_fault(name)


def process_fault(name: str) -> Outcome:
    """One of FAULTS: good traffic, the fault, good traffic until all is well."""
    seconds, fault, served = FAULTS[name]
    channel = next(CHANNELS)
    with (
        Heard(channel, []) as heard,
        served(channel, heard) as service,
        Sensor(channel) as sensor,
    ):
        return _outcome(name, seconds, fault, World(sensor, channel, heard, service))


def _outcome(name: str, seconds: float, fault: Fault, world: World) -> Outcome:
    _wait_until(lambda: _steady_since(world.heard) is not None, PATIENCE_S)
    before = len(world.heard.forecasts)
    injected = broken = ""
    over_s, during, since_s = time.monotonic(), before, None
    try:
        with fault(world) as injected:
            time.sleep(seconds)
        over_s, during = time.monotonic(), len(world.heard.forecasts)
        _wait_until(lambda: _steady_since(world.heard, during) is not None, PATIENCE_S)
        since_s = _steady_since(world.heard, during)
        _keep_promises(world.heard.forecasts)
    except AssertionError as error:
        broken = str(error).splitlines()[0]
    modes = Counter(f.mode.name for f in world.heard.forecasts[before:during])
    said = ", ".join(f"{mode} {count}" for mode, count in modes.most_common())
    recovery_s = None if since_s is None else max(since_s - over_s, 0.0)
    return Outcome(name, injected, broken, said or "nothing", recovery_s)


def _keep_promises(forecasts: list[ForecastSet]) -> None:
    """Sound, counted, and what is old says so."""
    for forecast in forecasts:
        sound(forecast)
        if forecast.mode in (Mode.RUN, Mode.NO_MAP):
            age_s = forecast.made_s - forecast.timestamp_s
            assert age_s <= STALE_S, f"input {age_s:.3f} s old passes for new"
    cycles = [forecast.cycle for forecast in forecasts]
    assert cycles == sorted(set(cycles)), "the cycles are counted"


def _steady_since(heard: Heard, first: int = 0) -> float | None:
    """Since when (monotonic clock) everybody has been predicted in full, for STEADY_S at least."""
    since_s = None
    for forecast in heard.forecasts[first:]:
        is_full = set(forecast.agent_mode.tolist()) == {Mode.RUN}
        if not (
            is_full
            and forecast.num_targets == len(CARS)
            and forecast.mode in (Mode.RUN, Mode.NO_MAP)
        ):
            since_s = None
        elif since_s is None:
            since_s = forecast.made_s
    steady = since_s is not None and heard.forecasts[-1].made_s - since_s >= STEADY_S
    return since_s if steady else None


def _wait_until(holds: Callable[[], bool], patience_s: float) -> None:
    end_s = time.monotonic() + patience_s
    while not holds() and time.monotonic() < end_s:
        time.sleep(0.1)
