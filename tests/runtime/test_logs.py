"""Recorded logs: every message as python-can reads it, whatever state the file is in."""

from __future__ import annotations

import gzip
import itertools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eqrt.core.errors import LogError
from eqrt.runtime.bus.candump import candump_message
from eqrt.runtime.bus.logs import FORMATS, read_log
from source_tree import ROOT

DATA = ROOT / "tests/data/can"
ARS408 = DATA / "ars408/candump.log.gz"
WRITERS: dict[str, Callable[[Path], Any]] = {
    ".log": can.CanutilsLogWriter,
    ".asc": can.ASCWriter,
    ".blf": can.BLFWriter,
    ".trc": can.TRCWriter,
}
SOME = 300
OF_PYTHON_CAN = [suffix for suffix in FORMATS if suffix != ".mcap"]  # ours: test_recording.py


def write_log(path: Path, messages: Iterable[can.Message]) -> Path:
    """The messages in the format of the path's suffix, as python-can writes it, perhaps gzip'd."""
    plain = path.with_suffix("") if path.suffix == ".gz" else path
    with WRITERS[plain.suffix](plain) as writer:
        for message in messages:
            writer.on_message_received(message)
    if path != plain:
        path.write_bytes(gzip.compress(plain.read_bytes()))
    return path


def recorded(count: int) -> list[can.Message]:
    return list(itertools.islice(read_log(ARS408), count))


def assert_equal(ours: Iterable[can.Message], theirs: Iterable[can.Message]) -> None:
    """Every field of every message."""
    for mine, expected in zip(ours, theirs, strict=True):
        assert mine.equals(expected, timestamp_delta=None), f"{mine!r} != {expected!r}"
        assert mine.timestamp == expected.timestamp


@pytest.mark.parametrize(
    ("sensor", "count"), [("ars408", 24_878), ("rav4", 98_800), ("srr520", 97)]
)
def test_recordings_are_read_as_python_can_reads_them(sensor: str, count: int) -> None:
    """Two radars and a car, one of them CAN FD: message for message."""
    path = DATA / sensor / "candump.log.gz"
    reader = read_log(path)
    assert_equal(reader, can.LogReader(path))
    assert (reader.messages, reader.skipped, reader.remark) == (count, 0, None)


@st.composite
def can_messages(draw: st.DrawFn) -> can.Message:
    """Any message that a log can hold."""
    is_extended, is_fd = draw(st.booleans()), draw(st.booleans())
    is_remote = not is_fd and draw(st.booleans())
    return can.Message(
        timestamp=draw(st.integers(0, 2**51)) / 1e6,
        arbitration_id=draw(st.integers(0, 0x1FFFFFFF if is_extended else 0x7FF)),
        is_extended_id=is_extended,
        is_remote_frame=is_remote,
        is_fd=is_fd,
        is_rx=draw(st.booleans()),
        bitrate_switch=is_fd and draw(st.booleans()),
        error_state_indicator=is_fd and draw(st.booleans()),
        channel=draw(st.sampled_from(["can0", "vcan12", "radar"])),
        data=b"" if is_remote else draw(st.binary(max_size=64 if is_fd else 8)),
    )


@given(message=can_messages())
def test_any_message_survives_candump_text(
    message: can.Message, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """As python-can writes it, and as python-can reads it."""
    path = write_log(tmp_path_factory.mktemp("log") / "one.log", [message])
    (mine,) = read_log(path)
    assert_equal([mine], can.LogReader(path))
    assert mine.equals(message, timestamp_delta=1e-6)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("(1.5) can0 123#", can.Message(1.5, 0x123, False, channel="can0")),
        ("(1.5) 2 123#", can.Message(1.5, 0x123, False, channel=2)),
        ("(1.5) can0 123#0aFF\r\n", can.Message(1.5, 0x123, False, channel="can0", data=[10, 255])),
        ("(1.5) can0 00000123#00", can.Message(1.5, 0x123, True, channel="can0", data=[0])),
        ("(1.5) can0 123#R", can.Message(1.5, 0x123, False, True, channel="can0")),
        (
            "(1.5) can0 123#R8 T",
            can.Message(1.5, 0x123, False, True, False, "can0", 8, is_rx=False),
        ),
        (
            "(1.5) can0 123##300",
            can.Message(
                *(1.5, 0x123, False, False, False, "can0", 1, b"\0", True),
                bitrate_switch=True,
                error_state_indicator=True,
            ),
        ),
        (
            "(1.5) can0 20000004#0001000000000000",
            can.Message(1.5, 4, True, False, True, "can0", data=[0, 1, 0, 0, 0, 0, 0, 0]),
        ),
    ],
)
def test_a_line_is_read_as_it_is_meant(line: str, expected: can.Message) -> None:
    assert_equal([candump_message(line)], [expected])


@pytest.mark.parametrize(
    "line",
    [
        "",
        "\n",
        "hello",
        "(1.5) can0",
        "(1.5) can0 123",
        "(1.5) can0 123#0",  # half a byte
        "(1.5) can0 123#0g",
        "(1.5) can0 800#00",  # above the standard ids
        "(1.5) can0 -12#00",
        "(1.5) can0 40000000#00",  # above the extended ids
        "(1.5) can0 123#001122334455667788",  # nine bytes of classic CAN
        "(1.5) can0 123##1" + 65 * "00",
        "(1.5) can0 123##",
        "(1.5) can0 123#R9",
        "(nan) can0 123#00",
        "(-1) can0 123#00",
        "(x) can0 123#00",
        "vcan0  123   [2]  11 22",  # candump without -L
        "(1.5) can0 123#00 R and more",
    ],
)
def test_what_is_not_a_message_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        candump_message(line)


def test_garbage_lines_are_counted_skipped_and_reported(tmp_path: Path) -> None:
    path = tmp_path / "noisy.log"
    path.write_bytes(
        b"(1.0) can0 123#11\n\n\x00\xff\xfe garbage\n(2.0) can0 123#2\n(3.0) can0 123#33\n"
    )
    reader = read_log(path)
    assert [message.timestamp for message in reader] == [1.0, 3.0]
    assert reader.skipped == 2
    assert reader.truncated is None
    assert reader.remark == (
        f"{path}: lines without a message, skipped: 2 "
        r"(the first is line 3: '\x00\xff\xfe garbage')"
    )


@pytest.mark.parametrize("suffix", OF_PYTHON_CAN)
@pytest.mark.parametrize("packed", ["", ".gz"])
def test_every_format_gives_the_messages_that_were_written(
    suffix: str, packed: str, tmp_path: Path
) -> None:
    """To the format's resolution of time, and equal to python-can's own reader."""
    messages = recorded(SOME)
    path = write_log(tmp_path / f"drive{suffix}{packed}", messages)
    reader = read_log(path)
    found = list(reader)
    assert_equal(found, can.LogReader(path))
    assert [message.data for message in found] == [message.data for message in messages]
    start_s, recorded_s = found[0].timestamp, messages[0].timestamp
    for mine, message in zip(found, messages, strict=True):
        assert mine.timestamp - start_s == pytest.approx(message.timestamp - recorded_s, abs=2e-3)
    assert reader.remark is None


def test_a_log_can_be_read_again_from_its_start() -> None:
    reader = read_log(DATA / "srr520/candump.log.gz")
    assert_equal(list(reader), list(reader))
    assert reader.messages == 97


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("suffix", [".log", ".asc", ".trc"])
def test_a_log_that_ends_mid_line_is_read_up_to_there(
    suffix: str, packed: bool, tmp_path: Path
) -> None:
    """Wherever in the last message's line it was cut."""
    whole = write_log(tmp_path / f"whole{suffix}", recorded(20))
    lines = whole.read_bytes().splitlines(keepends=True)
    last = max(number for number, line in enumerate(lines) if len(line) > 30)
    before, line = b"".join(lines[:last]), lines[last].rstrip()
    expected = list(can.LogReader(whole))[:19]
    path = tmp_path / f"cut{suffix}{'.gz' if packed else ''}"
    for length in range(1, len(line) + 1):
        cut = before + line[:length]
        path.write_bytes(gzip.compress(cut, 1) if packed else cut)
        reader = read_log(path)
        assert_equal(reader, expected)
        if line[:length].strip():
            assert reader.truncated == (
                f"ends in the middle of line {last + 1}, read up to there (19 messages)"
            )


@pytest.mark.parametrize("suffix", OF_PYTHON_CAN)
def test_a_gzip_file_that_ends_early_is_read_up_to_there(suffix: str, tmp_path: Path) -> None:
    messages = recorded(5000)
    whole = write_log(tmp_path / f"drive{suffix}.gz", messages).read_bytes()
    path = tmp_path / f"cut{suffix}.gz"
    path.write_bytes(whole[: len(whole) * 2 // 3])
    reader = read_log(path)
    found = list(reader)
    # .blf comes in blocks of 128 kB: what is in a block that ends early is lost
    assert (0 if suffix == ".blf" else 2500) < len(found) < 5000
    assert [message.data for message in found] == [m.data for m in messages[: len(found)]]
    assert reader.truncated is not None
    assert f"read up to there ({len(found)} messages)" in reader.truncated


def test_a_blf_file_that_ends_early_is_read_up_to_there(tmp_path: Path) -> None:
    messages = recorded(5000)
    whole = write_log(tmp_path / "drive.blf", messages).read_bytes()
    path = tmp_path / "cut.blf"
    for length in (200, 1000, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        reader = read_log(path)
        found = list(reader) if length > 200 else []
        assert [message.data for message in found] == [m.data for m in messages[: len(found)]]
        if found:
            assert reader.truncated is not None
            assert "read up to there" in reader.truncated


def test_a_damaged_line_ends_an_asc_log_with_a_remark(tmp_path: Path) -> None:
    path = write_log(tmp_path / "drive.asc", recorded(10))
    lines = path.read_text().splitlines(keepends=True)
    lines[-3] = lines[-3].replace("d 4", "d z")
    path.write_text("".join(lines))
    reader = read_log(path)
    assert len(list(reader)) == 8
    assert reader.truncated is not None
    assert reader.truncated.startswith(f"line {len(lines) - 2} cannot be read")


def test_text_that_ends_without_a_message_is_whole(tmp_path: Path) -> None:
    """Vector's tools end an .asc log with `End TriggerBlock` and no end of line."""
    path = write_log(tmp_path / "drive.asc", recorded(5))
    path.write_bytes(path.read_bytes().rstrip())
    assert path.read_text().endswith("End TriggerBlock")
    reader = read_log(path)
    assert len(list(reader)) == 5
    assert reader.truncated is None


def messages_of(path: Path) -> list[can.Message]:
    return list(read_log(path))


def test_a_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"drive\.log does not exist; give the path"):
        read_log(tmp_path / "drive.log")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="is not a file"):
        read_log(tmp_path)


@pytest.mark.parametrize("name", ["drive.mp4", "drive", "drive.gz", "log"])
def test_an_unknown_format_names_the_known_ones(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(LogError, match=r"unknown log format .* \.log, \.asc, \.blf, \.trc"):
        read_log(tmp_path / name)


@pytest.mark.parametrize("suffix", [*OF_PYTHON_CAN, ".log.gz", ".blf.gz"])
@pytest.mark.parametrize("content", [b"", b"\n\n", b"no such thing\n", b"\x00\xff" * 500])
def test_a_log_without_a_message_is_refused(suffix: str, content: bytes, tmp_path: Path) -> None:
    """In one line that names the file."""
    path = tmp_path / f"drive{suffix}"
    path.write_bytes(content)
    with pytest.raises(LogError, match="there is no CAN message in it") as caught:
        messages_of(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_candump_text_for_people_is_recognised(tmp_path: Path) -> None:
    """What candump prints on the terminal is no log; the error says how to record one."""
    path = tmp_path / "drive.log"
    path.write_text("  vcan0  123   [2]  11 22\n")
    with pytest.raises(LogError, match=r"line 1: .* recorded with: candump -L"):
        messages_of(path)
