"""Fuzzed: recordings, as they are, and entries put into a recording that is well otherwise."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping

import can
import mcap.writer
import msgspec

from drives import Car, cycle
from eqrt.core.errors import LogError, TileError
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.recording.exact_forecasts import encode_forecasts
from eqrt.runtime.recording.identity import Identity
from eqrt.runtime.recording.reader import Recording
from eqrt.runtime.recording.replaying import recorded_profile, recorded_tile
from eqrt.runtime.recording.steps import Lost, PollEntry, Step, can_entry
from eqrt.runtime.recording.topics import (
    FORMAT_VERSION,
    IDENTITY,
    NAMES,
    PROFILE,
    PROFILE_FILES,
    TILE_FILE,
    Topic,
)
from forecast_sets import many
from fuzz.target import Target, assert_one_line, written
from tiny_sensor import COUNTED, DBC

_MSGPACK = msgspec.msgpack.Encoder()
_IDENTITY = dict.fromkeys(Identity.__struct_fields__, "1") | {
    "format": str(FORMAT_VERSION),
    "part": "0",
    "profile": "generic",
    "tile": "",
    "channels": "null",
}
_NO_PROFILE = {"generic.toml": '[sensors]\nname = "a"'}


def read_file(data: bytes) -> None:
    """By everything that reads recordings: as a log, entry by entry, and the files in it."""
    path = written("a.mcap", data)
    try:
        for message in read_log(path):
            _possible(message)
            assert math.isfinite(message.timestamp)
    except LogError as error:
        assert_one_line(error)
    try:
        recording = Recording([path])
        for one in recording.entries():
            _sound(one.entry)
    except LogError as error:
        assert_one_line(error)
        return
    assert recording.remark is None or "\n" not in recording.remark
    for read in (recorded_profile, lambda one: recorded_tile(one, one.attached)):
        try:
            read(recording)
        except (LogError, TileError) as error:
            assert_one_line(error)


def read_entries(data: bytes) -> None:
    """The input is entries: a byte for the topic, two for the length, the payload."""
    read_file(_recording(list(_entries(data))))


def _possible(message: can.Message) -> None:
    assert 0 <= message.arbitration_id <= 0x1FFFFFFF
    assert len(message.data) <= 64


def _sound(entry: object) -> None:
    if isinstance(entry, Step):
        assert math.isfinite(entry.now_s)
        assert all(map(math.isfinite, entry.clock_s))
        if entry.message is not None:
            _possible(entry.message)
    if isinstance(entry, ForecastSet):
        json_lines(entry)
    if isinstance(entry, Lost):
        assert entry.steps >= 0


def _entries(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 3 <= len(data):
        end = at + 3 + int.from_bytes(data[at + 1 : at + 3], "little")
        yield data[at] % len(Topic), data[at + 3 : end]
        at = end


def _packed(entries: list[tuple[int, bytes]]) -> bytes:
    return b"".join(bytes([t]) + len(p).to_bytes(2, "little") + p for t, p in entries)


def _recording(
    entries: list[tuple[int, bytes]],
    compression: mcap.writer.CompressionType = mcap.writer.CompressionType.NONE,
    profile: Mapping[str, str] = _NO_PROFILE,
    **identity: str,
) -> bytes:
    """A recording as the writer writes it."""
    stream = io.BytesIO()
    writer = mcap.writer.Writer(stream, compression=compression)
    writer.start(PROFILE, "seed")
    channels = [writer.register_channel(NAMES[topic], "msgpack", 0) for topic in Topic]
    writer.add_metadata(IDENTITY, _IDENTITY | identity)
    for name, content in profile.items():
        writer.add_attachment(0, 1, PROFILE_FILES + name, "text/plain", content.encode())
    writer.add_attachment(0, 1, TILE_FILE, "application/octet-stream", b"EQRTTILE")
    for number, (topic, payload) in enumerate(entries):
        writer.add_message(channels[topic], number, payload, number)
    writer.finish()
    return stream.getvalue()


def _seed_entries() -> list[tuple[int, bytes]]:
    message = cycle([Car(object_id=1, x_m=9.0, y_m=1.0)], 0.1)[0]
    lost = Lost(steps=3, forecasts=1, statuses=0)
    return [
        (Topic.CAN, _MSGPACK.encode(can_entry(message, 1.5))),
        (Topic.CLOCK, _MSGPACK.encode([1.5, 1.6])),
        (Topic.RUNS, _MSGPACK.encode([0, 2, 1])),
        (Topic.POLL, _MSGPACK.encode(PollEntry(1.7))),
        (Topic.LOST, msgspec.json.encode(lost)),
    ]


def _files() -> Iterator[bytes]:
    for compression in mcap.writer.CompressionType:
        yield _recording(_seed_entries(), compression)
    profile = COUNTED.replace("tiny.dbc", "../tiny.dbc")
    yield _recording([], profile={"generic.toml": profile, "../tiny.dbc": DBC})
    yield _recording([], part="-1", channels='{"car": "can0"}', stationary="true")
    yield _recording(_seed_entries(), tile="a.tile", tile_id="00000000", part="7")


def _lists_of_entries() -> Iterator[bytes]:
    yield _packed(_seed_entries())
    remote = can.Message(arbitration_id=1, is_extended_id=False, is_remote_frame=True, dlc=8)
    fd = can.Message(arbitration_id=0x18FF1234, is_fd=True, data=bytes(64), timestamp=1.0)
    yield _packed([(Topic.CAN, _MSGPACK.encode(can_entry(m, 1.0))) for m in (remote, fd)])
    yield _packed([(Topic.FORECASTS, encode_forecasts(many(1)))])


TARGETS = [
    Target(
        name="recording-file",
        run=read_file,
        seeds=_files,
        words=("MCAP0\\r\\n", "eqrt", "format", "part", "zstd", "lz4", "/can", "/eqrt/runs"),
        max_bytes=8192,
    ),
    Target(
        name="recording-entries",
        run=read_entries,
        seeds=_lists_of_entries,
        words=("now_s", "stamp_s", "data", "length", "remote", "extended", "channel", "fd"),
    ),
]
