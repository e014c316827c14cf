"""Nobody reads standard error: neither the service nor its recording's writer waits for it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.operation.outlet import Outlet
from eqrt.runtime.prediction.protobuf import nested, text
from eqrt.runtime.recording.order import SAID_WHY, Description, Order
from eqrt.runtime.recording.reader import Recording
from eqrt.runtime.recording.topics import LENGTH
from handmade_model import sign, write_handmade
from processes import PATIENCE_S, Heard, Serving, environment, fill_pipe
from recorded_drives import CHANNELS, patiently, recorded_drive


def recording_service(heard: Heard, folder: Path) -> Serving:
    """A service that hears nothing, and records that."""
    bus = ["--can", next(CHANNELS), "--can-interface", LOCAL, "--profile", "generic", "--quiet"]
    return Serving(*bus, "--datagrams", heard.address, "--record", str(folder))


@pytest.mark.parametrize("reader", ["reads nothing", "has gone"])
def test_a_service_goes_on_when_its_writer_is_killed_and_ends_when_told_to(
    reader: str, tmp_path: Path
) -> None:
    with Heard(next(CHANNELS)) as heard, recording_service(heard, tmp_path) as service:
        if reader == "has gone":
            service.stop_reading_errors()
        else:
            fill_pipe(service.pid, 2)
        os.kill(service.writer_pid(), signal.SIGKILL)
        patiently(lambda: is_ended(heard))
        seconds = len(heard.statuses)
        patiently(lambda: len(heard.statuses) > seconds + 1)
        service.send(signal.SIGTERM)
        assert service.wait() == 0
        service.end()


def is_ended(heard: Heard) -> bool:
    return bool(heard.statuses) and heard.statuses[-1].totals["recording_ended"] == 1


def test_a_writer_at_its_limit_closes_the_file_and_ends(tmp_path: Path) -> None:
    """The service says that the recording has ended, while nobody has read why."""
    folder, log = tmp_path / "rec", tmp_path / "drive.log"
    options = ("--record-limit=200K",)
    with recorded_drive("ngsim", folder, log, *options, until=1) as (service, heard):
        fill_pipe(service.pid, 2)
        patiently(lambda: is_ended(heard))
        (file,) = folder.iterdir()
        recording = Recording([file])
        assert list(recording.forecasts())
        assert recording.remark is None


def test_a_writer_says_why_it_ended_when_somebody_reads(tmp_path: Path) -> None:
    """Once, after everything else; its exit status says that something could not be written."""
    order = Order(
        folder=str(tmp_path / "none"),
        run="00c0ffee",
        description=Description(identity={"eqrt": "1"}, attached=[]),
        schemas={"/eqrt/status": b"{}", "/eqrt/lost": b"{}"},
        file_bytes=1 << 30,
        file_seconds=600.0,
        total_bytes=1 << 40,
        free_bytes=0,
        delete_oldest=False,
    )
    pieces = [msgspec.msgpack.encode(order), bytes(1)]
    done = subprocess.run(
        [sys.executable, "-m", "eqrt.runtime.recording.writer"],
        input=b"".join(LENGTH.pack(len(piece)) + piece for piece in pieces),
        capture_output=True,
        check=False,
        env=environment(),
        timeout=PATIENCE_S,
    )
    ended = f"eqrt serve: recording ended: {order.folder}: No such file or directory"
    assert done.stderr.decode() == f"{ended}; predictions go on\n"
    assert done.returncode == SAID_WHY


def test_a_service_starts_although_nobody_reads_the_model_licence(tmp_path: Path) -> None:
    model = write_handmade(tmp_path / "model")
    with (model / "model.onnx").open("ab") as stream:
        stream.write(nested(14, text(1, "non_commercial") + text(2, "true")))
    sign(model)
    bus = ["--can", next(CHANNELS), "--can-interface", LOCAL, "--profile", "generic"]
    reading, writing = os.pipe()
    fill_pipe(os.getpid(), writing)
    with Serving(*bus, "--model", str(model), stderr=writing) as service:
        assert service.end()[0] == 0
    os.close(writing)
    with open(reading, "rb") as rest:
        assert not rest.read().strip()
    with Serving(*bus, "--model", str(model)) as service:
        _, _, stderr = service.end()
    assert stderr.startswith("eqrt: model licence: ")


def test_what_a_stream_has_kept_for_a_reader_that_has_gone_ends_nothing() -> None:
    """As a warning of Python's own leaves it: told to the stream, and never taken."""
    reading, writing = os.pipe()
    stream = os.fdopen(writing, "w", buffering=1)
    stream.write("kept")
    os.close(reading)
    assert not Outlet(stream).put("into nothing")
    with contextlib.suppress(BrokenPipeError):
        stream.close()
