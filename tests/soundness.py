"""What must be true of whatever the decoder gives, however bad its input was."""

from __future__ import annotations

import math

import numpy as np

from can_recordings import detections_of
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import Detections, EgoMotion


def assert_sound(decoder: Decoder, events: list[Event]) -> None:
    """Counters add up, and nothing that came out is half a number."""
    counters = decoder.counters
    assert counters.messages == (
        counters.used + counters.other_id + counters.wrong_bus + counters.not_data
    )
    cycles = detections_of(events)
    assert counters.objects == sum(len(cycle.object_id) for cycle in cycles)
    for cycle in cycles:
        assert_consistent(cycle)
    for event in events:
        if isinstance(event, EgoMotion):
            for value in (event.speed_mps, event.yaw_rate_rad_s):
                assert value is None or math.isfinite(value)


def assert_consistent(cycle: Detections) -> None:
    """One value of everything per object, and every object somewhere."""
    count = len(cycle.object_id)
    assert cycle.position.shape == cycle.velocity.shape == (count, 2)
    assert np.isfinite(cycle.position).all()
    assert len(np.unique(cycle.object_id)) == count
    for values in (
        cycle.is_new,
        cycle.heading_rad,
        cycle.length_m,
        cycle.width_m,
        cycle.object_class,
        cycle.existence,
    ):
        assert values.shape == (count,)
    assert cycle.object_id.dtype == np.int64
    assert cycle.is_new.dtype == np.bool_
    assert cycle.object_class.dtype == np.uint8
