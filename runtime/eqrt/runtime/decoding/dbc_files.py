"""DBC files, read by cantools once, at start."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eqrt.core.errors import ProfileError, in_one_line
from eqrt.core.files import read_at_most
from eqrt.runtime.decoding.dbc_layout import layout_of
from eqrt.runtime.decoding.dbc_tables import Signal

MAX_BYTES = 1 << 21
"""Of a file: eight times the longest that is published of a whole car (266 kB)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DbcMessage:
    """One message of a DBC."""

    name: str
    arbitration_id: int
    is_extended: bool
    length: int
    """Bytes, as the DBC says; the wire may say otherwise."""
    signals: dict[str, Signal]


@dataclass(frozen=True, slots=True)
class Dbc:
    """A DBC file."""

    path: Path
    messages: Mapping[str, DbcMessage]

    def message(self, name: str, where: str) -> DbcMessage:
        """Raises ProfileError, led by `where`, if there is no such message."""
        if name not in self.messages:
            close = difflib.get_close_matches(name, self.messages, n=3) or sorted(self.messages)[:8]
            raise ProfileError(
                f"{where}: {self.path.name} has no message {name!r}; it has {', '.join(close)} "
                f"({len(self.messages)} in all)"
            )
        return self.messages[name]


def load_dbc(path: Path) -> Dbc:
    """Raises ProfileError if the file cannot be read or is not a DBC."""
    try:
        content = read_at_most(MAX_BYTES, path)
    except OSError as error:
        raise ProfileError(f"cannot read the DBC {path}: {error.strerror or error}") from error
    return parse_dbc(content, path)


def parse_dbc(content: bytes, path: Path) -> Dbc:
    """What a file contains; `path` names it in errors. Raises ProfileError if it is not a DBC."""
    # Imported here because it costs 50 ms and 3 MB, which a command without a profile is spared.
    from cantools.database.can.formats import dbc  # noqa: PLC0415

    layout = layout_of(_text(content), f"the DBC {path}")
    try:
        messages = [_message(message) for message in _parsed(dbc.load_string, layout, path)]
    except (KeyError, RecursionError) as error:
        raise ProfileError(
            f"the DBC {path} has a multiplexer that is missing, or stands in its own way"
        ) from error
    return Dbc(path, {message.name: message for message in messages})


def _text(content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:  # as nearly any text in the format's own encoding that is no ASCII
        return content.decode("cp1252", "replace")


def _parsed(parse: Callable[..., Any], layout: str, path: Path) -> list[Any]:
    try:
        # Not strict: published DBCs have overlapping signals in messages that nobody asks for.
        return list(parse(layout, strict=False).messages)
    except Exception as error:  # cantools lets through whatever it stumbles over
        raise ProfileError(f"the DBC {path} does not parse: {in_one_line(error)}") from error


def _message(message: Any) -> DbcMessage:
    signals: dict[str, Signal] = {}
    known = {signal.name: signal for signal in message.signals}
    for name in known:
        _add_signal(name, known, signals)
    return DbcMessage(
        name=message.name,
        arbitration_id=message.frame_id,
        is_extended=message.is_extended_frame,
        length=message.length,
        signals=signals,
    )


def _add_signal(name: str, known: dict[str, Any], signals: dict[str, Signal]) -> Signal:
    if name in signals:
        return signals[name]
    signal = known[name]
    selector = signal.multiplexer_signal and _add_signal(signal.multiplexer_signal, known, signals)
    start, length = signal.start, signal.length
    little = signal.byte_order == "little_endian"
    # A big-endian start is the most significant bit, counted 7..0 from the left within a byte.
    first_bit = start if little else 8 * (start // 8) + 7 - start % 8
    last_bit = first_bit + length - 1
    signals[name] = Signal(
        name=name,
        length=length,
        first_byte=first_bit // 8,
        last_byte=last_bit // 8,
        shift=first_bit % 8 if little else 7 - last_bit % 8,
        is_little_endian=little,
        is_signed=signal.is_signed and not signal.is_float,
        is_float=signal.is_float,
        scale=float(signal.scale),
        offset=float(signal.offset),
        unit=signal.unit or "",
        selector=selector or None,
        selected_by=frozenset(signal.multiplexer_ids or ()) if selector else frozenset(),
    )
    return signals[name]
