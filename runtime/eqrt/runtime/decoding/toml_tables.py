"""TOML as dataclasses: every key known, every value of the type that the dataclass says.

A table is a frozen dataclass and its fields are the keys (`field(metadata={"key": ...})` for a key
that is no name in Python). Types are those of TOML, `Literal`, lists, dicts, tables, and unions of
them; what is wrong is told by file and key.
"""

from __future__ import annotations

import dataclasses
import tomllib
import types
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from eqrt.core.errors import ProfileError
from eqrt.core.files import read_at_most

T = TypeVar("T")

MAX_BYTES = 1 << 18
"""Of a file: a hundred times our longest profile."""
_MAX_INTEGER = (1 << 63) - 1  # of TOML; Python's have no end, and nothing else can hold them
_SPELLED = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}


def read_toml(path: Path, kind: type[T]) -> T:
    """The file as a `kind`.

    Raises ProfileError if it cannot be read, is not TOML, or has a wrong key or type.
    """
    try:
        content = read_at_most(MAX_BYTES, path)
    except OSError as error:
        raise ProfileError(f"cannot read {path}: {error.strerror or error}") from error
    return parse_toml(content, kind, str(path))


def parse_toml(content: bytes, kind: type[T], path: str) -> T:
    """What a file contains as a `kind`; `path` names it in errors.

    Raises ProfileError if it is not TOML, or has a wrong key or type.
    """
    try:
        values = tomllib.loads(content.decode("utf-8-sig"))  # some editors begin with a mark
    except (ValueError, RecursionError) as error:  # neither UTF-8 nor TOML, or far too deep
        raise ProfileError(f"{path} is not TOML: {error}") from error
    return cast("T", _table(values, kind, path, ""))


def _value(value: object, kind: Any, path: str, where: str) -> Any:
    """The value as `kind`, a type as annotated; `where` is its place in the file."""
    if isinstance(kind, types.UnionType):
        kind = _option(value, get_args(kind))
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return _table(value, kind, path, where)
    origin = get_origin(kind)
    if origin is list and isinstance(value, list):
        (item,) = get_args(kind)
        return [_value(x, item, path, f"{where}[{i}]") for i, x in enumerate(value)]
    if origin is dict and isinstance(value, dict):
        key_kind, item = get_args(kind)
        named = {_key(k, key_kind, path, where): x for k, x in value.items()}
        return {k: _value(x, item, path, f"{where}.{k}") for k, x in named.items()}
    if origin is Literal and value in get_args(kind) and not isinstance(value, bool):
        return value
    if isinstance(value, int) and abs(value) > _MAX_INTEGER:
        raise ProfileError(f"{path}: {where} is an integer of more than 64 bits")
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is kind:
        return value
    raise ProfileError(f"{path}: {where} is {_shown(value)}, expected {_spelled(kind)}")


def _option(value: object, kinds: tuple[Any, ...]) -> Any:
    """Of a union, what the value is meant to be; a table: the one that knows most of its keys."""
    if isinstance(value, dict):
        tables = [kind for kind in kinds if dataclasses.is_dataclass(kind)]
        if tables:
            return max(tables, key=lambda kind: len(value.keys() & _keys(kind).keys()))
    fitting = [kind for kind in kinds if type(value) is kind]
    return (fitting or [kind for kind in kinds if kind is not types.NoneType])[0]


def _table(value: dict[str, object], kind: Any, path: str, where: str) -> Any:
    keys, hints = _keys(kind), get_type_hints(kind)
    for key in (key for key in value if key not in keys):
        place = f"{where}: " if where else ""
        raise ProfileError(f"{path}: {place}unknown key {key!r}; the keys are {', '.join(keys)}")
    arguments = {}
    for key, field in keys.items():
        place = f"{where}.{key}".lstrip(".")
        if key in value:
            arguments[field.name] = _value(value[key], hints[field.name], path, place)
        elif field.default is field.default_factory is dataclasses.MISSING:
            raise ProfileError(f"{path}: the key {place} is missing")
    return kind(**arguments)


def _keys(kind: Any) -> dict[str, dataclasses.Field[Any]]:
    return {field.metadata.get("key", field.name): field for field in dataclasses.fields(kind)}


def _key(key: str, kind: type, path: str, where: str) -> str | int:
    if kind is str:
        return key
    try:
        return int(key, 0)
    except ValueError:
        raise ProfileError(f"{path}: the key {key!r} in {where} is not an integer") from None


def _spelled(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return " or ".join(repr(option) for option in get_args(kind))
    if dataclasses.is_dataclass(kind):
        return f"a table with the keys {', '.join(_keys(kind))}"
    return {list: "a list", dict: "a table"}.get(get_origin(kind) or kind, _SPELLED.get(kind, ""))


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return "a table"
    return "a list" if isinstance(value, list) else repr(value)
