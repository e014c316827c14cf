"""The messages that tell the ego vehicle's motion or pose, as the decoder needs them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding.addresses import Address, address_of
from eqrt.runtime.decoding.bindings import Binder
from eqrt.runtime.decoding.bound_fields import BoundCondition, BoundField, Reference
from eqrt.runtime.decoding.dbc_files import Dbc, DbcMessage
from eqrt.runtime.decoding.dbc_tables import Column, SignalTable
from eqrt.runtime.decoding.profile_schema import EgoMessageTable, EgoTable
from eqrt.runtime.decoding.sensor_checks import MAX_TIME_S
from eqrt.runtime.protection.source_health import DEFAULT_SILENCE_S

_MEASURES = {
    "speed": "speed",
    "yaw_rate": "angular rate",
    "x": "length",
    "y": "length",
    "yaw": "angle",
    "latitude": "angle",
    "longitude": "angle",
    "heading": "angle",
    "age": "time",
}
_POSES = (("x", "y", "yaw"), ("latitude", "longitude", "heading"))


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoPart:
    """One of the messages."""

    address: Address
    columns: tuple[Column, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoProfile:
    """Some messages that tell the ego vehicle's motion or pose together."""

    name: str
    """`ego` and the message that tells."""
    bus: str
    """The role of the bus that they are on."""
    parts: tuple[EgoPart, ...]
    """The last one's arrival tells; what the others said counts for `hold_s`."""
    numbers: Mapping[str, BoundField]
    """Keys as in the profile, values in SI units; heading is clockwise from north, other angles and
    rates counter-clockwise."""
    pose_columns: tuple[Reference, ...]
    """What a pose is made of: it counts once, however long `hold_s` is."""
    reverse: BoundCondition | None
    """Where it holds, the speed is backward."""
    valid: BoundCondition | None
    latency_s: float
    hold_s: float
    silence_s: float
    """After so long without the last message it is not valid."""


def bind_ego(table: EgoTable, dbc: Dbc, id_offset: int, where: str) -> EgoProfile:
    """Raises ProfileError, led by `where`, if the table makes no sense or the DBC lacks a name."""
    _check(table, where)
    specs = {
        name: EgoMessageTable(message=spec) if isinstance(spec, str) else spec
        for name, spec in table.messages.items()
    }
    messages = {
        name: dbc.message(spec.message, f"{where}.messages") for name, spec in specs.items()
    }
    binder = Binder(where, {name: [message] for name, message in messages.items()})
    fields = table.fields
    numbers = {
        key: binder.field(f"fields.{key}", getattr(fields, key), measure)
        for key, measure in _MEASURES.items()
        if getattr(fields, key) is not None
    }
    reverse = fields.reverse and binder.condition("fields.reverse", fields.reverse)
    valid = fields.valid and binder.condition("fields.valid", fields.valid)
    id_offset += table.arbitration_id_offset
    parts = [
        _part(
            messages[name],
            spec,
            binder.columns(i),
            id_offset=id_offset,
            where=f"{where}.messages.{name}",
        )
        for i, (name, spec) in enumerate(specs.items())
    ]
    return EgoProfile(
        name=f"ego {list(messages.values())[-1].name}",
        bus=table.bus,
        parts=tuple(parts),
        numbers=numbers,
        pose_columns=tuple(
            column
            for pose in _POSES
            for key in pose
            if key in numbers
            for column in numbers[key].columns
        ),
        reverse=reverse or None,
        valid=valid or None,
        latency_s=table.latency_s,
        hold_s=table.hold_s,
        silence_s=DEFAULT_SILENCE_S if table.silence_s is None else table.silence_s,
    )


def _part(
    message: DbcMessage,
    spec: EgoMessageTable,
    columns: list[Column],
    *,
    id_offset: int,
    where: str,
) -> EgoPart:
    counter = None
    if spec.counter is not None:
        counter = Binder(where, {"": [message]}).signal("counter", spec.counter)
    address = address_of(
        message,
        spec.checksum,
        counter=counter,
        id_offset=id_offset,
        needed_bytes=SignalTable(columns).needed_bytes,
        where=where,
    )
    return EgoPart(address=address, columns=tuple(columns))


def _check(table: EgoTable, where: str) -> None:
    fields = table.fields
    given = {key for key in _MEASURES if getattr(fields, key) is not None}
    problem = None
    if not table.messages:
        problem = "messages is empty; name the messages"
    elif not given - {"age"}:
        problem = "fields must have speed, yaw_rate, or a pose"
    elif halves := [pose for pose in _POSES if given & set(pose) and not given >= set(pose)]:
        problem = f"a pose needs {', '.join(halves[0])}, and fields has only some of them"
    elif all(given & set(pose) for pose in _POSES):
        problem = "there are two poses; give x, y, yaw or latitude, longitude, heading"
    elif fields.reverse is not None and fields.speed is None:
        problem = "fields.reverse turns fields.speed around, which is missing"
    elif not 0.0 < table.hold_s <= MAX_TIME_S:
        problem = f"hold_s is {table.hold_s}, expected above 0 to {MAX_TIME_S:g}"
    elif table.silence_s is not None and not 0.0 < table.silence_s <= MAX_TIME_S:
        problem = f"silence_s is {table.silence_s}, expected above 0 to {MAX_TIME_S:g}"
    if problem:
        raise ProfileError(f"{where}: {problem}")
