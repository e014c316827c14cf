"""Tables of a configuration as dataclasses, whose fields say which values they take."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Annotated, Any

import msgspec

Count = Annotated[int, msgspec.Meta(ge=1)]
BoundedCount = Annotated[int, msgspec.Meta(ge=1, le=1 << 16)]
"""Of what must all be in memory at once: more is a slip of the pen."""
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
"""Or a probability."""
PartialShare = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
"""Never all of it."""
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]


def fill(kind: type[Any], values: object, table: str) -> Any:
    """`kind(**values)`; a field that has a default may be missing.

    Raises ValueError that names the table, and in it the fields that are missing or unknown, or one
    that is of another type, out of its range, or not a number.
    """
    if isinstance(values, Mapping):
        needed = {field.name for field in fields(kind) if field.default is MISSING}
        check_names(f"[{table}]", set(values), needed, {field.name for field in fields(kind)})
        for name, value in values.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"[{table}]: {name} is {value}, expected a finite number")
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        raise ValueError(f"[{table}]: {error}") from error


def check_names(where: str, found: set[str], needed: set[str], known: set[str]) -> None:
    """Raise ValueError that names the fields that are missing or unknown."""
    if wrong := sorted((needed - found) | (found - known)):
        raise ValueError(f"{where} has missing or unknown fields: {', '.join(wrong)}")


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise ValueError if a setting is not one of its choices."""
    if value not in choices:
        raise ValueError(f"{name} is {value!r}, expected one of {', '.join(choices)}")


def check_multiple(name: str, value: int, of: int) -> None:
    """Raise ValueError if a width cannot be shared equally by so many heads."""
    if value % of:
        raise ValueError(f"{name} is {value}, expected a multiple of heads, {of}")
