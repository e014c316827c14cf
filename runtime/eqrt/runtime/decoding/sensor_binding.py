"""A `[[sensor]]` of a profile, bound to its DBC."""

from __future__ import annotations

import math

import numpy as np

from eqrt.core.errors import ProfileError
from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.addresses import address_of
from eqrt.runtime.decoding.bindings import Binder, fill, span
from eqrt.runtime.decoding.bound_fields import BoundCondition, BoundField, Reference
from eqrt.runtime.decoding.dbc_files import Dbc, DbcMessage
from eqrt.runtime.decoding.dbc_tables import SignalTable
from eqrt.runtime.decoding.detections import ObjectClass, VelocityKind
from eqrt.runtime.decoding.profile_schema import (
    CounterTable,
    ExistenceTable,
    PartTable,
    SensorTable,
)
from eqrt.runtime.decoding.sensor_checks import SLOT_ID, check_sensor, silence_of
from eqrt.runtime.decoding.sensor_profile import (
    Counter,
    Header,
    Lookup,
    ObjectFields,
    Part,
    SensorProfile,
)

_MEASURES = {
    "x": "length",
    "y": "length",
    "range": "length",
    "azimuth": "angle",
    "velocity_x": "speed",
    "velocity_y": "speed",
    "range_rate": "speed",
    "heading": "angle",
    "length": "length",
    "width": "length",
}
_MAX_TABLE_BITS = 16
_MAX_ID_BITS = 53  # what a float64 holds exactly


def bind_sensor(table: SensorTable, dbc: Dbc, id_offset: int, where: str) -> SensorProfile:
    """Raises ProfileError, led by `where`, if the table makes no sense or the DBC lacks a name."""
    check_sensor(table, where)
    return _Sensor(table, dbc, id_offset + table.arbitration_id_offset, where).profile()


class _Sensor:
    """One sensor while it is being bound."""

    def __init__(self, table: SensorTable, dbc: Dbc, id_offset: int, where: str) -> None:
        self.table, self.dbc, self.id_offset, self.where = table, dbc, id_offset, where
        self.slots = span(table.slots, f"{where}.slots")
        self.objects = span(table.objects, f"{where}.objects")
        self.parts = {
            name: PartTable(message=part) if isinstance(part, str) else part
            for name, part in table.messages.items()
        }
        self.messages = {name: self._messages_of(part) for name, part in self.parts.items()}
        self.binder = Binder(where, self.messages, slots=self.slots, objects=self.objects)

    def _messages_of(self, part: PartTable) -> list[DbcMessage]:
        names = [fill(part.message, slot=slot) for slot in self.slots]
        return [self.dbc.message(name, f"{self.where}.messages") for name in names]

    def profile(self) -> SensorProfile:
        table, mount = self.table, self.table.mount
        self._check_messages()
        fields = self._fields()
        joins = [self._join(name, part) for name, part in self.parts.items()]
        counters = [self._counter(name, part) for name, part in self.parts.items()]
        return SensorProfile(
            name=table.name,
            bus=table.bus,
            framing=table.framing,
            slots=tuple(self.slots),
            objects_per_message=len(self.objects),
            header=self._header(),
            parts=tuple(map(self._part, range(len(self.parts)), joins, counters)),
            fields=fields,
            velocity_kind=VelocityKind[table.velocity.upper()],
            timeout_s=table.timeout_s,
            silence_s=silence_of(table),
            latency_s=table.latency_s,
            object_id_offset=table.object_id_offset,
            mount=Pose2(mount.x_m, mount.y_m, math.radians(mount.yaw_deg)),
        )

    def _check_messages(self) -> None:
        names = [message.name for messages in self.messages.values() for message in messages]
        names += [self.table.header.message] if self.table.header else []
        for name in names:
            if names.count(name) > 1:
                raise ProfileError(f"{self.where}: the message {name} is named more than once")

    def _fields(self) -> ObjectFields:
        fields = self.table.fields
        numbers = {key: getattr(fields, key) for key in _MEASURES}
        return ObjectFields(
            object_id=self._object_id(),
            numbers={
                key: self.binder.field(f"fields.{key}", entry, _MEASURES[key])
                for key, entry in numbers.items()
                if entry is not None
            },
            existence=self._existence(),
            object_class=self._object_class(),
            new_track=self._condition("new_track", fields.new_track),
            valid=self._condition("valid", fields.valid),
        )

    def _object_id(self) -> Reference | None:
        name = self.table.fields.id
        if name == SLOT_ID:
            return None
        if "." not in name:
            name = f"{next(iter(self.parts))}.{name}"
        signal = self.binder.signal("fields.id", name)
        if signal.is_float or signal.length > _MAX_ID_BITS:
            raise self.binder.error(
                "fields.id", f"{name} is no integer of up to {_MAX_ID_BITS} bits"
            )
        return self.binder.reference("fields.id", name, raw=True)

    def _join(self, name: str, part: PartTable) -> Reference | None:
        """What the messages of a part are joined by, where it is not the slot."""
        if self.table.framing != "counted" or len(self.parts) == 1:
            return None
        signal = part.id or self.table.fields.id.rpartition(".")[2]
        return self.binder.reference(f"messages.{name}.id", f"{name}.{signal}", raw=True)

    def _existence(self) -> BoundField | Lookup | None:
        entry = self.table.fields.existence
        if isinstance(entry, ExistenceTable):
            return self._lookup("existence", entry.signal, entry.table, math.nan)
        return None if entry is None else self.binder.field("fields.existence", entry, "ratio")

    def _object_class(self) -> Lookup | None:
        entry = self.table.fields.object_class
        if entry is None:
            return None
        classes = {kind.name.lower(): kind.value for kind in ObjectClass}
        for name in entry.table.values():
            if name not in classes:
                known = ", ".join(classes)
                raise self.binder.error("fields.class", f"no class {name!r}; there are {known}")
        numbers = {raw: float(classes[name]) for raw, name in entry.table.items()}
        return self._lookup("class", entry.signal, numbers, float(ObjectClass.UNKNOWN))

    def _lookup(self, key: str, signal: str, table: dict[int, float], default: float) -> Lookup:
        found = self.binder.common_signal(f"fields.{key}", signal)
        if found.is_float:
            raise self.binder.error(f"fields.{key}", f"{signal} is a float; a table has integers")
        if found.length > _MAX_TABLE_BITS:
            raise self.binder.error(
                f"fields.{key}", f"{signal} has {found.length} bits, too many to list"
            )
        known = found.raw_values
        values = np.full(len(known) + 1, default)
        for raw, value in table.items():
            if raw not in known:
                kind = "signed" if found.is_signed else "unsigned"
                raise self.binder.error(
                    f"fields.{key}.table",
                    f"{signal} is never {raw}: the DBC has it {kind}, {known[0]} to {known[-1]}",
                )
            values[raw % len(known)] = value
        return Lookup(self.binder.bits(f"fields.{key}", signal), values)

    def _condition(self, key: str, text: str | None) -> BoundCondition | None:
        return None if text is None else self.binder.condition(f"fields.{key}", text)

    def _counter(self, name: str, part: PartTable) -> Counter | None:
        if part.counter is None:
            return None
        return _bound_counter(self.binder, f"messages.{name}.counter", f"{name}.{part.counter}")

    def _part(self, index: int, object_id: Reference | None, counter: Counter | None) -> Part:
        name, part = list(self.parts.items())[index]
        signals = SignalTable(self.binder.columns(index))
        self._check_data_id(name, part)
        addresses = [
            address_of(
                message,
                part.checksum,
                id_offset=self.id_offset,
                needed_bytes=signals.needed_bytes,
                where=f"{self.where}.messages.{name}",
            )
            for message in self.messages[name]
        ]
        return Part(
            addresses=tuple(addresses),
            table=signals,
            object_id=object_id,
            counter=counter,
            per_cycle=part.per_cycle,
            optional=part.optional,
        )

    def _check_data_id(self, name: str, part: PartTable) -> None:
        if part.checksum is None or part.checksum.data_id is None or len(self.slots) == 1:
            return
        raise ProfileError(
            f"{self.where}.messages.{name}.checksum: data_id is that of one message, and this has "
            f"{len(self.slots)} slots; without the key, each has the low 16 bits of its own id"
        )

    def _header(self) -> Header | None:
        table, where = self.table.header, f"{self.where}.header"
        if table is None:
            return None
        message = self.dbc.message(table.message, where)
        binder = Binder(where, {"header": [message]})
        count = table.count and binder.reference("count", table.count)
        age = table.age and binder.field("age", table.age, "time")
        entry = table.counter
        spec = CounterTable(signal=entry, steps=[1]) if isinstance(entry, str) else entry
        counter = spec and _bound_counter(binder, "counter", spec.signal)
        columns = binder.columns(0)
        return Header(
            address=address_of(
                message,
                table.checksum,
                id_offset=self.id_offset,
                needed_bytes=SignalTable(columns).needed_bytes,
                where=where,
            ),
            count=columns[count.row] if count else None,
            columns=tuple(columns),
            age=age or None,
            counter=counter or None,
            counter_steps=tuple(spec.steps) if spec else (),
        )


def _bound_counter(binder: Binder, key: str, signal: str) -> Counter:
    return Counter(binder.bits(key, signal), 1 << binder.common_signal(key, signal).length)
