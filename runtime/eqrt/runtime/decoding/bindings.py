"""Names in a profile, bound to the bits of the DBC that they mean.

The messages that describe one object (or the ego vehicle) are its parts. Binding a name gives a
`Reference` to one of their columns.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding.bound_fields import BoundCondition, BoundField, Reference
from eqrt.runtime.decoding.conditions import Comparison, ConditionError, parse_condition
from eqrt.runtime.decoding.dbc_files import DbcMessage
from eqrt.runtime.decoding.dbc_tables import Column, Signal
from eqrt.runtime.decoding.profile_schema import FieldTable, MeanTable, SpanTable
from eqrt.runtime.decoding.units import FACTORS

_MAX_PAYLOAD_BYTES = 64  # of CAN FD
_MAX_BITS, _FLOAT_BITS = 64, (16, 32, 64)
_MAX_SPAN_BYTES = 8  # more than any signal in use spans; keeps the decoder to one shift
_NUMBERED = re.compile(r"\{(slot|object)(?::(0?\d*[dxX]))?\}")


class Binder:
    """Collects the columns that a profile asks for, part by part."""

    def __init__(
        self,
        where: str,
        parts: Mapping[str, Sequence[DbcMessage]],
        *,
        slots: Sequence[int] = (0,),
        objects: Sequence[int] = (0,),
    ) -> None:
        """`parts`: name in the profile -> its messages, one per slot; `where` leads errors."""
        self._where = where
        self._parts = parts
        self._names = list(parts)
        self._slots = slots
        self._objects = objects
        self._rows: list[list[list[Column]]] = [[] for _ in parts]

    def columns(self, part: int) -> list[Column]:
        """The columns of a part: row after row, for every object in the message."""
        return [column for row in self._rows[part] for column in row]

    def field(self, key: str, entry: str | FieldTable | MeanTable, measure: str) -> BoundField:
        """A field in SI units; `measure` says what it must measure."""
        if isinstance(entry, str):
            entry = FieldTable(signal=entry)
        names = entry.mean if isinstance(entry, MeanTable) else [entry.signal]
        sign = 1 if isinstance(entry, MeanTable) else entry.sign
        if not names:
            raise self.error(key, "mean is empty; name the signals")
        columns = [
            self.reference(key, name, sign * self._factor(key, name, entry.unit, measure))
            for name in names
        ]
        when = None if entry.when is None else self.condition(f"{key}.when", entry.when)
        return BoundField(tuple(columns), when)

    def condition(self, key: str, text: str) -> BoundCondition:
        """A condition on physical or raw values; those that have raw ones are compared by them."""
        try:
            condition = parse_condition(text, partial(self._of_raw, key))
        except ConditionError as error:
            raise self.error(key, f"{text!r} is not a condition: {error}") from error
        operands = [self.reference(key, x.name, raw=x.is_raw) for x in condition.operands]
        return BoundCondition(condition.evaluate, tuple(operands))

    def reference(
        self, key: str, name: str, factor: float = 1.0, *, raw: bool = False
    ) -> Reference:
        """The column for PART.SIGNAL (or SIGNAL, where there is one part) times `factor`."""
        if raw:
            return self._row(key, name, lambda x: Column(x, 1.0, 0.0))
        return self._row(key, name, lambda x: Column(x, x.scale * factor, x.offset * factor))

    def bits(self, key: str, name: str) -> Reference:
        """The column for the signal's bits: from 0 on, also where the DBC has it signed."""
        return self._row(key, name, lambda x: Column(replace(x, is_signed=False), 1.0, 0.0))

    def signal(self, key: str, name: str) -> Signal:
        """What PART.SIGNAL means, in the first slot and object."""
        part, signal = self._split(key, name)
        return self._signal(key, part, signal, self._objects[0])

    def common_signal(self, key: str, name: str) -> Signal:
        """The same where it must be one kind of number in every object."""
        found = self._signals(key, name)
        if len({(x.length, x.is_signed, x.is_float, x.scale, x.offset) for x in found}) > 1:
            raise self.error(key, f"{name!r} differs from object to object in bits, sign or scale")
        return found[0]

    def error(self, key: str, text: str) -> ProfileError:
        """An error that says where in the profile it is."""
        return ProfileError(f"{self._where}.{key}: {text}")

    def _of_raw(self, key: str, comparison: Comparison) -> Comparison:
        name = comparison.operand.name
        signals = self._signals(key, name)
        if comparison.operand.is_raw or all(x.is_float or x.scale == 0.0 for x in signals):
            return comparison
        if len({(x.is_float, x.scale, x.offset) for x in signals}) > 1:
            raise self.error(key, f"{name!r} differs from object to object in scale or offset")
        return comparison.of_raw(signals[0].scale, signals[0].offset)

    def _row(self, key: str, name: str, column_of: Callable[[Signal], Column]) -> Reference:
        row = [column_of(signal) for signal in self._signals(key, name)]
        part, _ = self._split(key, name)
        rows = self._rows[part]
        if row not in rows:
            rows.append(row)
        return Reference(part, rows.index(row))

    def _signals(self, key: str, name: str) -> list[Signal]:
        """What PART.SIGNAL means, in every object."""
        part, signal = self._split(key, name)
        return [self._signal(key, part, signal, number) for number in self._objects]

    def _split(self, key: str, name: str) -> tuple[int, str]:
        part, dot, signal = name.partition(".")
        if not dot:
            if len(self._names) > 1:
                example = f"{self._names[0]}.{name}"
                raise self.error(key, f"say which message {name!r} is in, for example {example!r}")
            return 0, name
        if part not in self._names:
            known = ", ".join(self._names)
            raise self.error(key, f"there is no message {part!r} here; there is {known}")
        return self._names.index(part), signal

    def _signal(self, key: str, part: int, name: str, number: int) -> Signal:
        """The signal for one object in the message, which must be the same in every slot."""
        found = [
            self._signal_in(key, message, fill(name, slot=slot, object=number))
            for slot, message in zip(self._slots, self._parts[self._names[part]], strict=True)
        ]
        layouts = [replace(signal, name=name) for signal in found]
        for signal, layout in zip(found, layouts, strict=True):
            if layout != layouts[0]:
                raise self.error(key, f"{signal.name!r} is not laid out alike in every slot")
        if problem := _unreadable(layouts[0]):
            raise self.error(key, f"the signal {name!r} {problem}")
        if layouts[0].last_byte - layouts[0].first_byte >= _MAX_SPAN_BYTES:
            raise self.error(key, f"the signal {name!r} spans more than {_MAX_SPAN_BYTES} bytes")
        return layouts[0]

    def _signal_in(self, key: str, message: DbcMessage, name: str) -> Signal:
        if name not in message.signals:
            known = ", ".join(message.signals) or "none"
            raise self.error(
                key, f"the message {message.name} has no signal {name!r}; it has {known}"
            )
        return message.signals[name]

    def _factor(self, key: str, name: str, unit: str | None, measure: str) -> float:
        in_dbc = self.signal(key, name).unit.strip()
        units = FACTORS[measure]
        if unit is None:
            unit = in_dbc
            if unit not in units:
                says = f"the unit {unit!r}" if unit else "no unit"
                raise self.error(
                    key, f"the DBC gives {name} {says}; add unit = one of {_quoted(units)}"
                )
        elif unit not in units:
            raise self.error(key, f"unit {unit!r} is no {measure}; known are {_quoted(units)}")
        return units[unit]


def fill(name: str, **numbers: int) -> str:
    """The name with `{slot}`, `{object}` (also `{slot:02d}`, `{slot:X}`) replaced by numbers."""
    return _NUMBERED.sub(
        lambda match: (
            format(numbers[match[1]], match[2] or "d") if match[1] in numbers else match[0]
        ),
        name,
    )


def span(table: SpanTable | None, where: str) -> list[int]:
    """The numbers of a span; [0] if there is none."""
    if table is None:
        return [0]
    if not 0 <= table.first <= table.last < table.first + 256:
        raise ProfileError(
            f"{where}: first {table.first}, last {table.last} is no span of 1 to 256"
        )
    return list(range(table.first, table.last + 1))


def _unreadable(signal: Signal) -> str | None:
    """Why the decoder cannot read a signal, and those that it is multiplexed by; None if it can."""
    if not 1 <= signal.length <= _MAX_BITS or signal.first_byte < 0:
        return f"has {signal.length} bits from byte {signal.first_byte} on"
    if signal.last_byte >= _MAX_PAYLOAD_BYTES:
        return f"lies beyond the {_MAX_PAYLOAD_BYTES} bytes of a message"
    if signal.is_float and signal.length not in _FLOAT_BITS:
        return f"is a float of {signal.length} bits, not of 16, 32 or 64"
    if not (math.isfinite(signal.scale) and math.isfinite(signal.offset)):
        return "has a scale or offset that is not finite"
    return None if signal.selector is None else _unreadable(signal.selector)


def _quoted(names: Mapping[str, float]) -> str:
    return ", ".join(repr(name) for name in names)
