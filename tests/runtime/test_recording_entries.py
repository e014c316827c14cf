"""The entries of a recording, there and back: nothing is lost on the way."""

from __future__ import annotations

import math
import os
import time
from dataclasses import fields, replace

import can
import msgspec
import numpy as np
import pytest

from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.recording.exact_forecasts import decode_forecasts, encode_forecasts
from eqrt.runtime.recording.pipe import PipeEnd
from eqrt.runtime.recording.steps import CanEntry, can_entry, can_message
from forecast_sets import many, nobody, one_car

MESSAGES = [
    can.Message(timestamp=1.7e9 + 1e-7, arbitration_id=0x7FF, is_extended_id=False, data=b"1"),
    can.Message(arbitration_id=0x1FFFFFFF, is_extended_id=True, channel="can0", data=bytes(8)),
    can.Message(arbitration_id=5, is_extended_id=False, is_remote_frame=True, dlc=6, channel=3),
    can.Message(arbitration_id=5, is_error_frame=True, data=bytes(8), is_rx=False),
    can.Message(
        arbitration_id=5,
        is_fd=True,
        bitrate_switch=True,
        error_state_indicator=True,
        data=bytes(64),
    ),
    can.Message(timestamp=float("inf"), arbitration_id=0),
]


@pytest.mark.parametrize("message", MESSAGES, ids=str)
def test_every_kind_of_message_comes_back_as_it_was(message: can.Message) -> None:
    wire = msgspec.msgpack.encode(can_entry(message, 12.3))
    entry = msgspec.msgpack.decode(wire, type=CanEntry)
    again = can_message(entry)
    assert entry.now_s == 12.3
    for name in can.Message.__slots__:
        if name != "__weakref__":
            assert getattr(again, name) == getattr(message, name), name


FORECASTS = {
    "one": one_car(),
    "nobody": nobody(),
    "nowhere": replace(nobody(), map_from_ego=None),
    "many": many(70),
    "covariances": replace(many(3), covariances=np.random.default_rng(0).random((3, 6, 30, 2, 2))),
}


@pytest.mark.parametrize("name", FORECASTS)
def test_forecasts_come_back_to_the_last_bit(name: str) -> None:
    """Also NaN, and types."""
    before = FORECASTS[name]
    after = decode_forecasts(encode_forecasts(before))
    for field in fields(ForecastSet):
        mine, theirs = getattr(before, field.name), getattr(after, field.name)
        assert type(mine) is type(theirs), field.name
        if isinstance(mine, np.ndarray):
            assert mine.dtype == theirs.dtype
            assert mine.shape == theirs.shape
            assert mine.tobytes() == theirs.tobytes()
        else:
            assert repr(mine) == repr(theirs)  # also NaN


@pytest.mark.parametrize(
    "payload",
    [b"", b"\x80", b"\xc0", msgspec.msgpack.encode({"mode": 99, "map_from_ego": (0, 0, 0)})],
)
def test_other_bytes_are_no_forecasts(payload: bytes) -> None:
    with pytest.raises(ValueError, match=r"forecasts|Mode"):
        decode_forecasts(payload)


def test_forecasts_of_an_older_recording_do_not_tell_when_their_input_came() -> None:
    plain = msgspec.msgpack.decode(encode_forecasts(one_car()))
    del plain["received_s"]
    assert math.isnan(decode_forecasts(msgspec.msgpack.encode(plain)).received_s)


def test_an_array_of_objects_is_refused() -> None:
    """numpy would take them for addresses."""
    plain = msgspec.msgpack.decode(encode_forecasts(one_car()))
    plain["position"] = ("|O", (1, 2), bytes(16))
    with pytest.raises(ValueError, match="array"):
        decode_forecasts(msgspec.msgpack.encode(plain))


def test_a_pipe_takes_what_fits_and_refuses_the_rest_whole() -> None:
    """Nobody reads; then everything that was taken arrives, in order and complete."""
    reading, writing = os.pipe()
    pipe = PipeEnd(writing, max_waiting_bytes=200_000)
    pieces = [bytes([k]) * 50_000 for k in range(60)]
    taken = [piece for piece in pieces if pipe.offer(piece)]
    assert 4 <= len(taken) < len(pieces)
    assert pipe.waiting_bytes <= 200_000
    read = b""
    while len(read) < 50_000 * len(taken):
        read += os.read(reading, 1 << 20)
        pipe.push()
    assert read == b"".join(taken)
    assert pipe.offer(b"again")
    os.close(reading)
    pipe.push()
    assert not pipe.offer(b"nobody reads")
    assert not pipe.is_open
    pipe.close(time.monotonic() + 1.0)
