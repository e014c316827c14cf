"""Recorded CAN logs, one message after the other, from whatever the recorder wrote.

candump text has a parser of its own, because replaying is a hot path; the other formats are read by
python-can. Every one of them may be gzip'd. `.mcap` are recordings of eqrt itself
(`eqrt.runtime.recording`). A recorder that was switched off leaves half a line, or
half of a compressed block: a log is read up to there, and the reader says so.
"""

from __future__ import annotations

import gzip
import io
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import IO, BinaryIO, TextIO, cast

import can

from eqrt.core.errors import LogError
from eqrt.core.files import may_be_file
from eqrt.runtime.bus.candump import candump_message

MAX_LINE = 1 << 14
"""Characters; 64 bytes of CAN FD with every remark of a recorder take some hundred."""
MAX_BLOCK_BYTES = 1 << 24
"""Of a .blf's containers, packed and unpacked, and of an object in them: recorders write 128 KiB at
a time. What a file asks for is read and unpacked up to here only, whatever it asks for."""

_DEFLATED, _CONTAINER_HEADER_BYTES = b"\2\0", 16  # how a packed container of a .blf begins
_OBJECT_HEADER_BYTES = 16
_SMALLER_THAN_ITS_HEADER = re.compile(rb"LOBJ.{4}[\x00-\x0f]\x00\x00\x00", re.DOTALL)
_MAX_DATA_BYTES, _MAX_ID, _MAX_EXTENDED_ID = 64, 0x7FF, 0x1FFFFFFF
_MAX_TIME_S = 1e11  # the year 5138; a comparison that NaN and infinity fail as well
_CUT_SHORT = (EOFError, zlib.error, gzip.BadGzipFile)
_SAYS_NOTHING = ("end triggerblock", "//", ";")  # last lines of .asc and .trc without a message
# Not read by itself: python-can's reader imports asammdf, and with it pandas, wherever both are
# installed, so that every command would start later.
_FROM_MDF = (
    "from MF4 make one with can_logconvert, which `pip install 'python-can[mf4]'` brings into an "
    "environment of its own"
)


class LogReader:
    """The messages of one log, in recorded order; can be iterated again from the start.

    `can.Message.channel` is what the recorder called the bus: a name in candump text, a number
    counted from 0 in .asc and .blf and from 1 in .trc. Times are the recorder's.
    """

    def __init__(self, path: Path, messages_in: MessagesIn) -> None:
        self.path = path
        self._places = "objects" if messages_in is _blf else "lines"
        self._messages_in = messages_in
        self._reset()

    def _reset(self) -> None:
        self.messages = 0
        """Read so far."""
        self.skipped = 0
        """Lines (.blf: objects) so far that hold no message, or one that CAN cannot carry. In .asc
        and .trc, lines without a message are nothing special and do not count."""
        self.first_skipped: str | None = None
        """Where the first of them is, and what it says."""
        self.truncated: str | None = None
        """What ended the log early, and where; None = it is complete, or not yet at its end."""

    def __iter__(self) -> Iterator[can.Message]:
        """Raises LogError if the file cannot be read, or holds no message at all."""
        self._reset()
        try:
            with _opened(self.path) as stream:
                for message in self._messages_in(stream, self):
                    self.messages += 1
                    yield message
        except OSError as error:
            raise LogError(f"cannot read {self.path}: {error.strerror or error}") from error
        if not self.messages:
            raise LogError(f"{self.path}: there is no CAN message in it{self._why_empty()}")

    @property
    def remark(self) -> str | None:
        """One line about what could not be read so far, None if everything could."""
        remarks = []
        if self.skipped:
            first = f"the first is {self.first_skipped}"
            remarks.append(f"{self._places} without a message, skipped: {self.skipped} ({first})")
        if self.truncated:
            remarks.append(self.truncated)
        return f"{self.path}: {'; '.join(remarks)}" if remarks else None

    def skip(self, where: str) -> None:
        """Note a place that holds no message."""
        self.skipped += 1
        self.first_skipped = self.first_skipped or where

    def skip_line(self, number: int, line: str) -> None:
        """Note a line that holds no message."""
        self.skip(f"line {number}: {line.rstrip()[:60]!a}")

    def end_early(self, what: str) -> None:
        """Note why, and where, the log ends before its time; the first reason counts."""
        self.truncated = self.truncated or f"{what}, read up to there ({self.messages} messages)"

    def _why_empty(self) -> str:
        if self.skipped:
            return f" ({self.first_skipped}); candump text is recorded with: candump -L"
        return f" ({self.truncated})" if self.truncated else ""


MessagesIn = Callable[[IO[bytes], LogReader], Iterator[can.Message]]
"""Gets the messages out of an open log; what cannot be read is noted on the reader."""


def read_log(path: str | Path) -> LogReader:
    """The reader for a log, whose format is told by its name: `FORMATS`, each also with `.gz`.

    Raises LogError if there is no such file or its name tells no format.
    """
    path = Path(path)
    if not may_be_file(path):
        found = "is not a file" if path.exists() else "does not exist"
        raise LogError(f"the log {path} {found}; give the path of a recorded CAN log")
    suffix = Path(path.name.lower().removesuffix(".gz")).suffix
    if suffix not in FORMATS:
        known = ", ".join(FORMATS)
        convert = f"; {_FROM_MDF}" if suffix == ".mf4" else ""
        raise LogError(
            f"{path}: unknown log format {suffix!r}; known are {known} (also with .gz){convert}"
        )
    return LogReader(path, FORMATS[suffix])


def _opened(path: Path) -> IO[bytes]:
    if path.suffix.lower() == ".gz":
        return cast("IO[bytes]", gzip.open(path, "rb"))
    return path.open("rb")


def _candump(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    with _CompleteLines(stream, reader) as lines:
        for line in lines:
            try:
                yield candump_message(line)
            except ValueError:
                if not line.isspace():
                    reader.skip_line(lines.count, line)


def _asc(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    with _CompleteLines(stream, reader) as lines:
        yield from _text(can.ASCReader, lines, reader)


def _trc(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    with _CompleteLines(stream, reader) as lines:
        yield from _text(can.TRCReader, lines, reader)


def _text(
    parser: Callable[[TextIO], Iterable[can.Message]], lines: _CompleteLines, reader: LogReader
) -> Iterator[can.Message]:
    try:
        for message in parser(cast("TextIO", lines)):
            if _exists(message):
                yield message
            else:
                reader.skip(f"line {lines.count}")
    except Exception as error:  # python-can lets through whatever it stumbles over
        if isinstance(error, OSError):
            raise
        reader.end_early(f"line {lines.count} cannot be read ({_reason(error)})")


def _blf(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    blocks = _Blocks(stream)
    try:
        log = _BoundedBLFReader(cast("BinaryIO", blocks))
        for message in log:
            if _exists(message):
                yield message
            else:
                reader.skip(f"before byte {blocks.position}")
    except Exception as error:  # as above
        if isinstance(error, OSError) and not isinstance(error, gzip.BadGzipFile):
            raise
        return reader.end_early(f"byte {blocks.position} cannot be read ({_reason(error)})")
    if blocks.cut or blocks.position < log.file_size:
        reader.end_early(f"ends early, after {blocks.position} of {log.file_size} bytes")


def _mcap(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    # Imported here, because recordings are read through this module as well.
    from eqrt.runtime.recording.reader import can_messages  # noqa: PLC0415

    return can_messages(stream, reader)


def _exists(message: can.Message) -> bool:
    """Whether a CAN bus could have carried it, at a time that there is."""
    is_long = message.is_extended_id or message.is_error_frame
    return (
        len(message.data) <= _MAX_DATA_BYTES
        and 0 <= message.arbitration_id <= (_MAX_EXTENDED_ID if is_long else _MAX_ID)
        and abs(message.timestamp) < _MAX_TIME_S
    )


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:80] or "damaged"


FORMATS: dict[str, MessagesIn] = {
    ".log": _candump,
    ".asc": _asc,
    ".blf": _blf,
    ".trc": _trc,
    ".mcap": _mcap,
}
"""Name of a log's format -> how it is read."""


class _CompleteLines(io.TextIOBase):
    """The lines of a log; half a line at its end, or an endless one, is noted on the reader."""

    def __init__(self, stream: IO[bytes], reader: LogReader) -> None:
        self._lines = io.TextIOWrapper(stream, encoding="latin-1", newline="\n")  # reads any byte
        self._reader = reader
        self.count = 0

    def __iter__(self) -> Iterator[str]:  # type: ignore[override] # typeshed: bytes
        try:
            for line in iter(partial(self._lines.readline, MAX_LINE), ""):
                self.count += 1
                if line[-1] != "\n":
                    return self._note_half(line)
                yield line
        except _CUT_SHORT as error:
            self._reader.end_early(f"cannot be unpacked after line {self.count} ({error})")

    def close(self) -> None:
        self._lines.close()
        super().close()

    def _note_half(self, line: str) -> None:
        if len(line) == MAX_LINE:
            self._reader.end_early(f"line {self.count} is longer than {MAX_LINE} characters")
        elif line.strip() and not line.lower().startswith(_SAYS_NOTHING):
            self._reader.end_early(f"ends in the middle of line {self.count}")


class _Blocks(io.RawIOBase):
    """A binary log that counts what is read, and notes when less came than was asked for."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.position = 0
        self.cut = False

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= MAX_BLOCK_BYTES:
            raise ValueError(f"a block of {size} bytes, expected up to {MAX_BLOCK_BYTES}")
        block = self._stream.read(size)
        self.position += len(block)
        self.cut = self.cut or 0 < len(block) < size
        if block.startswith(_DEFLATED) and _unpacks_beyond(MAX_BLOCK_BYTES, block):
            raise ValueError(f"a block that unpacks to more than {MAX_BLOCK_BYTES} bytes")
        return block


def _unpacks_beyond(limit: int, container: bytes) -> bool:
    """Whether zlib data behind a container's header has more bytes than `limit`; else anything."""
    unpacker = zlib.decompressobj()
    try:
        unpacker.decompress(container[_CONTAINER_HEADER_BYTES:], limit)
    except zlib.error:  # damaged, or no container: python-can will see
        return False
    return bool(unpacker.unconsumed_tail)


class _BoundedBLFReader(can.BLFReader):
    """Ends at an object that python-can would never get past, or never have enough of."""

    def _parse_container(self, data: bytes) -> Iterator[can.Message]:
        if len(self._tail) > MAX_BLOCK_BYTES:
            raise ValueError(f"an object of more than {MAX_BLOCK_BYTES} bytes")
        seam = self._tail[1 - _OBJECT_HEADER_BYTES :]  # a header may lie in two containers
        endless = _SMALLER_THAN_ITS_HEADER.search(seam + data)
        if endless is None:
            yield from super()._parse_container(data)
        else:
            yield from super()._parse_container(data[: max(0, endless.start() - len(seam))])
            raise ValueError("an object smaller than its header")
