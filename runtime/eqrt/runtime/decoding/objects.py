"""A closed cycle of messages to detections: one vectorised decode per part, then the fields.

Axes: S rows of a part, M messages of a part, D objects.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.decoding.bound_fields import BoundField, Reference
from eqrt.runtime.decoding.cycles import Cycle
from eqrt.runtime.decoding.dbc_tables import Payload
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.decoding.detections import Detections, ObjectClass, VelocityKind
from eqrt.runtime.decoding.sensor_profile import Lookup, SensorProfile

Float64 = NDArray[np.float64]

_NAN = float("nan")


class ObjectDecoder:
    """Decodes the cycles of one sensor."""

    def __init__(self, sensor: SensorProfile, counters: DecoderCounters) -> None:
        self._counters = counters
        self._sensor = sensor
        self._fields = sensor.fields
        self._last_counter = _NAN
        self._begin()
        packed = np.arange(sensor.objects_per_message)
        slots = np.array(sensor.slots, np.float64)
        self._slot_ids = (slots[:, None] * len(packed) + packed).ravel()

    def decode(self, cycle: Cycle) -> Detections:
        """The valid objects of a cycle."""
        self._begin()
        with np.errstate(all="ignore"):  # a sensor may send numbers that no arithmetic survives
            detections = self._decode(cycle)
        if not self._has_counter and cycle.num_wrong:
            self.forget_counter()
        return detections

    def is_right(self, cycle: Cycle) -> bool:
        """Whether the cycle decoded last is: its counter follows, most messages belong to it."""
        return self._follows and cycle.is_right(self._num_foreign)

    def forget_counter(self) -> None:
        """Any counter may come next: the last one could not be read, or is long ago."""
        self._last_counter = _NAN

    def _begin(self) -> None:
        self._follows, self._has_counter, self._num_foreign = True, False, 0

    def _decode(self, cycle: Cycle) -> Detections:
        counter, age_s = self._header(cycle.header)
        values = self._values(cycle, counter)
        position = self._position(values)
        object_id = self._object_id(values)
        valid = np.isfinite(position).all(axis=1) & np.isfinite(object_id)
        if cycle.count is not None:
            valid[cycle.count :] = False
        if self._fields.valid is not None:
            valid &= self._fields.valid.holds(values)
        keep = _last_of_each(object_id, np.flatnonzero(valid))
        if len(keep) < len(valid):
            self._counters.invalid_objects += len(valid) - len(keep)
            values = [part[:, keep] for part in values]
            position, object_id = position[keep], object_id[keep]
        return self._detections(cycle, values, position, object_id, age_s)

    def _detections(
        self,
        cycle: Cycle,
        values: Sequence[Float64],
        position: Float64,
        object_id: Float64,
        age_s: float,
    ) -> Detections:
        sensor, fields = self._sensor, self._fields
        absent = np.full(len(position), _NAN)
        numbers = {key: field.array(values) for key, field in fields.numbers.items()}
        object_class = np.full(len(position), ObjectClass.UNKNOWN, np.uint8)
        if fields.object_class is not None:
            object_class = _looked_up(fields.object_class, values).astype(np.uint8)
        is_new = np.zeros(len(position), np.bool_)
        if fields.new_track is not None:
            is_new = fields.new_track.holds(values)
        return Detections(
            sensor=sensor.name,
            timestamp_s=cycle.first_s - sensor.latency_s - age_s,
            received_s=cycle.last_s,
            complete=cycle.complete,
            object_id=object_id.astype(np.int64) + sensor.object_id_offset,
            is_new=is_new,
            position=position,
            velocity=self._velocity(numbers, position),
            velocity_kind=sensor.velocity_kind,
            heading_rad=numbers.get("heading", absent),
            length_m=numbers.get("length", absent),
            width_m=numbers.get("width", absent),
            object_class=object_class,
            existence=_existence(fields.existence, values, absent),
        )

    def _header(self, data: Payload | None) -> tuple[float, float]:
        """(counter, age in seconds) of a cycle; NaN and 0 where its header does not say."""
        header = self._sensor.header
        if header is None or data is None:
            return _NAN, 0.0
        values = [[column.read(data) for column in header.columns]]
        age_s = header.age.number(values) if header.age is not None else 0.0
        counter = _NAN
        if header.counter is not None:
            counter = values[0][header.counter.column.row]
            if not math.isnan(counter):
                self._check_step(counter, header.counter.modulus, header.counter_steps)
        return counter, age_s if age_s > 0.0 else 0.0

    def _check_step(self, counter: float, modulus: int, steps: Sequence[int]) -> None:
        last, self._last_counter, self._has_counter = self._last_counter, counter, True
        expected = [(last + step) % modulus for step in steps]
        if not math.isnan(last) and counter not in expected:
            self._counters.bad_counter += 1
            self._follows = False

    def _values(self, cycle: Cycle, counter: float) -> list[Float64]:
        """By part, (S, D)."""
        decoded = [
            self._part_values(i, payloads, counter) for i, payloads in enumerate(cycle.payloads)
        ]
        first, *others = self._sensor.parts
        if first.object_id is None:
            return decoded
        wanted = decoded[0][first.object_id.row]
        joined = [
            values if part.object_id is None else _joined(values, part.object_id, wanted)
            for part, values in zip(others, decoded[1:], strict=True)
        ]
        return [decoded[0], *joined]

    def _part_values(self, index: int, payloads: Sequence[Payload], counter: float) -> Float64:
        """(S, objects in the messages); NaN throughout for a message of another cycle."""
        part, packed = self._sensor.parts[index], self._sensor.objects_per_message
        values = part.table.decode(payloads)  # (S * packed, M)
        if packed > 1:
            shape = (len(values) // packed, packed, len(payloads))
            values = values.reshape(shape).transpose(0, 2, 1).reshape(shape[0], -1)
        if part.counter is not None:
            seen = values[part.counter.column.row]
            if math.isnan(counter):
                counter = self._counter_without_header(index, seen, part.counter.modulus)
            other = (seen != counter % part.counter.modulus) & ~np.isnan(seen)
            if other.any():
                num_foreign = math.ceil(other.sum() / packed)  # a message may be cut short
                self._counters.bad_counter += num_foreign
                self._num_foreign += num_foreign
                values[:, other] = _NAN
        return values

    def _counter_without_header(self, index: int, seen: Float64, modulus: int) -> float:
        """What a cycle goes by whose header has no counter: that of its first message."""
        there = seen[~np.isnan(seen)]
        counter = float(there[0]) if len(there) else _NAN
        if index == 0 and len(there):
            self._check_step(counter, modulus, (1,))
        return counter

    def _object_id(self, values: Sequence[Float64]) -> Float64:
        column = self._fields.object_id
        return self._slot_ids if column is None else values[column.part][column.row]

    def _position(self, values: Sequence[Float64]) -> Float64:
        """(D, 2) metres in the sensor frame."""
        numbers = self._fields.numbers
        if "x" in numbers:
            x, y = numbers["x"].array(values), numbers["y"].array(values)
        else:
            distance, azimuth = numbers["range"].array(values), numbers["azimuth"].array(values)
            x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
        position = np.empty((len(x), 2))
        position[:, 0], position[:, 1] = x, y
        return position

    def _velocity(self, numbers: dict[str, Float64], position: Float64) -> Float64:
        """(D, 2) m/s in the sensor frame."""
        velocity = np.full(position.shape, _NAN)
        if self._sensor.velocity_kind is VelocityKind.RADIAL:
            distance = np.hypot(position[:, 0], position[:, 1])
            return position * (numbers["range_rate"] / distance)[:, None]  # NaN at the sensor
        for axis, key in enumerate(("velocity_x", "velocity_y")):
            if key in numbers:
                velocity[:, axis] = numbers[key]
        return velocity


def _joined(values: Float64, object_id: Reference, wanted: Float64) -> Float64:
    """(S, D): the columns of `values` in the order of the ids `wanted`, NaN where there is none."""
    ids = values[object_id.row]
    if len(ids) == len(wanted) and (ids == wanted).all():
        return values
    order = np.argsort(ids, kind="stable")
    # The last of several messages with the same id; -1 where all ids are higher.
    place = np.searchsorted(ids, wanted, side="right", sorter=order) - 1
    found = place >= 0
    found[found] = ids[order[place[found]]] == wanted[found]
    joined = np.full((len(values), len(wanted)), _NAN)
    joined[:, found] = values[:, order[place[found]]]
    return joined


def _last_of_each(object_id: Float64, valid: NDArray[np.intp]) -> NDArray[np.intp]:
    """Of the indices `valid`, the last one for every id."""
    ids = object_id[valid].tolist()
    if len(set(ids)) == len(ids):
        return valid
    last = dict(zip(ids, valid.tolist(), strict=True))
    return np.array(sorted(last.values()), np.intp)


def _looked_up(lookup: Lookup, values: Sequence[Float64]) -> Float64:
    raw = values[lookup.column.part][lookup.column.row]
    return lookup.table[np.where(np.isnan(raw), len(lookup.table) - 1, raw).astype(np.intp)]


def _existence(
    source: BoundField | Lookup | None, values: Sequence[Float64], absent: Float64
) -> Float64:
    if source is None:
        return absent
    return _looked_up(source, values) if isinstance(source, Lookup) else source.array(values)
