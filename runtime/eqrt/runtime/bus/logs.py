"""Recorded CAN logs, one message after the other, from whatever the recorder wrote.

candump text has a parser of its own, because replaying is a hot path; the other formats are read by
python-can. Every one of them may be gzip'd. `.mcap` are recordings of eqrt itself
(`eqrt.runtime.recording`). A recorder that was switched off leaves half a line, or
half of a compressed block: a log is read up to there, and the reader says so.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, BinaryIO, TextIO, cast

import can

from eqrt.core.errors import LogError
from eqrt.runtime.bus.candump import candump_message

_CUT_SHORT = (EOFError, zlib.error, gzip.BadGzipFile)
_BAD_TEXT = (ValueError, IndexError, KeyError, NotImplementedError)
_BAD_BLF = (can.io.blf.BLFParseError, struct.error, zlib.error, EOFError, gzip.BadGzipFile)
_SAYS_NOTHING = ("end triggerblock", "//", ";")  # last lines of .asc and .trc without a message


class LogReader:
    """The messages of one log, in recorded order; can be iterated again from the start.

    `can.Message.channel` is what the recorder called the bus: a name in candump text, a number
    counted from 0 in .asc and .blf and from 1 in .trc. Times are the recorder's.
    """

    def __init__(self, path: Path, messages_in: MessagesIn) -> None:
        self.path = path
        self._messages_in = messages_in
        self._reset()

    def _reset(self) -> None:
        self.messages = 0
        """Read so far."""
        self.skipped = 0
        """Lines so far that hold no message (candump text only)."""
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
            remarks.append(f"lines without a message, skipped: {self.skipped} ({first})")
        if self.truncated:
            remarks.append(self.truncated)
        return f"{self.path}: {'; '.join(remarks)}" if remarks else None

    def skip_line(self, number: int, line: str) -> None:
        """Note a line that holds no message."""
        self.skipped += 1
        if self.first_skipped is None:
            self.first_skipped = f"line {number}: {line.rstrip()[:60]!a}"

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
    if not path.is_file():
        found = "is not a file" if path.exists() else "does not exist"
        raise LogError(f"the log {path} {found}; give the path of a recorded CAN log")
    suffix = Path(path.name.lower().removesuffix(".gz")).suffix
    if suffix not in FORMATS:
        known = ", ".join(FORMATS)
        raise LogError(f"{path}: unknown log format {suffix!r}; known are {known} (also with .gz)")
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
        yield from _text(can.ASCReader(cast("TextIO", lines)), lines, reader)


def _trc(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    with _CompleteLines(stream, reader) as lines:
        yield from _text(can.TRCReader(cast("TextIO", lines)), lines, reader)


def _text(
    messages: Iterable[can.Message], lines: _CompleteLines, reader: LogReader
) -> Iterator[can.Message]:
    try:
        yield from messages
    except _BAD_TEXT as error:
        reader.end_early(f"line {lines.count} cannot be read ({error})")


def _blf(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    blocks = _Blocks(stream)
    try:
        log = can.BLFReader(cast("BinaryIO", blocks))
        yield from log
    except _BAD_BLF as error:
        return reader.end_early(f"byte {blocks.position} cannot be read ({error or 'damaged'})")
    if blocks.cut or blocks.position < log.file_size:
        reader.end_early(f"ends early, after {blocks.position} of {log.file_size} bytes")


def _mcap(stream: IO[bytes], reader: LogReader) -> Iterator[can.Message]:
    # Imported here, because recordings are read through this module as well.
    from eqrt.runtime.recording.reader import can_messages  # noqa: PLC0415

    return can_messages(stream, reader)


FORMATS: dict[str, MessagesIn] = {
    ".log": _candump,
    ".asc": _asc,
    ".blf": _blf,
    ".trc": _trc,
    ".mcap": _mcap,
}
"""Name of a log's format -> how it is read."""


class _CompleteLines(io.TextIOBase):
    """The lines of a log; half a line at its end is noted on the reader instead."""

    def __init__(self, stream: IO[bytes], reader: LogReader) -> None:
        self._lines = io.TextIOWrapper(stream, encoding="latin-1", newline="\n")  # reads any byte
        self._reader = reader
        self.count = 0

    def __iter__(self) -> Iterator[str]:  # type: ignore[override] # typeshed: bytes
        try:
            for line in self._lines:
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
        if line.strip() and not line.lower().startswith(_SAYS_NOTHING):
            self._reader.end_early(f"ends in the middle of line {self.count}")


class _Blocks(io.RawIOBase):
    """A binary log that counts what is read, and notes when less came than was asked for."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.position = 0
        self.cut = False

    def read(self, size: int = -1) -> bytes:
        block = self._stream.read(size)
        self.position += len(block)
        self.cut = self.cut or 0 < len(block) < size
        return block
