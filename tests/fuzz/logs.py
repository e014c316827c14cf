"""Fuzzed: recorded logs, in every format that is read."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from typing import Any

import can

from can_recordings import DATA, messages_of
from eqrt.core.errors import LogError
from eqrt.runtime.bus.logs import read_log
from fuzz.target import Target, assert_one_line, scratch, written

_SEED_MESSAGES = 12


def read(name: str, data: bytes) -> None:
    """Every message of the file has an id and a time that the rest of eqrt can work with."""
    log = read_log(written(name, data))
    try:
        for message in log:
            assert 0 <= message.arbitration_id <= 0x1FFFFFFF
            assert math.isfinite(message.timestamp)
            assert len(message.data) <= 64
    except LogError as error:
        assert_one_line(error)
    assert log.remark is None or "\n" not in log.remark


def _candump() -> Iterator[bytes]:
    for recording in ("ars408", "rav4", "srr520"):
        with gzip.open(DATA / recording / "candump.log.gz", "rb") as stream:
            yield b"".join(islice(stream, _SEED_MESSAGES))
    yield (
        b"(1591372012.436348) can0 60A#01C24910\n(1591372012.436349) can0 18DAF110#0211 R\n"
        b"(1591372012.436350) can1 384##1112233\n(1591372012.436351) can0 123#R8\n"
        b"(1591372012.436352) can0 20000080#0000000000000000 T\n"
    )


def _gzipped() -> Iterator[bytes]:
    for text in _candump():
        yield gzip.compress(text, mtime=0)


def _asc() -> Iterator[bytes]:
    yield from _written_by(can.ASCWriter, "seed.asc")


def _trc() -> Iterator[bytes]:
    yield from _written_by(can.TRCWriter, "seed.trc")
    yield b";$FILEVERSION=1.3\n;\n  1) 12.3 1 Rx 0300 - 7 00 00 00 00 04 00 00\n"
    yield (
        b";$FILEVERSION=2.0\n;$STARTTIME=43008.9\n;$COLUMNS=N,O,T,I,d,l,D\n"
        b" 1 1059.9 DT 0300 Rx 2 01 02\n"
    )


def _blf() -> Iterator[bytes]:
    for level in (0, 9):
        yield from _written_by(partial(can.BLFWriter, compression_level=level), "seed.blf")


def _written_by(writer: Callable[..., Any], name: str) -> Iterator[bytes]:
    """The logs that python-can writes of some recorded messages."""
    for recording in ("ars408", "srr520"):
        if name.endswith(".trc") and recording == "srr520":
            continue  # python-can writes no CAN FD there
        path = scratch() / name
        with writer(path) as log:
            for message in messages_of(recording)[:_SEED_MESSAGES]:
                log.on_message_received(message)
        yield path.read_bytes()


TARGETS = [
    Target(name="log-candump", run=partial(read, "a.log"), seeds=_candump, words=(" R\n", "##1")),
    Target(name="log-gzip", run=partial(read, "a.log.gz"), seeds=_gzipped),
    Target(
        name="log-asc",
        run=partial(read, "a.asc"),
        seeds=_asc,
        words=("date ", "base hex", "timestamps absolute", "CANFD", "ErrorFrame", "Rx", " d 8 "),
    ),
    Target(
        name="log-trc",
        run=partial(read, "a.trc"),
        seeds=_trc,
        words=(
            ";$FILEVERSION=2.1",
            ";$COLUMNS=N,O,T,B,I,d,R,L,D",
            ";$STARTTIME=",
            "DT",
            "FD",
            "ER",
        ),
    ),
    Target(name="log-blf", run=partial(read, "a.blf"), seeds=_blf, words=("LOBJ", "LOGG")),
]
