"""The generic object list: what is encoded comes back, within the resolution of its DBC."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import cantools.database
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from eqrt.core.frames import Pose2, wrap_angle
from eqrt.runtime.decoding import generic_objects
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import (
    Detections,
    EgoMotion,
    EgoPose,
    ObjectClass,
    VelocityKind,
)
from eqrt.runtime.decoding.generic_objects import encode_cycle
from eqrt.runtime.decoding.profile import load_profile

Float64 = NDArray[np.float64]

NAN = math.nan
DBC = Path(generic_objects.__file__).parent / "dbc" / "eqrt_objects.dbc"
PROFILE = load_profile("generic")
HALF = 0.5 + 1e-9  # of a step, with room for float rounding


def objects_of(seed: int, count: int) -> Detections:
    """Random objects inside the ranges of the DBC; some of what may be unknown is."""
    rng = np.random.default_rng(seed)

    def some(low: float, high: float, *more: int) -> Float64:
        values = rng.uniform(low, high, (count, *more))
        return np.where(rng.random(values.shape) < 0.8, values, NAN)

    return Detections(
        sensor="any",
        timestamp_s=0.0,
        received_s=0.0,
        complete=True,
        object_id=rng.permutation(256)[:count],
        is_new=rng.random(count) < 0.5,
        position=rng.uniform(-327, 327, (count, 2)),
        velocity=some(-81.9, 81.9, 2),
        velocity_kind=VelocityKind.ABSOLUTE,
        heading_rad=some(-math.pi, math.pi),
        length_m=some(0, 25.4),
        width_m=some(0, 12.7),
        object_class=rng.integers(0, 8, count).astype(np.uint8),
        existence=some(0, 1),
    )


def generic_dbc() -> Any:
    """As another stack would load it."""
    return cantools.database.load_file(DBC)


def decode(messages: list[can.Message], at_s: float = 100.0) -> list[Event]:
    decoder = Decoder(PROFILE)
    return [event for one in messages for event in decoder.feed(one, at_s)]


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 255))
def test_objects_come_back_within_half_a_step(seed: int, count: int) -> None:
    objects = objects_of(seed, count)
    (back,) = decode(encode_cycle(objects, timestamp_s=0.0, counter=seed, age_s=0.025))
    assert isinstance(back, Detections)
    assert back.complete
    assert (back.timestamp_s, back.received_s) == (100.0 - 0.025, 100.0)
    assert back.velocity_kind is VelocityKind.ABSOLUTE
    np.testing.assert_array_equal(back.object_id, objects.object_id)
    np.testing.assert_array_equal(back.is_new, objects.is_new)
    np.testing.assert_array_equal(back.object_class, objects.object_class)
    for name, step in (
        ("position", 0.01),
        ("velocity", 0.01),
        ("heading_rad", 0.002),
        ("length_m", 0.1),
        ("width_m", 0.05),
        ("existence", 0.01),
    ):
        np.testing.assert_allclose(
            getattr(back, name), getattr(objects, name), rtol=0, atol=HALF * step, err_msg=name
        )


@given(
    speed=st.floats(-300, 300) | st.none(),
    yaw_rate=st.floats(-3, 3) | st.none(),
    x=st.floats(-2e6, 2e6),
    yaw=st.floats(-100, 100),
)
def test_ego_motion_and_pose_come_back(
    speed: float | None, yaw_rate: float | None, x: float, yaw: float
) -> None:
    *motions, pose = decode(
        encode_cycle(
            timestamp_s=0.0,
            speed_mps=speed,
            yaw_rate_rad_s=yaw_rate,
            map_from_ego=Pose2(x, -x, yaw),
            age_s=0.5,
        )
    )
    assert len(motions) == (speed is not None or yaw_rate is not None)
    for motion in motions:
        assert isinstance(motion, EgoMotion)
        assert motion.timestamp_s == 99.5
        for back, value, step in (
            (motion.speed_mps, speed, 0.01),
            (motion.yaw_rate_rad_s, yaw_rate, 0.0001),
        ):
            assert back == (None if value is None else pytest.approx(value, abs=HALF * step))
    assert isinstance(pose, EgoPose)
    assert pose.timestamp_s == 99.5
    assert pose.map_from_ego.x_m == pytest.approx(x, abs=HALF * 0.001)
    assert pose.map_from_ego.y_m == pytest.approx(-x, abs=HALF * 0.001)
    assert abs(wrap_angle(pose.map_from_ego.yaw_rad - yaw)) < 1e-7


def test_ego_motion_and_pose_go_before_the_objects() -> None:
    """So that whoever gets the objects already knows where they are."""
    messages = encode_cycle(
        objects_of(0, 2), timestamp_s=3.0, speed_mps=1.0, map_from_ego=Pose2(), channel="vcan0"
    )
    ids = [message.arbitration_id for message in messages]
    assert ids == [0x5A0, 0x5A1, 0x5A2, 0x5A3, 0x5A4, 0x5A4, 0x5A5, 0x5A5]
    assert {message.channel for message in messages} == {"vcan0"}
    assert {message.timestamp for message in messages} == {3.0}
    assert not any(message.is_fd or message.is_extended_id for message in messages)
    assert [type(event).__name__ for event in decode(messages)] == [
        "EgoMotion",
        "EgoPose",
        "Detections",
    ]


def test_messages_are_those_that_cantools_makes_of_the_dbc() -> None:
    """A stack that encodes with cantools, or generated C, writes the same bytes."""
    objects = objects_of(1, 3)
    for message in encode_cycle(objects, timestamp_s=0.0, speed_mps=NAN, map_from_ego=Pose2(1, 2)):
        definition = generic_dbc().get_message_by_frame_id(message.arbitration_id)
        values = definition.decode(bytes(message.data), decode_choices=False)
        assert definition.encode(values, strict=False) == message.data
        assert definition.length == len(message.data)


def test_what_is_out_of_range_takes_the_nearest_value() -> None:
    objects = objects_of(2, 2)
    objects.position[:] = [[1e6, -1e6], [400.0, 0.0]]
    objects.velocity[:] = [[1e6, -1e6], [90.0, 0.0]]
    objects.length_m[:] = 40.0
    (back,) = decode(encode_cycle(objects, timestamp_s=0.0))
    assert isinstance(back, Detections)
    np.testing.assert_allclose(back.position, [[327.67, -327.68], [327.67, 0.0]])
    np.testing.assert_allclose(back.velocity, [[81.91, -81.91], [81.91, 0.0]])
    np.testing.assert_allclose(back.length_m, 25.4)


def test_an_object_without_a_place_is_left_out() -> None:
    objects = objects_of(3, 3)
    objects.position[1, 0] = NAN
    (back,) = decode(encode_cycle(objects, timestamp_s=0.0))
    assert isinstance(back, Detections)
    assert back.complete
    assert back.object_id.tolist() == objects.object_id[[0, 2]].tolist()


def test_the_block_of_ids_can_be_moved() -> None:
    messages = encode_cycle(objects_of(4, 1), timestamp_s=0.0, arbitration_id_offset=-0x100)
    assert [message.arbitration_id for message in messages] == [0x4A3, 0x4A4, 0x4A5]


def test_a_pose_whose_first_half_is_old_is_not_told() -> None:
    decoder = Decoder(PROFILE)
    position, yaw = encode_cycle(timestamp_s=0.0, map_from_ego=Pose2(1.0, 2.0, 3.0))
    assert decoder.feed(position, 10.0) == []
    assert decoder.feed(yaw, 10.03) == []
    decoder.feed(position, 10.2)
    assert len(decoder.feed(yaw, 10.21)) == 1


def test_a_pose_of_no_quality_is_not_told() -> None:
    position, yaw = encode_cycle(timestamp_s=0.0, map_from_ego=Pose2())
    yaw.data[4] = 0
    assert decode([position, yaw]) == []


@pytest.mark.parametrize("kind", [VelocityKind.RELATIVE, VelocityKind.RADIAL])
def test_velocities_that_are_not_over_ground_are_refused(kind: VelocityKind) -> None:
    objects = objects_of(5, 1)
    other = replace(objects, velocity_kind=kind)
    with pytest.raises(ValueError, match=f"velocities are {kind.name}"):
        encode_cycle(other, timestamp_s=0.0)


@given(arrays(np.int64, st.integers(1, 300), elements=st.integers(-1000, 1000)))
def test_ids_that_do_not_fit_are_refused(ids: NDArray[np.int64]) -> None:
    objects = objects_of(6, len(ids))
    other = replace(objects, object_id=ids)
    if len(ids) <= 255 and 0 <= ids.min() <= ids.max() <= 255:
        assert len(encode_cycle(other, timestamp_s=0.0)) == 1 + 2 * len(ids)
    else:
        with pytest.raises(ValueError, match="object"):
            encode_cycle(other, timestamp_s=0.0)


def test_object_classes_have_the_same_numbers_everywhere() -> None:
    choices = (
        generic_dbc().get_message_by_name("OBJECT_POSITION").get_signal_by_name("CLASS").choices
    )
    assert choices is not None
    assert {number: str(name) for number, name in choices.items()} == {
        kind.value: kind.name.lower() for kind in ObjectClass
    }
