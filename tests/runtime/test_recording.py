"""`eqrt serve --record` in real processes: what is in the files, and that a replay is the same."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import time
from pathlib import Path

import can
import mcap.reader
import numpy as np
import pytest
from mcap.exceptions import McapError

from drives import DRIVES, Car, shipped_predictor, traffic
from eqrt.cli import main
from eqrt.core.errors import LogError, RecordingError
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.bus.health import BusHealth
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.recording.folder import recordings_in
from eqrt.runtime.recording.identity import attached_files, identity_of
from eqrt.runtime.recording.order import Attached, Description, Order
from eqrt.runtime.recording.reader import Recording, read_recordings
from eqrt.runtime.recording.recorder import Recorder
from eqrt.runtime.recording.runs import RunTape
from eqrt.runtime.recording.steps import Step, TapedClock
from eqrt.runtime.service import Service
from processes import PATIENCE_S, Heard, Serving, eqrt
from recorded_drives import CHANNELS, patiently, recorded_drive
from source_tree import ROOT

PLAY = ("--can", "nowhere", "--can-interface", LOCAL)


def said(recording: Recording) -> bytes:
    """Its predictions, as JSON lines."""
    return b"".join(map(json_lines, recording.forecasts()))


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Heard]]:
    """NGSIM with its tile, the RAV4 on two channels: where it was recorded, what was heard."""
    found = {}
    for name in ("ngsim", "rav4"):
        folder = tmp_path_factory.mktemp(name)
        with recorded_drive(name, folder / "rec", folder / f"{name}.log") as (service, heard):
            status, _, stderr = service.end()
            assert (status, stderr) == (0, "")
        found[name] = (folder, heard)
    return found


each_drive = pytest.mark.parametrize("name", ["ngsim", "rav4"])


@each_drive
def test_a_replay_makes_the_recorded_predictions_to_the_last_bit(
    name: str, drives: dict[str, tuple[Path, Heard]]
) -> None:
    """In another process, without being told profile, tile or channels."""
    folder, _ = drives[name]
    (recording,) = read_recordings(folder / "rec")
    lines = folder / "replayed.jsonl"
    done = eqrt("replay", str(folder / "rec"), "--out", str(lines), "--diff", str(folder / "rec"))
    assert done.returncode == 0, done.stdout
    assert lines.read_bytes() == said(recording)
    assert lines.read_bytes().count(b"\n") > 200


@each_drive
def test_what_was_sent_is_what_is_recorded(
    name: str, drives: dict[str, tuple[Path, Heard]]
) -> None:
    """Every cycle that came as a datagram, at the same times; datagrams carry float32."""
    folder, heard = drives[name]
    (recording,) = read_recordings(folder / "rec")
    recorded = list(recording.forecasts())
    assert [one.cycle for one in recorded] == list(range(len(recorded)))
    assert len(heard.forecasts) > 30
    for one in heard.forecasts:
        mine = recorded[one.cycle]
        assert (mine.made_s, mine.mode, mine.compute_s) == (one.made_s, one.mode, one.compute_s)
        np.testing.assert_allclose(mine.trajectories, one.trajectories, atol=1e-3)
        assert mine.compute_s > 0.0


@each_drive
def test_a_recording_is_a_log_like_any_other(
    name: str, drives: dict[str, tuple[Path, Heard]]
) -> None:
    """Every message that was played, in its order, for `eqrt play` and the rest."""
    folder, _ = drives[name]
    (file,) = recordings_in(folder / "rec")
    wanted = load_profile(DRIVES[name].profile).arbitration_ids
    played = [m for m in read_log(folder / f"{name}.log") if m.arbitration_id in wanted]
    assert sorted(contents(read_log(file))) == sorted(contents(played))


def contents(messages: object) -> list[tuple[int, bytes]]:
    assert hasattr(messages, "__iter__")
    return [(m.arbitration_id, bytes(m.data)) for m in messages]


def test_a_recording_says_what_it_is(drives: dict[str, tuple[Path, Heard]]) -> None:
    folder, heard = drives["ngsim"]
    (recording,) = read_recordings(folder / "rec")
    identity = recording.identity
    assert (identity.profile, identity.part, identity.stationary) == ("generic", "0", "false")
    assert identity.model_id == heard.forecasts[0].model_id
    tiles = {forecast.tile_id for forecast in heard.forecasts}  # none before the first pose
    assert tiles - {""} == {identity.tile_id}
    assert "--record" in identity.command
    assert set(recording.attached) == {"profile/generic.toml", "profile/eqrt_objects.dbc", "tile"}
    assert DRIVES["ngsim"].tile is not None
    assert recording.attached["tile"] == DRIVES["ngsim"].tile.read_bytes()


def test_foreign_tools_read_it(drives: dict[str, tuple[Path, Heard]]) -> None:
    """The mcap library with its index: topics, and JSON with a schema where we promise it."""
    folder, _ = drives["ngsim"]
    (file,) = recordings_in(folder / "rec")
    with file.open("rb") as stream:
        reader = mcap.reader.make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic: channel for channel in summary.channels.values()}
        assert set(topics) == {
            "/can",
            "/eqrt/poll",
            "/eqrt/clock",
            "/eqrt/forecasts",
            "/eqrt/status",
            "/eqrt/lost",
            "/eqrt/runs",
        }
        schema = json.loads(summary.schemas[topics["/eqrt/status"].schema_id].data)
        statuses = [json.loads(m.data) for _, _, m in reader.iter_messages("/eqrt/status")]
        stamps = [(m.publish_time, m.log_time) for _, _, m in reader.iter_messages("/can")]
    assert schema["type"] == "object"
    assert set(schema["properties"]) == set(statuses[0]) == set(ServiceStatus.__struct_fields__)
    assert len(statuses) >= 3
    waited_s = np.diff(np.array(stamps), axis=-1) / 1e9
    assert ((waited_s > -0.01) & (waited_s < 2.0)).all()
    assert abs(stamps[0][1] / 1e9 - time.time()) < 600.0


def test_status_says_how_the_recording_goes(drives: dict[str, tuple[Path, Heard]]) -> None:
    folder, heard = drives["ngsim"]
    totals = heard.statuses[-1].totals
    assert totals["recording_bytes"] > 100_000
    assert (totals["recording_dropped"], totals["recording_ended"]) == (0, 0)
    (recording,) = read_recordings(folder / "rec")
    entries = [one.entry for one in recording.entries()]
    assert sum(isinstance(one, ServiceStatus) for one in entries) == len(heard.statuses)


def test_predictions_are_told_while_the_file_is_read(
    drives: dict[str, tuple[Path, Heard]], tmp_path: Path
) -> None:
    """Not when all of them lie in memory: the end, which is torn off, has not been seen yet."""
    (file,) = recordings_in(drives["ngsim"][0] / "rec")
    torn = tmp_path / file.name
    torn.write_bytes(file.read_bytes()[:-1000])
    (recording,) = read_recordings(tmp_path)
    forecasts = recording.forecasts()
    first = next(forecasts)
    assert recording.cut == []
    assert [first.cycle, *(later.cycle for later in forecasts)][:3] == [0, 1, 2]
    assert len(recording.cut) == 1


# --- being killed


def test_what_was_recorded_before_a_kill_is_there_up_to_the_last_second(tmp_path: Path) -> None:
    """Service and writer killed at once, while predictions are made."""
    folder, log = tmp_path / "rec", tmp_path / "drive.log"
    with recorded_drive("ngsim", folder, log, until=25) as (service, heard):
        writer = service.writer_pid()
        os.kill(service.pid, signal.SIGKILL)
        os.kill(writer, signal.SIGKILL)
        killed_ns = time.time_ns()
        service.end(signal.SIGKILL)
        made = len(heard.forecasts)
    (file,) = recordings_in(folder)
    newest_ns = newest_by_the_library(file)
    assert 0 <= killed_ns - newest_ns < 1.5e9  # a second, and a busy machine
    replayed = tmp_path / "replayed.jsonl"
    done = eqrt("replay", str(folder), "--out", str(replayed), "--diff", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "read up to there" in done.stderr
    (recording,) = read_recordings(folder)
    kept = list(recording.forecasts())
    assert made - 15 <= len(kept) <= made + 1


def newest_by_the_library(file: Path) -> int:
    """When the last message was recorded that mcap's own reader for streams finds."""
    newest_ns = 0
    with file.open("rb") as stream:
        reader = mcap.reader.NonSeekingReader(stream)
        with contextlib.suppress(McapError, ValueError):
            for _, _, message in reader.iter_messages(log_time_order=False):
                newest_ns = max(newest_ns, message.log_time)
    return newest_ns


def test_predictions_go_on_when_the_writer_is_killed(tmp_path: Path) -> None:
    folder, log = tmp_path / "rec", tmp_path / "drive.log"
    with recorded_drive("ngsim", folder, log, seconds=1.0) as (service, heard):
        os.kill(service.writer_pid(), signal.SIGKILL)
        cycles = len(heard.forecasts)
        patiently(lambda: heard.statuses[-1].totals["recording_ended"] == 1)
        patiently(lambda: len(heard.forecasts) > cycles + 5)  # it says SILENT, ten times a second
        status, _, stderr = service.end()
    assert status == 0
    assert stderr.count("recording") == 1
    assert "recording ended" in stderr


def test_predictions_go_on_when_the_writer_cannot_begin(tmp_path: Path) -> None:
    """A damaged installation: what Python says of it does not say what it means for the service."""
    damaged = tmp_path / "damaged"
    (damaged / "mcap").mkdir(parents=True)
    (damaged / "mcap/__init__.py").write_text("raise ImportError('damaged')")
    channel = f"damaged-{time.monotonic_ns()}"
    options = ["--can", channel, "--can-interface", LOCAL, "--profile", "generic", "--quiet"]
    paths = f"{damaged}{os.pathsep}{ROOT / 'runtime'}"
    with Heard(channel) as heard:
        options += ["--datagrams", heard.address, "--record", str(tmp_path / "rec")]
        service = Serving(*options, PYTHONPATH=paths).wait_until_ready()
        patiently(
            lambda: bool(heard.statuses) and heard.statuses[-1].totals["recording_ended"] == 1
        )
        status, _, stderr = service.end()
    assert status == 0
    assert "ImportError: damaged" in stderr
    said = "eqrt serve: recording ended: its writer could not go on; predictions go on"
    assert stderr.splitlines().count(said) == 1


def test_the_writer_ends_after_a_service_that_was_killed(tmp_path: Path) -> None:
    """And finishes the file: it is not cut."""
    folder, log = tmp_path / "rec", tmp_path / "drive.log"
    with recorded_drive("ngsim", folder, log, seconds=1.0) as (service, _):
        writer = service.writer_pid()
        service.end(signal.SIGKILL)
        patiently(lambda: not Path(f"/proc/{writer}").exists())
    (recording,) = read_recordings(folder)
    assert list(recording.forecasts())
    assert recording.remark is None


# --- a disk that stands still


def test_a_service_ends_in_time_while_its_disk_stands_still(tmp_path: Path) -> None:
    """In less than systemd allows it, and with a second to spare; its writer goes on until all is
    written that the pipe has taken.
    """
    unit = (ROOT / "deploy/eqrt.service").read_text(encoding="utf-8")
    allowed_s = float(unit.partition("TimeoutStopSec=")[2].split()[0])
    folder, log = tmp_path / "rec", tmp_path / "drive.log"
    with recorded_drive("ngsim", folder, log, until=3) as (service, heard):
        writer = service.writer_pid()
        os.kill(writer, signal.SIGSTOP)
        try:
            patiently(lambda: len(heard.forecasts) >= 35)
            told_s = time.monotonic()
            service.send(signal.SIGTERM)
            status = service.wait()
            ended_s = time.monotonic()
        finally:
            os.kill(writer, signal.SIGCONT)
        assert status == 0
        assert ended_s - told_s < allowed_s - 1.0
        patiently(lambda: not Path(f"/proc/{writer}").exists())
        _, stdout, _ = service.end()
    assert stdout.splitlines()[-1].startswith("eqrt serve: ")
    (recording,) = read_recordings(folder)
    assert list(recording.forecasts())
    assert recording.remark is None


# --- limits


def test_a_run_in_several_files_is_replayed_as_one(tmp_path: Path) -> None:
    folder, log = tmp_path / "rec", tmp_path / "drive.log"
    with recorded_drive("ngsim", folder, log, "--record-file-size=150K") as (service, _):
        assert service.end()[0] == 0
    files = recordings_in(folder)
    assert len(files) > 2
    done = eqrt("replay", str(folder), "--diff", str(folder))
    assert (done.returncode, "missing" in done.stderr) == (0, False), done.stdout
    files[1].rename(folder / files[1].name.replace("eqrt-2", "eqrt-1"))  # the clock was set back
    done = eqrt("replay", str(folder), "--diff", str(folder))
    assert (done.returncode, "missing" in done.stderr) == (0, False), done.stdout
    recordings_in(folder)[0].unlink()
    done = eqrt("replay", str(folder), "--diff", str(folder))
    assert "part 1 is missing; " in done.stderr
    assert "predictions may differ" in done.stderr
    assert Recording([files[2]]).remark is not None


def test_recording_ends_at_its_limit_and_predictions_go_on(tmp_path: Path) -> None:
    folder, log = tmp_path / "rec", tmp_path / "drive.log"
    with recorded_drive("ngsim", folder, log, "--record-limit=200K") as (service, heard):
        patiently(lambda: heard.statuses[-1].totals["recording_ended"] == 1)
        _, _, stderr = service.end()
    assert stderr.count("recording ended: the recordings in") == 1
    assert "--record-limit" in stderr
    (recording,) = read_recordings(folder)
    (file,) = recording.paths
    assert 200_000 <= file.stat().st_size < 900_000
    done = eqrt("replay", str(folder), "--diff", str(folder))
    assert done.returncode == 0, done.stdout


def test_the_oldest_recordings_make_room_if_they_may(tmp_path: Path) -> None:
    """What is not a recording stays, however old."""
    folder, log = tmp_path / "rec", tmp_path / "drive.log"
    folder.mkdir()
    old = folder / "eqrt-20200101T000000Z-00c0ffee-0000.mcap"
    old.write_bytes(bytes(300_000))
    other = folder / "eqrt-drive.mcap"
    other.write_bytes(bytes(300_000))
    options = ("--record-limit=400K", "--record-when-full=delete-oldest")
    sizes = (*options, "--record-file-size=100K")
    with recorded_drive("ngsim", folder, log, *sizes) as (service, heard):
        status, _, stderr = service.end()
    assert (status, stderr) == (0, "")
    assert heard.statuses[-1].totals["recording_ended"] == 0
    assert not old.exists()
    assert other.exists()
    assert sum(path.stat().st_size for path in recordings_in(folder)) < 600_000


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--record-keep-free", "1000T"], "GB left, to be kept"),
        (["--record-limit", "1K"], "allowed are"),
        (["--record-limit", "many"], "is not a size such as"),
    ],
)
def test_a_recording_that_cannot_begin_is_an_error(
    options: list[str], reason: str, tmp_path: Path
) -> None:
    (tmp_path / "eqrt-20200101T000000Z-00c0ffee-0000.mcap").write_bytes(bytes(2000))
    arguments = ["--can", next(CHANNELS), "--can-interface", LOCAL, "--profile", "ars408"]
    done = eqrt("serve", *arguments, "--record", str(tmp_path), *options)
    assert done.returncode in {1, 2}
    assert reason in done.stderr
    assert done.stderr.count("\n") == 1


# --- what is dropped


def order(folder: Path, identity: dict[str, str], *attached: Attached) -> Order:
    return Order(
        folder=str(folder),
        run="00c0ffee",
        description=Description(identity=identity, attached=list(attached)),
        schemas={"/eqrt/status": b"{}", "/eqrt/lost": b"{}"},
        file_bytes=1 << 30,
        file_seconds=600.0,
        total_bytes=1 << 40,
        free_bytes=0,
        delete_oldest=False,
    )


class Traffic:
    """A receiver with two cars for some seconds, all at once."""

    def __init__(self, seconds: float) -> None:
        cars = [Car(object_id=k, x_m=20.0 + 15.0 * k, y_m=3.0) for k in range(2)]
        self._messages = iter(list(traffic(cars, seconds)))
        self.is_over = False

    def recv(self, timeout: float | None = None) -> can.Message | None:
        del timeout
        message = next(self._messages, None)
        self.is_over = message is None
        return message

    def health(self) -> list[BusHealth]:
        return []

    def counts(self) -> dict[str, int]:
        return {}


class Paced:
    """The pipeline's time is the traffic's."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self, monotonic_s: float, stamp_s: float | None, wall_s: float) -> float:
        del monotonic_s, wall_s
        self._now_s = stamp_s if stamp_s is not None else self._now_s
        return self._now_s


def recorded_traffic(
    folder: Path, clock: TapedClock, seconds: float, stalled: bool = False
) -> tuple[list[ForecastSet], dict[str, int]]:
    """What a service said while it recorded, and counted; `stalled`: its writer stands still, and
    little may wait for it.
    """
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), stationary=True, clock=clock)
    identity = identity_of(pipeline, model_folder=Path("nowhere"), channels=None, stationary=True)
    begun = order(folder, identity, *attached_files("generic", pipeline))
    said: list[ForecastSet] = []

    class Keep:
        def publish(self, forecast: ForecastSet) -> None:
            said.append(forecast)

        def counts(self) -> dict[str, int]:
            return {}

    receiver = Traffic(seconds)
    with Recorder(begun, clock, RunTape(), 1 << 16 if stalled else 1 << 23) as recorder:
        if stalled:
            os.kill(recorder.writer_pid, signal.SIGSTOP)
        service = Service(pipeline, receiver, [Keep(), recorder], clock=Paced(), witness=recorder)
        service.run(lambda: receiver.is_over)
        if stalled:
            os.kill(recorder.writer_pid, signal.SIGCONT)
        counts = recorder.counts()
    return said, counts


def replayed(folder: Path) -> list[ForecastSet]:
    from eqrt.runtime.recording.replaying import Instead, Replay

    (recording,) = read_recordings(folder)
    return list(Replay(recording, Instead()))


def test_a_replay_is_as_late_as_the_service_was(tmp_path: Path) -> None:
    """A clock that passes 40 ms whenever it is asked makes every prediction late."""
    clock = TapedClock(itertools.count(1000.0, 0.04).__next__)
    said, counts = recorded_traffic(tmp_path, clock, 2.0)
    assert counts["recording_dropped"] == 0
    again = replayed(tmp_path)
    assert len(again) == len(said) > 15
    for mine, theirs in zip(said, again, strict=True):
        assert mine.mode == theirs.mode
        assert (mine.made_s, mine.compute_s) == (theirs.made_s, theirs.compute_s)
        np.testing.assert_array_equal(mine.trajectories, theirs.trajectories)
    assert Mode.LATE in {one.mode for one in again}


def test_entries_leave_when_a_cycle_is_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And not between its messages, where their writer would be at work beside the model."""
    monkeypatch.setattr("eqrt.runtime.recording.recorder._BATCH_S", 60.0)
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), stationary=True)
    identity = identity_of(pipeline, model_folder=Path("x"), channels=None, stationary=True)
    seen = []
    clock, runs = TapedClock(time.monotonic), RunTape()
    with Recorder(order(tmp_path, identity), clock, runs) as recorder:
        for message in traffic([Car(object_id=1, x_m=20.0, y_m=3.0)], 1.0):
            before = recorder.counts()["recording_bytes"]
            recorder.begin(message, message.timestamp)
            made = pipeline.feed(message, message.timestamp)
            for forecast in made:
                recorder.publish(forecast)
            recorder.end()
            seen.append((bool(made), recorder.counts()["recording_bytes"] > before))
    assert set(seen) == {(True, True), (False, False)}


def test_a_writer_that_stands_still_costs_entries_but_never_time(tmp_path: Path) -> None:
    """What does not fit is counted, the recording says how much is missing, and so does replay."""
    started_s = time.monotonic()
    said, counts = recorded_traffic(tmp_path, TapedClock(time.monotonic), 60.0, stalled=True)
    assert time.monotonic() - started_s < PATIENCE_S
    assert counts["recording_dropped"] > 100
    (recording,) = read_recordings(tmp_path)
    kept = list(recording.steps())
    assert recording.lost > 100
    assert f"{recording.lost} steps were not recorded in time" in str(recording.remark)
    assert len(kept) + recording.lost >= 60 * 10 * 4
    assert 0 < len(list(recording.forecasts())) < len(said)


# --- files that are not as they should be


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of two seconds."""
    folder = tmp_path_factory.mktemp("small")
    recorded_traffic(folder, TapedClock(time.monotonic), 2.0)
    (file,) = recordings_in(folder)
    return file


def test_a_cut_file_is_read_up_to_the_cut_wherever_it_is(small: Path, tmp_path: Path) -> None:
    whole = small.read_bytes()
    all_steps = len(list(Recording([small]).steps()))
    cut = tmp_path / "cut.mcap"
    read = []
    for end in [*range(len(whole) // 3, len(whole) - 8, 997), len(whole) - 9]:
        cut.write_bytes(whole[:end])
        recording = Recording([cut])
        read.append(len(list(recording.steps())))
        assert "read up to there" in str(recording.remark), (end, len(whole))
    assert read == sorted(read)
    assert read[-1] == all_steps


def test_a_flipped_bit_is_never_a_step(small: Path, tmp_path: Path) -> None:
    """Chunks carry a checksum."""
    whole, bad = bytearray(small.read_bytes()), tmp_path / "bad.mcap"
    steps = list(map(plain, Recording([small]).steps()))
    for at in range(1500, len(whole) - 3000, 1501):
        damaged = bytearray(whole)
        damaged[at] ^= 0x10
        bad.write_bytes(damaged)
        with contextlib.suppress(LogError):
            read = list(map(plain, Recording([bad]).steps()))
            assert read == steps[: len(read)]


def plain(step: Step) -> tuple[float, tuple[float, ...], str]:
    return step.now_s, step.clock_s, repr(step.message)


@pytest.mark.parametrize("content", [b"", b"nonsense", b"\x89MCAP0\r\n", bytes(10_000)])
def test_another_file_is_an_error_in_one_line(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "drive.mcap"
    file.write_bytes(content)
    for command in (["replay", str(file), "--out", "-"], ["play", str(file), *PLAY]):
        assert main(command) == 1
        said = capsys.readouterr().err
        assert str(file) in said
        assert said.count("\n") == 1


def test_a_model_that_is_gone_is_asked_for(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And not replaced by another that happens to be there."""
    content = small.read_bytes().replace(shipped_predictor().model_id.encode(), b"deadbeef")
    file = tmp_path / small.name
    file.write_bytes(content)
    assert main(["replay", str(file), "--out", "-"]) == 1
    assert "(deadbeef), which is no more at" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="give --record a folder"):
        start_in(tmp_path / "file")


def start_in(folder: Path) -> None:
    import argparse

    from eqrt.runtime.recording.options import add_record_arguments, start_recorder

    parser = argparse.ArgumentParser()
    add_record_arguments(parser)
    args = parser.parse_args(["--record", str(folder)])
    pipeline = Pipeline(load_profile("generic"), shipped_predictor())
    start_recorder(args, pipeline, None, TapedClock(time.monotonic), RunTape())
