"""The entries of one recording file, in their order; what cannot be read ends it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Any

from eqrt.core.errors import LogError
from eqrt.runtime.recording.topics import NAMES, PROFILE, Topic

_TOPICS = {name: topic for topic, name in NAMES.items()}
_MAX_RECORD_BYTES = 1 << 30  # far above any chunk of ours: a damaged length is no reason to wait
_MAX_CHUNK_BYTES = 1 << 28


@dataclass(frozen=True, slots=True)
class Raw:
    """One entry, not yet decoded."""

    topic: Topic
    log_ns: int
    """Wall-clock time when it was recorded, ns since 1970."""
    payload: bytes


@dataclass(frozen=True, slots=True)
class Head:
    """What stands before the entries."""

    identity: dict[str, str]
    attached: dict[str, bytes]


def read_head(stream: IO[bytes], where: str) -> Head:
    """The description and the attachments. Raises LogError if it is no recording of eqrt."""
    from mcap.records import Attachment, Chunk, Metadata  # noqa: PLC0415 (see _records)

    identity: dict[str, str] = {}
    attached: dict[str, bytes] = {}
    for record in _records(stream, where, lambda _: None):
        if isinstance(record, Metadata):
            identity |= record.metadata
        elif isinstance(record, Attachment):
            attached[record.name] = record.data
        elif isinstance(record, Chunk):
            break
    if not identity:
        raise LogError(f"{where}: ends before it says what it is; the recording holds nothing")
    return Head(identity, attached)


def read_entries(stream: IO[bytes], where: str, end_early: Callable[[str], None]) -> Iterator[Raw]:
    """Every entry; `end_early` is told what was wrong if the file ends before its time.

    Raises LogError if it is no recording of eqrt.
    """
    from mcap.records import Channel, Chunk, Message  # noqa: PLC0415 (see _records)

    channels: dict[int, Topic | None] = {}
    for chunk in _records(stream, where, end_early):
        if not isinstance(chunk, Chunk):
            continue
        try:
            records = _opened(chunk)
        except _damages() as error:
            return end_early(f"a chunk is damaged ({_reason(error)})")
        for record in records:
            if isinstance(record, Channel):
                channels[record.id] = _TOPICS.get(record.topic)
            elif isinstance(record, Message):
                topic = channels.get(record.channel_id)
                if topic is not None:  # a topic that a later version adds
                    yield Raw(topic, record.log_time, record.data)


def _records(stream: IO[bytes], where: str, end_early: Callable[[str], None]) -> Iterator[Any]:
    """The file's records, chunks unopened."""
    # Imported here, because reading a recording is what few commands do, and it costs 8 MB.
    from mcap.records import Footer, Header  # noqa: PLC0415
    from mcap.stream_reader import StreamReader  # noqa: PLC0415

    records = StreamReader(stream, emit_chunks=True, record_size_limit=_MAX_RECORD_BYTES).records
    count = 0
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except _damages() as error:
            if not count:
                raise LogError(f"{where}: is no MCAP file ({_reason(error)})") from error
            return end_early(f"ends early ({_reason(error)})")
        if not count and not (isinstance(record, Header) and record.profile == PROFILE):
            raise LogError(
                f"{where}: is no recording of eqrt, but an MCAP file of another program; "
                "`eqrt serve --record` writes recordings"
            )
        count += 1
        yield record
        if isinstance(record, Footer):
            return


def _opened(chunk: Any) -> list[Any]:
    from mcap.stream_reader import breakup_chunk  # noqa: PLC0415 (see _records)

    if chunk.uncompressed_size > _MAX_CHUNK_BYTES:
        raise ValueError(f"{chunk.uncompressed_size} bytes in a chunk")
    try:
        return list(breakup_chunk(chunk, validate_crc=True))
    except Exception as error:  # whatever the library, or what unpacks for it, stumbles over
        raise ValueError(_reason(error)) from error


def _damages() -> tuple[type[Exception], ...]:
    """What the libraries raise on bytes that are not as they should be."""
    from mcap.exceptions import McapError  # noqa: PLC0415 (see _records)

    return (McapError, struct.error, ValueError, MemoryError)


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or "in the middle of a record"
