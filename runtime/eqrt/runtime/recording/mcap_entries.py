"""The entries of one recording file, in their order; what cannot be read ends it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Any, cast

from eqrt.core.errors import LogError
from eqrt.runtime.recording.topics import NAMES, PROFILE, Topic

_TOPICS = {name: topic for topic, name in NAMES.items()}
_MAX_RECORD_BYTES = 1 << 29  # twice the largest tile: a damaged length is no reason to wait
_MAX_ATTACHED_BYTES = 1 << 29  # of all files that travel in a recording
_MAX_CHUNK_BYTES = 1 << 24  # unpacked; ours are closed at 1 MiB, and may have a second's rest
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ZSTD_HEAD_BYTES = 6


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
            if sum(map(len, attached.values())) > _MAX_ATTACHED_BYTES:
                raise LogError(f"{where}: has files of more than {_MAX_ATTACHED_BYTES} bytes in it")
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
        except ValueError as error:
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

    bounded = cast(IO[bytes], _Bounded(stream))  # of which the reader wants `read` alone
    records = StreamReader(bounded, emit_chunks=True, record_size_limit=_MAX_RECORD_BYTES).records
    count = 0
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except Exception as error:  # whatever the library stumbles over, as in _opened
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


class _Bounded:
    """A stream that is asked for no more than a record can have, whatever a damaged file says."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def read(self, size: int) -> bytes:
        if not 0 <= size <= _MAX_RECORD_BYTES:
            raise ValueError(f"{size} bytes in a record")
        return self._stream.read(size)


def _opened(chunk: Any) -> list[Any]:
    """The records in a chunk. Raises ValueError if it is damaged, or would be too large."""
    from mcap.stream_reader import breakup_chunk  # noqa: PLC0415 (see _records)

    _check_size(chunk)
    try:
        return list(breakup_chunk(chunk, validate_crc=True))
    except Exception as error:  # whatever the library, or what unpacks for it, stumbles over
        raise ValueError(_reason(error)) from error


def _check_size(chunk: Any) -> None:
    """Before anything is unpacked: what it says of its size, twice, and what eqrt never writes."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        size = max(size, _zstd_bytes(chunk.data))
    elif chunk.compression:
        raise ValueError(f"packed as {chunk.compression!r}, which eqrt does not write")
    else:
        size = len(chunk.data)
    if size > _MAX_CHUNK_BYTES:
        raise ValueError(f"{size} bytes in a chunk")


def _zstd_bytes(packed: bytes) -> int:
    """What a frame says that it unpacks to (RFC 8878, 3.1.1.1); the library allocates as much.

    0 if it does not say: then the chunk's own size is the library's limit.
    """
    if len(packed) < _ZSTD_HEAD_BYTES or packed[:4] != _ZSTD_MAGIC:
        return 0
    kind = packed[4]
    is_single = kind >> 5 & 1
    at = 5 + (1 - is_single) + (0, 1, 2, 4)[kind & 3]
    length = (is_single, 2, 4, 8)[kind >> 6]
    return int.from_bytes(packed[at : at + length], "little") + 256 * (length == 2)


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or "in the middle of a record"
