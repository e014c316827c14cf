"""Forecasts as datagrams: what is sent arrives, and who does not listen delays nobody."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator
from dataclasses import fields, replace

import msgspec
import numpy as np
import pytest

from eqrt.core.errors import UsageError
from eqrt.runtime.output.datagrams import (
    MAX_BYTES,
    Datagram,
    DatagramPublisher,
    decode_datagram,
    encode_datagrams,
)
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import BusStatus, ServiceStatus, SourceStatus
from forecast_sets import many, nobody, one_car

BAD_ADDRESSES = ["127.0.0.1", "nowhere", "127.0.0.1:port", "[::1]:99999", ":47310", ""]


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5.0)
        yield receiver


def address_of(listener: socket.socket) -> str:
    return f"127.0.0.1:{listener.getsockname()[1]}"


def received(listener: socket.socket) -> Datagram:
    return forecast_in(listener.recv(65_536))


def forecast_in(payload: bytes) -> Datagram:
    datagram = decode_datagram(payload)
    assert isinstance(datagram, Datagram)
    return datagram


def assert_same(received: ForecastSet, sent: ForecastSet) -> None:
    """Arrays to 0.1 mm, everything else exactly."""
    for name in (field.name for field in fields(ForecastSet)):
        values, expected = getattr(received, name), getattr(sent, name)
        if isinstance(expected, np.ndarray):
            assert values.dtype == expected.dtype
            assert values.shape == expected.shape
            np.testing.assert_allclose(values, expected, rtol=0.0, atol=1e-4, err_msg=name)
        else:
            assert values == expected, name


def uncertain() -> ForecastSet:
    """With a covariance of every position."""
    spread = np.random.default_rng(1).uniform(0.1, 4.0, (5, 6, 30, 2, 2))
    return replace(many(5), covariances=spread)


@pytest.mark.parametrize(
    "forecasts",
    [one_car(), many(30), nobody(), replace(nobody(), map_from_ego=None), uncertain()],
    ids=["one", "30", "none", "nowhere", "uncertain"],
)
def test_what_is_sent_arrives(forecasts: ForecastSet, listener: socket.socket) -> None:
    with DatagramPublisher([address_of(listener)]) as publisher:
        publisher.publish(forecasts)
    datagram = received(listener)
    assert (datagram.part, datagram.parts) == (0, 1)
    assert_same(datagram.forecasts, forecasts)
    assert (publisher.sent, publisher.failed) == (1, 0)


def test_far_from_the_origin_of_the_map_millimetres_are_kept(listener: socket.socket) -> None:
    """5,000 km away, where float32 would be off by 0.25 m."""
    near, away = many(8), np.array([3e6, 4e6])
    here = near.map_from_ego
    assert here is not None
    ego = replace(here, x_m=here.x_m + 3e6, y_m=here.y_m + 4e6)
    far = replace(
        near,
        map_from_ego=ego,
        position=near.position + away,
        history=near.history + away,
        trajectories=near.trajectories + away,
    )
    with DatagramPublisher([address_of(listener)]) as publisher:
        publisher.publish(far)
    assert_same(received(listener).forecasts, far)


def test_a_cycle_too_large_for_a_datagram_comes_in_parts() -> None:
    """100 objects of six modes and 3 s; every object is in one part, whole."""
    forecasts = many(100)
    payloads = list(encode_datagrams(forecasts))
    assert all(len(payload) <= MAX_BYTES for payload in payloads)
    parts = [forecast_in(payload) for payload in payloads]
    assert [(part.part, part.parts) for part in parts] == [(0, 3), (1, 3), (2, 3)]
    assert {part.forecasts.cycle for part in parts} == {forecasts.cycle}
    track_id = np.concatenate([part.forecasts.track_id for part in parts])
    np.testing.assert_array_equal(track_id, forecasts.track_id)
    trajectories = np.concatenate([part.forecasts.trajectories for part in parts])
    np.testing.assert_allclose(trajectories, forecasts.trajectories, rtol=0.0, atol=1e-4)


def test_a_closed_port_fails_nothing(listener: socket.socket) -> None:
    """The viewer has gone, the one beside it still gets everything."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        closed = address_of(gone)
    with DatagramPublisher([closed, address_of(listener)]) as publisher:
        for _ in range(3):
            publisher.publish(one_car())
    assert [received(listener).forecasts.cycle for _ in range(3)] == [300] * 3
    assert (publisher.sent, publisher.failed) == (6, 0)


def test_a_listener_that_never_reads_delays_nothing(listener: socket.socket) -> None:
    """Ninety megabytes for it are dropped by the system."""
    forecasts = many(32)
    with DatagramPublisher([address_of(listener)]) as publisher:
        for _ in range(2000):
            publisher.publish(forecasts)
    assert publisher.sent + publisher.failed == 2000


@pytest.mark.parametrize("address", BAD_ADDRESSES)
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="give HOST:PORT"):
        DatagramPublisher([address])


def test_no_address_sends_nothing() -> None:
    with DatagramPublisher([]) as publisher:
        publisher.publish(one_car())
    assert publisher.sent == 0


def test_the_status_arrives(listener: socket.socket) -> None:
    status = ServiceStatus(
        time_s=12.5,
        uptime_s=3.0,
        seconds=1.0,
        eqrt="0.1.0",
        profile="ars408",
        model="eqrt-free",
        model_id="01234567",
        tile="",
        tile_id="",
        mode=Mode.NO_MAP,
        mode_s=2.5,
        objects=2,
        messages=120,
        latencies_s=[0.002, 0.003],
        stages_s={"infer": 0.0004},
        totals={"decoder_messages": 900},
        buses=[BusStatus(channel="can0", state="UP", since_s=3.0, overflow=7)],
        sources=[SourceStatus(name="radar", valid=False, reason="silent", since_s=0.4)],
    )
    with DatagramPublisher([address_of(listener)]) as publisher:
        publisher.report(status)
    assert decode_datagram(listener.recv(65_536)) == status
    assert publisher.counts() == {"datagrams_sent": 1, "datagrams_failed": 0}


@pytest.mark.parametrize("payload", [b"", b"\x00", b"hello", b"\xff" * 200, b"\x81\xa7version\x01"])
def test_something_else_is_not_taken_for_a_datagram(payload: bytes) -> None:
    with pytest.raises(ValueError, match="eqrt"):
        decode_datagram(payload)


def test_a_datagram_of_another_version_says_so() -> None:
    (payload,) = encode_datagrams(one_car())
    later = payload.replace(b"\xa7version\x02", b"\xa7version\x03")
    with pytest.raises(ValueError, match="datagram format 3, this version of eqrt reads format 2"):
        decode_datagram(later)


@pytest.mark.parametrize("shape", [(2, 20, 2, 30), (1, 20, 2, -30), (-1, 20, 2, 30)])
def test_arrays_that_do_not_fit_their_shape_are_refused(shape: tuple[int, ...]) -> None:
    (payload,) = encode_datagrams(one_car())
    told = msgspec.msgpack.decode(payload)
    with pytest.raises(ValueError, match=r"shape|reshape"):
        decode_datagram(msgspec.msgpack.encode(told | {"shape": shape}))


@pytest.mark.parametrize(
    "odd",
    [
        {"part": 1},
        {"part": -1},
        {"parts": 0},
        {"dt_s": 0.0},
        {"dt_s": -0.1},
        {"dt_s": math.nan},
        {"timestamp_s": math.nan},
        {"made_s": math.inf},
        {"mode": 77},
        {"agent_mode": b"\x63"},
        {"shape": (1, 20, 0, 30), "trajectories": b"", "probabilities": b""},
        {"shape": (1, 20, 2, 0), "trajectories": b""},
    ],
    ids=str,
)
def test_numbers_that_no_service_says_are_refused(odd: dict[str, object]) -> None:
    """Whoever hears them divides by them, counts with them, and looks names up."""
    (payload,) = encode_datagrams(one_car())
    told = msgspec.msgpack.decode(payload)
    decode_datagram(msgspec.msgpack.encode(told))
    with pytest.raises(ValueError, match=r"not a datagram of eqrt|not a valid Mode"):
        decode_datagram(msgspec.msgpack.encode(told | odd))


def test_half_a_datagram_is_refused() -> None:
    """Wherever it was cut."""
    (payload,) = encode_datagrams(one_car())
    for length in range(0, len(payload), 7):
        with pytest.raises(ValueError, match=r"eqrt|reshape|buffer"):
            decode_datagram(payload[:length])
