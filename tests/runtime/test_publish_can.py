"""What a consumer with `eqrt.dbc` and any CAN tool gets to see; cantools is the oracle."""

from __future__ import annotations

import errno
import itertools
import time
from collections.abc import Iterator
from dataclasses import replace
from operator import eq
from typing import Any

import can
import numpy as np
import pytest
from cantools.database.can import Database
from cantools.database.namedsignalvalue import NamedSignalValue
from e2e import p02, p05
from numpy.typing import NDArray

from eqrt.core.errors import UsageError
from eqrt.core.frames import Pose2
from eqrt.runtime.bus.buses import open_bus
from eqrt.runtime.bus.outbox import AGAIN_S, Outbox
from eqrt.runtime.output import can_output
from eqrt.runtime.output.can_output import Offset, encode_classic, encode_fd, protect
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.publish_can import BASE_ID, CanPublisher, nearest_first
from eqrt.runtime.protection.e2e import (
    Checker,
    Profile2,
    Profile5,
    Protection,
    data_id_of,
    data_ids_of,
)
from eqrt.runtime.protection.sequence import Status
from forecast_sets import many, nobody, one_car
from source_tree import ROOT

DBC = ROOT / "runtime/eqrt/runtime/output/eqrt.dbc"
ENCODING_BUDGET_S = 0.001  # p99 for 32 objects on the reference machine (2 cores)
PROTECTION_BUDGET_S = 0.0003  # likewise, for counters and checks
NOT_AVAILABLE = "NOT_AVAILABLE"
CHANNELS = (f"publish-{number}" for number in itertools.count())

Decoded = list[tuple[str, dict[str, Any]]]
"""(message name, signal -> value) in the order of arrival."""


@pytest.fixture(scope="module")
def database() -> Database:
    database = Database()
    database.add_dbc_file(str(DBC))
    return database


class Wire:
    """A publisher on one end of a bus, a consumer on the other."""

    def __init__(self, database: Database, *, fd: bool = True, **options: int) -> None:
        channel = next(CHANNELS)
        self.database = database
        self.listener = open_bus(channel, "virtual", fd=fd)
        self.bus = open_bus(channel, "virtual", fd=fd)
        self.publisher = CanPublisher(Outbox(self.bus), **options)

    def messages(self, forecasts: ForecastSet) -> list[can.Message]:
        """What is on the bus once `forecasts` are published."""
        self.publisher.publish(forecasts)
        return list(iter(lambda: self.listener.recv(0.0), None))

    def decoded(self, forecasts: ForecastSet) -> Decoded:
        """The same, as the DBC reads it."""
        return [decode(self.database, message) for message in self.messages(forecasts)]

    def close(self) -> None:
        self.listener.shutdown()
        self.bus.shutdown()


@pytest.fixture
def fd(database: Database) -> Iterator[Wire]:
    wire = Wire(database)
    yield wire
    wire.close()


@pytest.fixture
def classic(database: Database) -> Iterator[Wire]:
    wire = Wire(database, fd=False)
    yield wire
    wire.close()


def decode(database: Database, message: can.Message) -> tuple[str, dict[str, Any]]:
    definition = database.get_message_by_frame_id(message.arbitration_id)
    assert definition.length == len(message.data)
    assert definition.is_fd == message.is_fd
    values = definition.decode(bytes(message.data))
    assert isinstance(values, dict)
    plain = {k: str(v) if isinstance(v, NamedSignalValue) else v for k, v in values.items()}
    return definition.name, plain


def test_a_car_ahead_reads_as_such_on_can_fd(fd: Wire) -> None:
    """The map's north is the ego's forward: 20 m ahead, 10 m/s, 3 m further with every point."""
    (_, status), (name, car) = fd.decoded(one_car())
    assert status.pop("Crc") > 0
    assert car.pop("Crc") > 0
    assert status == {
        "AliveCounter": 0,
        "Mode": "NO_MAP",
        "FormatVersion": 2,
        "NumObjects": 1,
        "NumModes": 1,
        "Cycle": 300 - 256,
        "InputAge": 12,
        "ComputeTime": pytest.approx(8.1),
        "PointStep": 300,
        "EgoYaw": pytest.approx(np.pi / 2, abs=0.5e-4),
        "ModelId": 0x01234567,
        "TileId": 0,
        "EgoX": pytest.approx(100.0),
        "EgoY": pytest.approx(200.0),
    }
    assert name == "EQRT_Trajectory"
    points = {f"X{i}": pytest.approx(20.0 + 3.0 * i) for i in range(1, 11)}
    assert car == {
        "AliveCounter": 0,
        "Cycle": 300 - 256,
        "ObjectIndex": 0,
        "ModeIndex": 0,
        "AgentMode": "PARTIAL",
        "Probability": 75.0,
        "TrackId": 65_537 - 65_536,
        "ObjectId": 17,
        "Age": 50,
        "PositionX": pytest.approx(20.0),
        "PositionY": 0.0,
        "VelocityX": pytest.approx(10.0),
        "VelocityY": 0.0,
        "PointStep": 300,
        **points,
        **{f"Y{i}": 0.0 for i in range(1, 11)},
    }


def test_a_car_ahead_reads_as_such_on_classic_can(classic: Wire) -> None:
    """10, 20 and 30 m further after 1, 2 and 3 s."""
    decoded = classic.decoded(one_car())
    assert [name for name, _ in decoded] == [
        "EQRT_StatusClassic",
        "EQRT_IdentityClassic",
        "EQRT_ObjectClassic",
        *["EQRT_PointClassic"] * 3,
    ]
    status, identity, car, *points = (values for _, values in decoded)
    assert (status["Mode"], status["NumObjects"], status["InputAge"]) == ("NO_MAP", 1, 12)
    assert (status["Cycle"], status["ComputeTime"], status["FormatVersion"]) == (44, 8, 2)
    assert (identity["ModelId"], identity["TileId"]) == (0x012345, 0)
    assert (car["AgentMode"], car["TrackId"], car["ObjectId"]) == ("PARTIAL", 1, 17)
    assert (car["ObjectIndex"], car["Age"]) == (0, 50)
    assert [point["PointIndex"] for point in points] == [1, 2, 3]
    assert [point["X"] for point in points] == pytest.approx([30.0, 40.0, 50.0])
    assert [point["Y"] for point in points] == pytest.approx([0.0, 0.0, 0.0])
    assert {point["Probability"] for point in points} == {75.0}


def test_every_object_is_decoded_to_within_half_a_step(fd: Wire) -> None:
    forecasts = nearest_first(many(32))
    assert forecasts.map_from_ego is not None
    ego_from_map = forecasts.map_from_ego.inverse()
    expected = ego_from_map.apply(forecasts.trajectories[:, 0, 2::3])
    _, *decoded = fd.decoded(forecasts)
    cars = [values for _, values in decoded]
    assert [car["ObjectIndex"] for car in cars] == list(range(32))
    np.testing.assert_allclose(points_of(cars), expected, atol=0.01 + 1e-9)
    position = np.array([[car["PositionX"], car["PositionY"]] for car in cars])
    np.testing.assert_allclose(position, ego_from_map.apply(forecasts.position), atol=0.01 + 1e-9)
    velocity = np.array([[car["VelocityX"], car["VelocityY"]] for car in cars])
    np.testing.assert_allclose(velocity, ego_from_map.rotate(forecasts.velocity), atol=0.005 + 1e-9)
    probability = 0.01 * np.array([car["Probability"] for car in cars])
    np.testing.assert_allclose(probability, forecasts.probabilities[:, 0], atol=0.0025 + 1e-9)
    age_s = 1e-3 * np.array([car["Age"] for car in cars])
    np.testing.assert_allclose(age_s, forecasts.age_s, atol=0.0005 + 1e-9)


def points_of(cars: list[dict[str, Any]]) -> NDArray[np.float64]:
    """(A, 10, 2)"""
    return np.array([[[car[f"X{i}"], car[f"Y{i}"]] for i in range(1, 11)] for car in cars])


@pytest.mark.parametrize("is_fd", [True, False])
def test_cantools_packs_the_same_bytes(is_fd: bool, database: Database) -> None:
    """What cantools reads, it writes back as it was: no bit lies outside the signals."""
    wire = Wire(database, fd=is_fd, num_modes=3)
    messages = wire.messages(many(20))
    assert len(messages) == (1 + 20 * 3 if is_fd else 2 + 20 * 4)
    for message in messages:
        definition = database.get_message_by_frame_id(message.arbitration_id)
        values = definition.decode(bytes(message.data), scaling=False, decode_choices=False)
        assert isinstance(values, dict)
        assert definition.encode(values, scaling=False) == bytes(message.data)
    wire.close()


def test_more_modes_come_best_first(database: Database) -> None:
    """Of two modes that exist, two come, though three were asked for."""
    wire = Wire(database, num_modes=3)
    (_, status), *cars = wire.decoded(one_car())
    assert (status["NumObjects"], status["NumModes"]) == (1, 2)
    assert [(car["ModeIndex"], car["Probability"]) for _, car in cars] == [(0, 75.0), (1, 25.0)]
    assert cars[1][1]["X10"] == pytest.approx(20.0)  # it stays
    wire.close()


def test_what_is_not_known_is_marked_not_available(fd: Wire) -> None:
    """A horizon of 2 s instead of 3, a point beyond 655.34 m, no id of the sensor."""
    forecasts = one_car()
    trajectories = forecasts.trajectories[:, :, :20].copy()
    trajectories[0, 0, 1] = (100.0, 1200.0)
    forecasts = replace(
        forecasts,
        trajectories=trajectories,
        object_id=np.array([-1]),
    )
    _, (_, car) = fd.decoded(forecasts)
    assert car["PointStep"] == 200
    assert car["ObjectId"] == NOT_AVAILABLE
    assert car["X1"] == NOT_AVAILABLE
    assert car["Y1"] == 0.0
    assert car["X10"] == pytest.approx(40.0)


def test_without_a_velocity_there_are_no_points(fd: Wire, classic: Wire) -> None:
    """It would be sent as standing; where it is, is known."""
    unknown = replace(one_car(), velocity=np.full((1, 2), np.nan))
    _, (_, car) = fd.decoded(unknown)
    assert {car[f"{axis}{i}"] for axis in "XY" for i in range(1, 11)} == {NOT_AVAILABLE}
    assert car["VelocityX"] == car["VelocityY"] == NOT_AVAILABLE
    assert car["PositionX"] == pytest.approx(20.0)
    points = [values for name, values in classic.decoded(unknown) if "Point" in name]
    assert {point[axis] for point in points for axis in "XY"} == {NOT_AVAILABLE}
    _, (_, car) = fd.decoded(one_car())
    assert car["X10"] == pytest.approx(50.0)


def test_where_the_ego_vehicle_is_not_known_so_is_all_that_is_seen_from_it(
    fd: Wire, classic: Wire
) -> None:
    """Its pose, and whatever somebody wants to be sent from there."""
    (_, status), (_, car) = fd.decoded(replace(one_car(), map_from_ego=None))
    assert {status[name] for name in ("EgoX", "EgoY", "EgoYaw")} == {NOT_AVAILABLE}
    places = {f"{name}{axis}" for name in ("Position", "Velocity") for axis in "XY"}
    places |= {f"{axis}{i}" for i in range(1, 11) for axis in "XY"}
    assert {car[place] for place in places} == {NOT_AVAILABLE}
    points = [v for name, v in classic.decoded(replace(one_car(), map_from_ego=None)) if "X" in v]
    assert [point["X"] for point in points] == [NOT_AVAILABLE] * 3


def test_old_input_is_as_old_as_can_be_said(fd: Wire) -> None:
    """An age of two minutes does not wrap around to a young one."""
    (_, status), (_, car) = fd.decoded(replace(one_car(), made_s=1120.0))
    assert (status["InputAge"], car["Age"]) == (65_534, 65_534)


@pytest.mark.parametrize("is_fd", [True, False])
def test_silence_is_said_without_objects(is_fd: bool, database: Database) -> None:
    wire = Wire(database, fd=is_fd)
    (_, status), *rest = wire.decoded(nobody(Mode.SILENT))
    assert (status["Mode"], status["NumObjects"]) == ("SILENT", 0)
    assert [name for name, _ in rest] == ([] if is_fd else ["EQRT_IdentityClassic"])
    wire.close()


@pytest.mark.parametrize(("is_fd", "wrap"), [(True, 256), (False, 16)])
def test_alive_counters_count_every_message_of_an_id(
    is_fd: bool, wrap: int, database: Database
) -> None:
    wire = Wire(database, fd=is_fd)
    counters: dict[str, list[int]] = {}
    for _ in range(12):
        for name, values in wire.decoded(many(25)):
            counters.setdefault(name, []).append(values["AliveCounter"])
    for name, counts in counters.items():
        assert counts == [count % wrap for count in range(len(counts))], name
    assert max(map(len, counters.values())) >= 300
    wire.close()


@pytest.mark.parametrize("base_id", [0x6E0, 0x7FA, 0x18FFFFFE])
@pytest.mark.parametrize("is_fd", [True, False])
def test_a_consumer_with_autosar_e2e_accepts_every_message(
    is_fd: bool, base_id: int, database: Database
) -> None:
    """Its own implementation, configured as docs/output.md says; the counters wrap."""
    wire = Wire(database, fd=is_fd, base_id=base_id, num_modes=2)
    messages = [one for count in (0, 1, 32, 300) for one in wire.messages(many(count))]
    messages += wire.messages(nobody(Mode.SILENT))
    assert len(messages) > 512
    for message in messages:
        arbitration_id = message.arbitration_id
        if is_fd:
            assert p05.e2e_p05_check(message.data, arbitration_id & 0xFFFF)
            assert not p05.e2e_p05_check(message.data, (arbitration_id + 1) & 0xFFFF)
        else:
            data_ids = bytes((arbitration_id + 16 * counter) & 0xFF for counter in range(16))
            assert p02.e2e_p02_check(message.data, data_ids)
            assert not p02.e2e_p02_check(message.data, bytes(15 ^ one for one in data_ids))
    wire.close()


@pytest.mark.parametrize("is_fd", [True, False])
def test_our_own_checker_follows_every_message(is_fd: bool, database: Database) -> None:
    wire = Wire(database, fd=is_fd)
    checkers: dict[int, Checker] = {}
    for _ in range(10):
        for message in wire.messages(many(40)):
            one = message.arbitration_id
            protection: Protection = (
                Profile5(data_id=data_id_of(one)) if is_fd else Profile2(data_ids=data_ids_of(one))
            )
            checker = checkers.setdefault(one, Checker(protection))
            assert checker.check(message.data) is Status.OK
    assert len(checkers) == (2 if is_fd else 4)
    wire.close()


@pytest.mark.parametrize("base_id", [0x100, 0x7FA, 0x18FF0000])
def test_all_ids_move_with_the_base(base_id: int, database: Database) -> None:
    wire = Wire(database, base_id=base_id)
    status, car = wire.messages(one_car())
    assert (status.arbitration_id, car.arbitration_id) == (base_id, base_id + 1)
    assert status.is_extended_id == car.is_extended_id == (base_id > 0x7FF)
    wire.close()


@pytest.mark.parametrize("base_id", [-1, 0x7FB, 0x1FFFFFFB])
def test_ids_that_do_not_fit_are_refused(base_id: int) -> None:
    with (
        open_bus(next(CHANNELS), "virtual") as bus,
        pytest.raises(UsageError, match="first CAN id"),
    ):
        CanPublisher(Outbox(bus), base_id=base_id)


def test_a_bus_that_takes_nothing_is_counted_and_not_raised(database: Database) -> None:
    wire = Wire(database)
    """It is given up when the next cycle comes."""
    wire.publisher.publish(one_car())
    wire.close()
    wire.publisher.publish(one_car())
    assert (wire.publisher.sent, wire.publisher.failed) == (2, 0)
    wire.publisher.publish(one_car())
    assert (wire.publisher.sent, wire.publisher.failed) == (2, 2)


@pytest.mark.parametrize("is_fd", [True, False])
def test_the_nearest_object_goes_first_with_all_that_is_said_of_it(
    is_fd: bool, database: Database
) -> None:
    """Cycle, then object by object: ObjectIndex 0 is the nearest."""
    wire = Wire(database, fd=is_fd, num_modes=2)
    forecasts = many(20)
    decoded = wire.decoded(forecasts)
    wire.close()
    of_the_cycle, each = (1, 2) if is_fd else (2, 4)
    indices = [values.get("ObjectIndex", -1) for _, values in decoded]
    assert indices == [-1] * of_the_cycle + [i for i in range(20) for _ in range(each)]
    if is_fd:
        far_m = [np.hypot(car["PositionX"], car["PositionY"]) for _, car in decoded[1:]]
        assert far_m == sorted(far_m)
    else:
        kinds = [name for name, _ in decoded[2:]]
        assert kinds == ["EQRT_ObjectClassic", *["EQRT_PointClassic"] * 3] * 20
    (nearest,) = {
        int(v["TrackId"]) for _, v in decoded if v.get("ObjectIndex") == 0 if "TrackId" in v
    }
    ego = forecasts.map_from_ego
    assert ego is not None
    away_m = np.linalg.norm(forecasts.position - (ego.x_m, ego.y_m), axis=1)
    assert nearest == forecasts.track_id[np.argmin(away_m)]


class NarrowBus:
    """Has room for some messages, as a network interface has; who reads makes room again."""

    def __init__(self, room: int, *, fd: bool) -> None:
        self.protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self.room = room
        self.taken: list[can.Message] = []

    def send(self, msg: can.Message) -> None:
        if len(self.taken) >= self.room:
            raise OSError(errno.ENOBUFS, "No buffer space available")
        self.taken.append(msg)

    def read(self) -> list[can.Message]:
        read, self.taken = self.taken, []
        return read


@pytest.mark.parametrize("is_fd", [True, False])
def test_what_a_full_bus_refuses_is_sent_when_there_is_room(is_fd: bool) -> None:
    """In order, none twice, by whoever asks now and then; never before it is time."""
    bus, wide = NarrowBus(10, fd=is_fd), NarrowBus(1000, fd=is_fd)
    outbox = Outbox(bus)
    CanPublisher(Outbox(wide)).publish(many(32))
    CanPublisher(outbox).publish(many(32))
    heard = bus.read()
    assert len(heard) == 10
    begun_s = now_s = time.monotonic()
    while (left_s := outbox.push(now_s)) < np.inf:
        assert 0.0 < left_s <= AGAIN_S + 1e-6
        heard += bus.read()
        now_s += left_s
    heard += bus.read()
    assert now_s - begun_s == pytest.approx(AGAIN_S * (len(heard) // 10), rel=0.5)
    assert [bytes(one.data) for one in heard] == [bytes(one.data) for one in wide.read()]
    assert (outbox.sent, outbox.failed) == (len(heard), 0)


@pytest.mark.parametrize("is_fd", [True, False])
def test_a_bus_too_slow_for_all_loses_the_farthest_objects_only(is_fd: bool) -> None:
    """And a receiver that checks every counter accepts all that comes, cycle after cycle."""
    bus = NarrowBus(21, fd=is_fd)
    publisher = CanPublisher(Outbox(bus))
    checkers: dict[int, Checker] = {}
    for cycle in range(40):
        publisher.publish(replace(many(32), cycle=cycle))
        messages = bus.read()
        if is_fd:
            assert [one.data[4] for one in messages[1:]] == list(range(20))
        else:
            assert [one.data[2] for one in messages[2:]] == [i // 4 for i in range(19)]
        for message in messages:
            one = message.arbitration_id
            protection: Protection = (
                Profile5(data_id=data_id_of(one)) if is_fd else Profile2(data_ids=data_ids_of(one))
            )
            checker = checkers.setdefault(one, Checker(protection, max_delta=1))
            assert checker.check(message.data) is Status.OK
    per_cycle = 33 if is_fd else 130
    assert (publisher.sent, publisher.failed) == (40 * 21, 39 * (per_cycle - 21))


def test_more_objects_than_can_be_counted_are_left_out(fd: Wire) -> None:
    (_, status), *cars = fd.decoded(many(300))
    assert (status["NumObjects"], len(cars)) == (255, 255)


def test_the_dbc_says_what_the_code_says(database: Database) -> None:
    """Ids, lengths and the names of the modes."""
    ids = {message.frame_id for message in database.messages}
    assert ids == {BASE_ID + offset for offset in Offset}
    layouts = (
        can_output.STATUS,
        can_output.TRAJECTORY,
        can_output.STATUS_CLASSIC,
        can_output.IDENTITY_CLASSIC,
        can_output.OBJECT_CLASSIC,
        can_output.POINT_CLASSIC,
    )
    assert [message.length for message in database.messages] == [i.itemsize for i in layouts]
    names = {mode.value: mode.name for mode in Mode}
    for message in database.messages:
        for signal in message.signals:
            if signal.name in ("Mode", "AgentMode"):
                assert signal.choices is not None
                assert {k: str(v) for k, v in signal.choices.items()} == names


def test_every_signal_of_the_dbc_is_explained(database: Database) -> None:
    """Except the points, which their message explains."""
    for message in database.messages:
        assert message.comment
        for signal in message.signals:
            is_point = signal.name[0] in "XY" and signal.name not in ("EgoX", "EgoY")
            assert signal.comment or is_point, f"{message.name}.{signal.name}"


def test_a_turned_ego_frame_turns_what_is_sent(fd: Wire) -> None:
    """Facing east, the car to the north is to the left."""
    forecasts = replace(one_car(), map_from_ego=Pose2(100.0, 200.0, 0.0))
    _, (_, car) = fd.decoded(forecasts)
    assert (car["PositionX"], car["PositionY"]) == pytest.approx((0.0, 20.0))
    assert (car["VelocityX"], car["VelocityY"]) == pytest.approx((0.0, 10.0))
    assert (car["X10"], car["Y10"]) == pytest.approx((0.0, 50.0))


@pytest.mark.parametrize("is_fd", [True, False])
def test_32_objects_are_encoded_within_the_budget(is_fd: bool, benchmark: Any) -> None:
    forecasts = many(32)

    def encode() -> None:
        for offset, rows in encode_fd(forecasts, 1) if is_fd else encode_classic(forecasts):
            protect(rows, BASE_ID + offset, 0)

    benchmark.pedantic(encode, rounds=500, warmup_rounds=20)
    if benchmark.enabled:
        assert np.quantile(benchmark.stats.stats.data, 0.99) < ENCODING_BUDGET_S


@pytest.mark.parametrize("is_fd", [True, False])
def test_the_checks_of_32_objects_are_computed_within_the_budget(
    is_fd: bool, benchmark: Any
) -> None:
    messages = encode_fd(many(32), 1) if is_fd else encode_classic(many(32))

    def protect_all() -> None:
        for offset, rows in messages:
            protect(rows, BASE_ID + offset, 0)

    benchmark.pedantic(protect_all, rounds=500, warmup_rounds=20)
    if benchmark.enabled:
        assert np.quantile(benchmark.stats.stats.data, 0.99) < PROTECTION_BUDGET_S


def test_the_bases_whose_data_ids_clash_are_those_that_the_documentation_names() -> None:
    """Of two services on one bus; ids that are the same are another matter."""

    def clash(base: int, other: int) -> tuple[bool, bool]:
        """On classic CAN, on CAN FD."""
        fd, classic = [Offset.STATUS, Offset.TRAJECTORY], [o for o in Offset if o >= 2]
        twos = [[data_ids_of(one + offset) for offset in classic] for one in (base, other)]
        fives = [{data_id_of(one + offset) for offset in fd} for one in (base, other)]
        pairs = itertools.product(*twos)
        return any(any(map(eq, *pair)) for pair in pairs), bool(fives[0] & fives[1])

    for apart in (*range(6, 0x300), *range(0xFFF0, 0x10010)):
        expected = (min(apart % 0x100, -apart % 0x100) <= 3, min(apart, abs(apart - 0x10000)) <= 1)
        assert clash(BASE_ID, BASE_ID + apart) == expected, hex(apart)
