"""The keys of a profile file, table by table; docs/profiles.md explains them to users.

Only which keys there are and of what type. What they mean together, and whether the DBC has the
signals that they name, is checked in `eqrt.runtime.decoding.profile`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

# `dict[str, ...]` fields are named by the user; every other key is one of those below.


@dataclass(frozen=True, slots=True, kw_only=True)
class SpanTable:
    """The numbers from `first` to `last`, which stand for `{slot}` or `{object}` in names."""

    first: int
    last: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldTable:
    """A signal and how to read it; a plain string is a signal to be read as the DBC says."""

    signal: str
    sign: Literal[1, -1] = 1
    unit: str | None = None
    when: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassTable:
    """A signal whose raw values stand for object classes."""

    signal: str
    table: dict[int, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExistenceTable:
    """A signal whose raw values stand for probabilities of existence."""

    signal: str
    table: dict[int, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanTable:
    """The mean of several signals, all of which must be there."""

    mean: list[str]
    unit: str | None = None
    when: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ChecksumTable:
    """A checksum in a message; which keys go with which kind is checked in `checksum_binding`."""

    kind: Literal["sum8", "xor8", "crc8", "crc16", "e2e-p5"]
    byte: int | None = None
    order: Literal["little", "big"] = "little"
    covers_id: bool = False
    covers_length: bool = False
    polynomial: int | None = None
    start: int | None = None
    final_xor: int | None = None
    data_id: int | None = None
    offset: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CounterTable:
    """A cycle counter, and by how much it may grow from cycle to cycle."""

    signal: str
    steps: list[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class MountTable:
    """Where the sensor sits, in the ego frame."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_deg: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class HeaderTable:
    """The message that opens a cycle."""

    message: str
    count: str | None = None
    counter: str | CounterTable | None = None
    age: str | FieldTable | None = None
    checksum: ChecksumTable | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PartTable:
    """One of the messages that describe an object; a plain string is its name."""

    message: str
    id: str | None = None
    optional: bool = False
    per_cycle: int | None = None
    counter: str | None = None
    checksum: ChecksumTable | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectFieldsTable:
    """Where an object's values come from."""

    id: str = "slot"
    x: str | FieldTable | None = None
    y: str | FieldTable | None = None
    range: str | FieldTable | None = None
    azimuth: str | FieldTable | None = None
    velocity_x: str | FieldTable | None = None
    velocity_y: str | FieldTable | None = None
    range_rate: str | FieldTable | None = None
    heading: str | FieldTable | None = None
    length: str | FieldTable | None = None
    width: str | FieldTable | None = None
    object_class: ClassTable | None = field(default=None, metadata={"key": "class"})
    existence: str | FieldTable | ExistenceTable | None = None
    new_track: str | None = None
    valid: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorTable:
    """One sensor: how its messages make cycles, and its signals objects."""

    name: str
    bus: str
    dbc: str
    framing: Literal["counted", "slots", "single"]
    messages: dict[str, str | PartTable]
    fields: ObjectFieldsTable
    velocity: Literal["none", "relative", "absolute", "radial"] = "none"
    timeout_s: float = 0.05
    silence_s: float | None = None
    latency_s: float = 0.0
    arbitration_id_offset: int = 0
    object_id_offset: int = 0
    mount: MountTable = MountTable()
    slots: SpanTable | None = None
    objects: SpanTable | None = None
    header: HeaderTable | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoMessageTable:
    """One of the messages that tell the ego vehicle's motion; a plain string is its name."""

    message: str
    counter: str | None = None
    checksum: ChecksumTable | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoFieldsTable:
    """Where the ego vehicle's values come from."""

    speed: str | FieldTable | MeanTable | None = None
    reverse: str | None = None
    yaw_rate: str | FieldTable | None = None
    x: str | FieldTable | None = None
    y: str | FieldTable | None = None
    yaw: str | FieldTable | None = None
    latitude: str | FieldTable | None = None
    longitude: str | FieldTable | None = None
    heading: str | FieldTable | None = None
    age: str | FieldTable | None = None
    valid: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoTable:
    """Messages that tell the ego vehicle's motion or its pose in the map."""

    bus: str
    dbc: str
    messages: dict[str, str | EgoMessageTable]
    fields: EgoFieldsTable
    latency_s: float = 0.0
    hold_s: float = 0.05
    silence_s: float | None = None
    arbitration_id_offset: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfileTable:
    """A profile file."""

    description: str
    arbitration_id_offset: int = 0
    yaw_rate_bias_deg_s: float = 0.0
    sensor: list[SensorTable] = field(default_factory=list)
    ego: list[EgoTable] = field(default_factory=list)
