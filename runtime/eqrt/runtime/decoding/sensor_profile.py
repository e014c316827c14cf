"""A sensor, as the decoder needs it: which messages make a cycle, which of their bits an object."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from eqrt.core.frames import Pose2
from eqrt.runtime.decoding.addresses import Address
from eqrt.runtime.decoding.bound_fields import BoundCondition, BoundField, Reference
from eqrt.runtime.decoding.dbc_tables import Column, SignalTable
from eqrt.runtime.decoding.detections import VelocityKind


@dataclass(frozen=True, slots=True)
class Counter:
    """A cycle counter in a message."""

    column: Reference
    modulus: int
    """It counts 0 .. modulus - 1."""


@dataclass(frozen=True, slots=True)
class Lookup:
    """A signal whose raw values stand for something else."""

    column: Reference
    table: NDArray[np.float64]
    """(2 ** length + 1,) by the signal's bits; the last is for one that is not in the message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """The message that opens a cycle."""

    address: Address
    count: Column | None
    """How many objects follow."""
    columns: tuple[Column, ...]
    """What `age` and `counter` refer to, as part 0."""
    age: BoundField | None
    counter: Counter | None
    counter_steps: tuple[int, ...]
    """By how much the counter may grow from cycle to cycle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One of the messages that describe an object."""

    addresses: tuple[Address, ...]
    """One per slot."""
    table: SignalTable
    """S rows, each as many columns as the message has objects."""
    object_id: Reference | None
    """What joins it with the first part; None = the slot does."""
    counter: Counter | None
    per_cycle: int | None
    """Messages in every cycle however many objects there are; None = as many as they need."""
    optional: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectFields:
    """Where an object's values come from: SI units, the signs of the sensor frame."""

    object_id: Reference | None
    """None = the slot is the id."""
    numbers: Mapping[str, BoundField]
    """Keys as in the profile: x, y, range, azimuth, velocity_x ... width."""
    existence: BoundField | Lookup | None
    object_class: Lookup | None
    new_track: BoundCondition | None
    valid: BoundCondition | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorProfile:
    """One sensor."""

    name: str
    bus: str
    """The role of the bus that it is on."""
    framing: Literal["counted", "slots", "single"]
    slots: tuple[int, ...]
    """Numbers of the slots; (0,) where the framing has none."""
    objects_per_message: int
    header: Header | None
    parts: tuple[Part, ...]
    """The first has every object, and gives the order."""
    fields: ObjectFields
    velocity_kind: VelocityKind
    timeout_s: float
    """A cycle that is not complete so long after its last message is closed as it is."""
    silence_s: float
    """After so long without a cycle it is not valid; no cycle stays open for longer."""
    latency_s: float
    """From the measurement to the first message on the bus."""
    object_id_offset: int
    mount: Pose2
    """`ego_from_sensor`."""

    @property
    def place(self) -> str:
        """The mount in words."""
        mount = self.mount
        return f"x {mount.x_m:g} m, y {mount.y_m:g} m, yaw {math.degrees(mount.yaw_rad):g} degrees"
