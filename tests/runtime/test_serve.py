"""`eqrt serve` and `eqrt play` as processes: what comes out on the bus and as datagrams."""

from __future__ import annotations

import contextlib
import itertools
import re
import signal
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import can
import numpy as np
import pytest
from cantools.database.can import Database

from drives import DRIVES, Drive, first_seconds, shipped_predictor
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.publish_can import nearest_first
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay
from processes import PATIENCE_S, Heard, Serving, playing
from source_tree import ROOT

DBC = ROOT / "runtime/eqrt/runtime/output/eqrt.dbc"
OUTPUT_IDS = range(0x6E0, 0x6E6)
SECONDS = 3.0
ARS408_IDS = load_profile("ars408").ids
RESOLUTION_M = 0.02  # of positions in eqrt.dbc
CHANNELS = (f"serve-{number}-{time.monotonic_ns()}" for number in itertools.count())

Fields = dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """What a service heard, said and left behind."""

    drive: Drive
    ready: str
    status: int
    stdout: str
    stderr: str
    messages: list[can.Message]
    """On the bus where the predictions go, until SILENT."""
    forecasts: list[ForecastSet]
    """From the datagrams."""

    @property
    def cycles(self) -> list[ForecastSet]:
        """Without the silence at the end."""
        return [forecast for forecast in self.forecasts if forecast.mode is not Mode.SILENT]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Served]:
    """All drives at the same time: the first seconds of each, in real time, and the silence."""
    folder = tmp_path_factory.mktemp("serve")
    endings = dict(zip(DRIVES, itertools.cycle((signal.SIGTERM, signal.SIGINT)), strict=False))
    with contextlib.ExitStack() as stack:
        started = {name: start(DRIVES[name], stack) for name in DRIVES}
        for service, _, _ in started.values():
            service.wait_until_ready()
        for name, (_, _, channels) in started.items():
            stack.enter_context(played(DRIVES[name], channels, folder / f"{name}.log"))
        for _, heard, _ in started.values():
            wait_for_silence(heard)
        results = {}
        for name, (service, heard, _) in started.items():
            status, stdout, stderr = service.end(endings[name])
            results[name] = Served(
                drive=DRIVES[name],
                ready=service.ready,
                status=status,
                stdout=stdout,
                stderr=stderr,
                messages=heard.messages,
                forecasts=heard.forecasts,
            )
    return results


def start(drive: Drive, stack: contextlib.ExitStack) -> tuple[Serving, Heard, dict[str, str]]:
    """A service on channels of its own; a drive with several buses is answered on one more."""
    channels = {role: next(CHANNELS) for role in drive.roles}
    cans = [f"--can={role}={channel}" for role, channel in channels.items()]
    out = next(iter(channels.values()))
    if len(channels) > 1:
        out = next(CHANNELS)
        cans += ["--out-can", out]
    heard = stack.enter_context(Heard(out, OUTPUT_IDS))
    options = [*cans, "--can-interface", LOCAL, "--datagrams", heard.address]
    service = Serving(*options, *drive.options)
    stack.callback(service.__exit__)
    return service, heard, channels


def played(
    drive: Drive, channels: dict[str, str], log: Path
) -> contextlib.AbstractContextManager[object]:
    log.write_text(first_seconds(drive.log, SECONDS))
    routes = [f"--can={drive.roles[role]}={channel}" for role, channel in channels.items()]
    return playing(log, *routes)


def wait_for_silence(heard: Heard) -> None:
    """Until the service has said SILENT on both ways: it has seen all that was played."""
    give_up_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up_s:
        on_bus = [m.data[3] for m in heard.messages if m.arbitration_id == OUTPUT_IDS[0]]
        said = [forecast.mode for forecast in heard.forecasts]
        if len(said) > 20 and on_bus[-2:] == said[-2:] == [Mode.SILENT] * 2:
            return
        time.sleep(0.05)
    raise AssertionError(f"no silence after {len(heard.forecasts)} cycles")


@cache
def database() -> Database:
    """`eqrt.dbc` as any consumer reads it."""
    database = Database()
    database.add_dbc_file(str(DBC))
    return database


def decoded(message: can.Message) -> tuple[str, Fields]:
    """Message name, and its signals with NaN for what is not available."""
    known = database().get_message_by_frame_id(message.arbitration_id)
    choices = database().decode_message(message.arbitration_id, bytes(message.data))
    values = database().decode_message(
        message.arbitration_id, bytes(message.data), decode_choices=False
    )
    assert isinstance(choices, dict)
    assert isinstance(values, dict)
    return known.name, {
        name: np.nan if str(choices[name]) == "NOT_AVAILABLE" else float(str(value))
        for name, value in values.items()
    }


def by_cycle(messages: list[can.Message]) -> list[tuple[Fields, list[Fields]]]:
    """Status and trajectories of every cycle that the bus carried."""
    cycles: list[tuple[Fields, list[Fields]]] = []
    for message in messages:
        name, fields = decoded(message)
        if name == "EQRT_Status":
            cycles.append((fields, []))
        else:
            assert name == "EQRT_Trajectory"
            cycles[-1][1].append(fields)
    return cycles


each_drive = pytest.mark.parametrize("name", DRIVES)


@each_drive
def test_a_service_says_when_it_is_ready_and_how_it_went(
    name: str, served: dict[str, Served]
) -> None:
    """SIGTERM and Ctrl-C end it alike: status 0, and a sum of what it has done."""
    one = served[name]
    assert one.ready.startswith(f"eqrt serve: {one.drive.profile} on serve-")
    assert (one.status, one.stderr) == (0, "")
    *lines, summary = one.stdout.splitlines()
    assert len(lines) >= SECONDS
    for sensor in load_profile(one.drive.profile).sensors:
        assert f" {sensor.name}: mount x {sensor.mount.x_m:g} m, " in one.stdout
    targets = sum(forecast.num_targets for forecast in one.forecasts)
    assert summary.startswith("eqrt serve: ")
    assert f" {targets} predictions, " in summary


@each_drive
def test_the_bus_and_the_datagrams_say_the_same(name: str, served: dict[str, Served]) -> None:
    """Cycle by cycle; positions within the resolution of the DBC, in the ego frame."""
    one = served[name]
    on_bus = {int(status["Cycle"]): (status, rows) for status, rows in by_cycle(one.messages)}
    compared = 0
    for forecast in map(nearest_first, one.forecasts):  # as on the bus
        if forecast.cycle not in on_bus:  # said when the test was about to end
            continue
        status, rows = on_bus[forecast.cycle]
        assert status["Mode"] == forecast.mode
        assert status["NumObjects"] == forecast.num_targets == len(rows)
        assert status["ComputeTime"] == pytest.approx(1e3 * forecast.compute_s, abs=0.06)
        if forecast.map_from_ego is None:  # before the ego motion is known, and in silence
            assert np.isnan([status[name] for name in ("EgoX", "EgoY", "EgoYaw")]).all()
            assert not rows
            continue
        ego_from_map = forecast.map_from_ego.inverse()
        for row, fields in enumerate(rows):
            assert fields["ObjectIndex"] == row
            assert fields["ObjectId"] == forecast.object_id[row]
            assert fields["TrackId"] == forecast.track_id[row] & 0xFFFF
            start = (fields["PositionX"], fields["PositionY"])
            np.testing.assert_allclose(
                start, ego_from_map.apply(forecast.position[row]), atol=RESOLUTION_M
            )
            points = [(fields[f"X{i}"], fields[f"Y{i}"]) for i in range(1, 11)]
            expected = ego_from_map.apply(forecast.trajectories[row, 0, 2::3])
            if forecast.is_standstill_assumed[row]:  # of a radar that measures no velocity
                expected[:] = np.nan
            np.testing.assert_allclose(points, expected, atol=RESOLUTION_M)
            compared += 1
    assert compared > 30


@each_drive
def test_no_message_is_lost_on_the_way(name: str, served: dict[str, Served]) -> None:
    """Counters have no gaps, and every cycle is on the bus and among the datagrams."""
    one = served[name]
    statuses = [status for status, _ in by_cycle(one.messages)]
    assert [status["AliveCounter"] for status in statuses] == [
        i % 256 for i in range(len(statuses))
    ]
    assert [status["Cycle"] for status in statuses] == [i % 256 for i in range(len(statuses))]
    assert [forecast.cycle for forecast in one.forecasts] == list(range(len(one.forecasts)))


@each_drive
def test_a_service_predicts_what_replay_predicts(name: str, served: dict[str, Served]) -> None:
    """The same objects from the same places, as nearly as a busy machine plays them in time: at 30
    m/s, 10 ms are 0.3 m, and more when they are taken for speed.
    """
    one = served[name]
    drive = one.drive
    tile = load_tile(drive.tile) if drive.tile else None
    pipeline = Pipeline(
        load_profile(drive.profile), shipped_predictor(), tile, channels=drive.roles
    )
    lines = first_seconds(drive.log, SECONDS).splitlines()
    ends: dict[int, list[np.ndarray]] = defaultdict(list)
    for forecast in replay(pipeline, map(candump_message, lines)):
        for row, object_id in enumerate(forecast.object_id.tolist()):
            place = np.stack([forecast.position[row], forecast.trajectories[row, 0, -1]])
            ends[object_id].append(place)
    away_m = []
    for forecast in one.cycles:
        for row, object_id in enumerate(forecast.object_id.tolist()):
            place = np.stack([forecast.position[row], forecast.trajectories[row, 0, -1]])
            distance = np.linalg.norm(np.array(ends[object_id]) - place, axis=-1)
            away_m.append(distance[distance[:, 0].argmin()])
    start_m, end_m = np.median(away_m, axis=0)
    assert start_m < 1.0
    assert end_m < 4.0


def test_modes_tell_what_a_service_had(served: dict[str, Served]) -> None:
    """With map and pose RUN, without a map NO_MAP; a busy machine may make some late."""
    for name, expected in {"ngsim": Mode.RUN, "ars408": Mode.NO_MAP, "rav4": Mode.NO_MAP}.items():
        modes = [forecast.mode for forecast in served[name].cycles]
        assert {expected} <= set(modes) <= {expected, Mode.LATE, Mode.NO_POSE}


# --- garbage


def test_garbage_on_the_bus_is_counted_and_skipped() -> None:
    """Random ids and bytes, other lengths, error and remote frames, between a radar's messages."""
    channel = next(CHANNELS)
    lines = first_seconds(DRIVES["ars408"].log, 1.5).splitlines()
    random, wanted = np.random.default_rng(0), 0
    with (
        Heard(channel, OUTPUT_IDS) as heard,
        Serving("--can", channel, "--can-interface", LOCAL, "--profile", "ars408") as service,
        open_bus(channel, LOCAL) as bus,
    ):
        for message in map(candump_message, lines):
            for one in (*garbage_messages(random), message):
                bus.send(one)
                wanted += is_wanted(one)
            time.sleep(0.004)
        time.sleep(0.5)
        status, stdout, stderr = service.end(signal.SIGTERM)
    assert (status, stderr) == (0, "")
    summary = stdout.splitlines()[-1]
    found = re.search(r" (\d+) messages, .* (\d+) unusable; \S+: (\d+) error frames", summary)
    assert found, summary
    messages, unusable, error_frames = map(int, found.groups())
    assert messages == wanted
    assert unusable > len(lines) / 2
    assert error_frames == len(lines)
    cycles = by_cycle(heard.messages)
    assert len(cycles) > 5
    assert sum(len(rows) for _, rows in cycles) > 5
    for status_fields, rows in cycles:
        assert status_fields["NumObjects"] == len(rows)
        assert all(np.isfinite([fields["X1"], fields["Y10"]]).all() for fields in rows)


def is_wanted(message: can.Message) -> bool:
    """Whether it has an id of the profile and is no remote or error frame, whatever its data."""
    address = (message.arbitration_id, message.is_extended_id)
    is_data = not message.is_remote_frame and not message.is_error_frame
    return is_data and address in ARS408_IDS


def garbage_messages(random: np.random.Generator) -> Iterator[can.Message]:
    radar = [0x60A, 0x60B, 0x60C, 0x60D, 0x300, 0x301]
    known, data = int(random.choice(radar)), random.bytes(int(random.integers(0, 9)))
    yield can.Message(
        arbitration_id=int(random.integers(0, 0x800)), is_extended_id=False, data=data
    )
    yield can.Message(arbitration_id=known, is_extended_id=True, data=data)
    yield can.Message(arbitration_id=known, is_extended_id=False, is_remote_frame=True, dlc=8)
    yield can.Message(arbitration_id=known, is_extended_id=False, is_error_frame=True, data=data)
    yield can.Message(arbitration_id=known, is_extended_id=False, data=data[:2])
    if random.random() < 0.1:
        whole = random.bytes(int(random.choice([8, 64])))
        yield can.Message(
            arbitration_id=known, is_extended_id=False, data=whole, is_fd=len(whole) > 8
        )


# --- where predictions go


def test_a_service_on_a_classic_channel_sends_classic_messages() -> None:
    """`--no-fd`: for consumers without CAN FD."""
    channel = next(CHANNELS)
    lines = first_seconds(DRIVES["ars408"].log, 0.5).splitlines()
    options = ["--can", channel, "--can-interface", LOCAL, "--no-fd", "--profile", "ars408"]
    with (
        Heard(channel, OUTPUT_IDS) as heard,
        Serving(*options) as service,
        open_bus(channel, LOCAL) as bus,
    ):
        for message in map(candump_message, lines):
            bus.send(message)
            time.sleep(0.002)
        time.sleep(0.3)
        service.end()
    assert not any(message.is_fd for message in heard.messages)
    names = {decoded(message)[0] for message in heard.messages}
    assert names == {
        "EQRT_StatusClassic",
        "EQRT_IdentityClassic",
        "EQRT_ObjectClassic",
        "EQRT_PointClassic",
    }
