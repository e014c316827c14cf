"""Frozen dataclasses to JSON and back, with every value's type checked on the way in.

A field that has a default may be missing: it came later than the file.

Keys stand in the order of the fields, so that equal values give equal bytes.
"""

from __future__ import annotations

import json
import types
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from eqrt.core.errors import EqrtError

Value = TypeVar("Value")


def to_json(value: Any) -> str:
    """The text of a dataclass; numbers are finite."""
    return json.dumps(asdict(value), indent=1, allow_nan=False) + "\n"


def read_json(kind: type[Value], path: Path, schema: int) -> Value:
    """Read what `to_json` wrote.

    Raises EqrtError if the file cannot be read, has another `schema`, or a field is wrong.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise EqrtError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:  # not JSON, or not UTF-8
        raise EqrtError(f"{path}: not JSON ({error}); give a file of eqrt bench --json") from error
    found = values.get("schema") if isinstance(values, Mapping) else None
    if found != schema:
        raise EqrtError(
            f"{path}: schema {found} is not supported (this eqrt reads {schema}); measure again"
        )
    try:
        return parse(kind, values)
    except ValueError as error:
        raise EqrtError(f"{path}: {error}; give a file of eqrt bench --json") from error


def parse(kind: type[Value], values: Any) -> Value:
    """A dataclass from its JSON values. Raises ValueError that names the field."""
    parsed: Value = _parse(kind, values, "")
    return parsed


def _parse(kind: Any, value: Any, where: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (types.UnionType, Union):
        return None if value is None else _parse(arguments[0], value, where)  # always `X | None`
    if origin is tuple and isinstance(value, list):
        return tuple(_parse(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if origin is dict and isinstance(value, dict):
        return {key: _parse(arguments[1], item, f"{where}.{key}") for key, item in value.items()}
    if is_dataclass(kind) and isinstance(value, dict):
        return _parse_fields(kind, value, where)
    if kind is float and type(value) in (int, float):
        return float(value)
    if type(value) is kind:  # bool is no int here
        return value
    expected = getattr(kind, "__name__", kind)
    raise ValueError(f"{where.lstrip('.')} is {_shown(value)}, expected {expected}")


def _parse_fields(kind: Any, values: dict[str, Any], where: str) -> Any:
    hints = get_type_hints(kind)
    for field in fields(kind):
        if field.name not in values and field.default is MISSING:
            raise ValueError(f"{f'{where}.{field.name}'.lstrip('.')} is missing")
    names = [field.name for field in fields(kind) if field.name in values]
    return kind(**{name: _parse(hints[name], values[name], f"{where}.{name}") for name in names})


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
