"""One set of options, from the command line and from a TOML file.

Every option of a command is a key of its file, because the keys are made from the options:
`--out-can` is `out_can` in the table `[serve]`, and the options of a group have a table of their
own, `--realtime-priority` is `priority` in `[realtime]`. The command line goes before the file.
"""

from __future__ import annotations

import argparse
import difflib
import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eqrt.core.errors import ConfigError, UsageError
from eqrt.core.files import read_at_most

DEFAULT, COMMAND_LINE = "default", "command line"
MAX_FILE_BYTES = 1 << 18
"""A hundred times the longest file that makes sense."""
_NO_KEYS = frozenset({"help", "config", "print_config"})  # they are about the file
_OPTIONS_GROUP = "options"  # argparse's name for what is in no group


class Switch(argparse.BooleanOptionalAction):
    """`--x` and `--no-x`, off by default: so that the command line can undo what a file says."""

    def __init__(self, option_strings: Sequence[str], dest: str, **more: Any) -> None:
        super().__init__(option_strings, dest, **more)
        self.default = False


class FileOrName(str):
    """The path of a file if it has a folder or a suffix, else the name of something built in."""

    __slots__ = ()

    @property
    def is_file(self) -> bool:
        """Whether it looks like a path."""
        path = Path(self)
        return bool(path.suffix) or path.name != self


_TEXTS = (None, str, Path, FileOrName)


@dataclass(frozen=True, slots=True)
class Option:
    """An option of the command line, and the key that it is in a file."""

    table: str
    key: str
    action: argparse.Action
    default: Any
    required: bool

    @property
    def flag(self) -> str:
        """As on the command line."""
        return self.action.option_strings[0]

    @property
    def is_list(self) -> bool:
        """Whether it can be given more than once."""
        return isinstance(self.action, argparse._AppendAction)

    @property
    def expected(self) -> str:
        """The TOML that stands for it, in words."""
        if isinstance(self.action, argparse.BooleanOptionalAction):
            return "true or false"
        if self.is_list:
            return 'a list of strings, as in ["..."]'
        if self.action.choices:
            return " or ".join(f'"{choice}"' for choice in self.action.choices)
        if _is_integer(self.action.type):
            return "an integer"
        if self.action.type is float:
            return "a number"
        is_text = self.action.type in _TEXTS
        return "a string" if is_text else "a string or an integer"


@dataclass(frozen=True, slots=True)
class Setting:
    """What an option is, and who says so."""

    option: Option
    value: Any
    source: str
    """`default`, `command line`, or file and line."""


class Settings:
    """The options of one command."""

    def __init__(self, parser: argparse.ArgumentParser, table: str) -> None:
        """Take the options that `parser` has by now; `table`: where those without a group are.

        From here on the parser leaves out what is not given, and requires nothing: `resolve` does.
        """
        parser.add_argument(
            "--config",
            type=Path,
            metavar="FILE",
            help="options from a TOML file (docs/operations.md); the command line goes before it",
        )
        parser.add_argument(
            "--print-config",
            action="store_true",
            help="print what every option is and who says so, as such a file, and end",
        )
        self._prog = parser.prog
        self.options = [*_taken(parser, table)]
        parser.set_defaults(settings=self)

    def resolve(self, given: argparse.Namespace, *, is_complete: bool = True) -> list[Setting]:
        """Every option: from the command line, else from the file, else its default.

        Raises ConfigError if the file cannot be used, UsageError if something required is missing,
        unless it need not be complete.
        """
        path: Path | None = given.config
        told = {} if path is None else _File(path).settings(self.options)
        found = [
            Setting(option, value, COMMAND_LINE)
            if (value := getattr(given, option.action.dest, _Missing)) is not _Missing
            else told.get(option.flag, Setting(option, option.default, DEFAULT))
            for option in self.options
        ]
        missing = [s.option.flag for s in found if s.option.required and s.source == DEFAULT]
        if missing and is_complete:
            where = f" (or in {path})" if path else ""
            raise UsageError(
                f"the following arguments are required{where}: {', '.join(missing)}; "
                f"see {self._prog} --help"
            )
        return found


class _Missing:
    """Stands for what the command line does not say."""


def namespace(settings: Sequence[Setting]) -> argparse.Namespace:
    """What argparse would have made of them."""
    return argparse.Namespace(**{s.option.action.dest: s.value for s in settings})


def as_toml(settings: Sequence[Setting]) -> str:
    """A file that says the same, and behind every key who said so; unset ones as comments."""
    lines: list[str] = []
    for table in dict.fromkeys(setting.option.table for setting in settings):
        lines += ["", f"[{table}]"]
        lines += [_line(setting) for setting in settings if setting.option.table == table]
    return "\n".join(lines[1:]) + "\n"


def _line(setting: Setting) -> str:
    option, value = setting.option, setting.value
    if value is None:
        return f"# {option.key} is not set"
    if isinstance(value, Path) or (isinstance(value, FileOrName) and value.is_file):
        value = str(Path(value).absolute())
    text = json.dumps(value, ensure_ascii=False)  # for these values TOML is the same
    if isinstance(value, int) and type(value) not in (bool, int):
        text = str(value)  # a kind of number that is written in its own way
    return f"{option.key} = {text}  # {setting.source}"


def _taken(parser: argparse.ArgumentParser, table: str) -> Iterator[Option]:
    for group in parser._action_groups:
        own = group.title if group.title != _OPTIONS_GROUP else None
        for action in group._group_actions:
            if action.dest in _NO_KEYS:
                continue
            default, required = action.default, action.required
            action.default, action.required = argparse.SUPPRESS, False
            key = action.dest.removeprefix(f"{own}_") if own else action.dest
            yield Option(own or table, key, action, default, required)


# --- the file


class _File:
    """A TOML file of options."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            content = read_at_most(MAX_FILE_BYTES, path)
            self._text = content.decode("utf-8-sig")  # some editors begin with a mark
            self._values = tomllib.loads(self._text)
        except OSError as error:
            raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from error
        except (ValueError, RecursionError) as error:  # neither UTF-8 nor TOML, or far too deep
            raise ConfigError(f"the configuration {path} is not TOML: {error}") from error

    def settings(self, options: Sequence[Option]) -> dict[str, Setting]:
        """By flag, what it says."""
        tables = dict.fromkeys(option.table for option in options)
        for name, value in self._values.items():
            if name not in tables:
                raise self._unknown([name], tables)
            if not isinstance(value, dict):
                raise self._error([name], f"{name} is a table: write [{name}]")
        told: dict[str, Setting] = {}
        for table in tables:
            known = {option.key: option for option in options if option.table == table}
            for key, value in self._values.get(table, {}).items():
                if key not in known:
                    raise self._unknown([table, key], known)
                option, place = known[key], [table, key]
                source = f"{self._path}:{line_of(self._text, place)}"
                told[option.flag] = Setting(option, self._value(option, value, place), source)
        return told

    def _value(self, option: Option, value: object, place: list[str]) -> Any:
        if isinstance(option.action, argparse.BooleanOptionalAction):
            fits, found = isinstance(value, bool), value
        elif option.is_list:
            fits = isinstance(value, list) and all(isinstance(one, str) for one in value)
            found = [self._scalar(option, one, place) for one in value] if fits else None  # type: ignore[attr-defined]  # then it is a list
        else:
            fits = _is_scalar(value, option.action.type)
            found = self._scalar(option, value, place) if fits else None
        if not fits or (option.action.choices and found not in option.action.choices):
            raise self._error(place, f"{place[-1]} is {_shown(value)}, expected {option.expected}")
        return found

    def _scalar(self, option: Option, value: Any, place: list[str]) -> Any:
        """As the command line would have it; a relative path begins at the file's own folder."""
        kind = option.action.type
        if isinstance(value, str) and "\0" in value:
            raise self._error(place, f"{place[-1]} holds a null character, which no name can have")
        if kind is Path:
            return self._path.parent / value
        if kind is FileOrName:
            name = FileOrName(value)
            return FileOrName(self._path.parent / name) if name.is_file else name
        if kind is None:
            return value
        try:
            return kind(str(value))  # type: ignore[operator]  # a registered name would be a str
        except (ValueError, argparse.ArgumentTypeError) as error:
            raise self._error(place, f"{place[-1]}: {error}") from error

    def _unknown(self, place: list[str], known: Mapping[str, object]) -> ConfigError:
        name, kind = place[-1], "key" if len(place) > 1 else "table"
        where = f" in [{place[0]}]" if len(place) > 1 else ""
        near = difflib.get_close_matches(name, known, 1)
        advice = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
        return self._error(place, f"unknown {kind} {name!r}{where}; {advice}")

    def _error(self, place: list[str], problem: str) -> ConfigError:
        return ConfigError(f"{self._path}, line {line_of(self._text, place)}: {problem}")


def line_of(text: str, place: Sequence[str]) -> int:
    """The line, from 1, on which the key `place` of a TOML document begins; tomllib tells none.

    The shortest beginning of the document that is TOML and has the key ends with its statement.
    """
    lines = text.replace("\r\n", "\n").split("\n")
    begins = 0
    for end in range(1, len(lines) + 1):
        try:
            values: Any = tomllib.loads("\n".join(lines[:end]))
        except tomllib.TOMLDecodeError:
            continue
        for key in place:
            values = values.get(key) if isinstance(values, dict) else None
        if values is not None:
            break
        begins = end
    while begins < len(lines) - 1 and not lines[begins].strip():
        begins += 1
    return begins + 1


def _is_scalar(value: object, kind: object) -> bool:
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind in _TEXTS:
        return isinstance(value, str)
    if _is_integer(kind):
        return type(value) is int
    return isinstance(value, str) or type(value) is int


def _is_integer(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, int)


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return "a table"
    return json.dumps(value, default=str)
