"""Signals as bit tables: many payloads decoded at once, or one value by one shift.

A signal is where its bits lie and what to multiply them with. Axes: S columns (one signal each),
M messages, W bytes of payload.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Payload = bytes | bytearray
"""The data bytes of one message, as many as came over the wire."""

_WORD = 8  # bytes that one vectorised shift looks at
_NAN = float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class Signal:
    """Where a signal's bits lie, and the physical value it stands for: raw * scale + offset."""

    name: str
    length: int
    """Bits, at most 64."""
    first_byte: int
    last_byte: int
    shift: int
    """Bits to the right of the signal in the number that its bytes form, in its byte order."""
    is_little_endian: bool
    is_signed: bool
    is_float: bool
    """IEEE 754 of `length` bits rather than an integer."""
    scale: float
    offset: float
    unit: str
    """As the DBC spells it; empty if it says nothing."""
    selector: Signal | None = None
    """The multiplexer that must hold one of `selected_by` for the signal to be in the message."""
    selected_by: frozenset[int] = frozenset()

    @property
    def raw_values(self) -> range:
        """Every value of `raw` that the bits can hold, of a signal that is no float."""
        lowest = -(1 << (self.length - 1)) if self.is_signed else 0
        return range(lowest, lowest + (1 << self.length))

    def raw(self, data: Payload) -> int | None:
        """The signal's bits as an integer; None if the message is too short or holds another."""
        if len(data) <= self.last_byte:
            return None
        if self.selector is not None and self.selector.raw(data) not in self.selected_by:
            return None
        held_in = data[self.first_byte : self.last_byte + 1]
        word = int.from_bytes(held_in, "little" if self.is_little_endian else "big")
        bits = (word >> self.shift) & ((1 << self.length) - 1)
        return bits - (1 << self.length) if self.is_signed and bits >> (self.length - 1) else bits


@dataclass(frozen=True, slots=True)
class Column:
    """A signal in the unit that somebody wants it in: raw * scale + offset."""

    signal: Signal
    scale: float
    offset: float

    def read(self, data: Payload) -> float:
        """The value in one message, NaN if it is not in there."""
        raw = self.signal.raw(data)
        if raw is None:
            return _NAN
        number = _as_float(raw, self.signal.length) if self.signal.is_float else raw
        return number * self.scale + self.offset


class SignalTable:
    """Columns of one message layout, read from many payloads by one gather and one shift."""

    def __init__(self, columns: Sequence[Column]) -> None:
        self.columns = tuple(columns)
        gates = [list(_gates(column.signal)) for column in columns]
        # The multiplexers are decoded behind the columns that they let through.
        read = [*columns, *(Column(gate, 1.0, 0.0) for chain in gates for gate, _ in chain)]
        signals = [column.signal for column in read]
        self.needed_bytes = max([0, *(signal.last_byte + 1 for signal in signals)])
        """A shorter message misses at least one of the columns."""
        self.width = max(_WORD, self.needed_bytes)
        """W, bytes of a payload that are looked at."""
        self._gates = _numbered(gates, first=len(columns))
        self._scale = _upright([column.scale for column in read], np.float64)
        self._offset = _upright([column.offset for column in read], np.float64)
        self._place(signals)

    def _place(self, signals: list[Signal]) -> None:
        """Where every signal's bits are: which eight bytes, how far to shift, what to keep."""
        spots = [self._spot(signal) for signal in signals]
        windows = sorted({(start, little) for start, little, _ in spots}) or [(0, False)]
        order = {False: np.arange(_WORD), True: np.arange(_WORD)[::-1]}
        self._bytes = np.concatenate([start + order[little] for start, little in windows])
        self._window = np.array([windows.index(spot[:2]) for spot in spots], np.intp)
        self._shift = _upright([shift for _, _, shift in spots], np.uint64)
        self._mask = _upright([(1 << signal.length) - 1 for signal in signals], np.uint64)
        self._signed = [s for s, signal in enumerate(signals) if signal.is_signed]
        self._sign = _upright([1 << (signals[s].length - 1) for s in self._signed], np.uint64)
        self._floats = [(s, x.length) for s, x in enumerate(signals) if x.is_float]
        self._last_byte = _upright([signal.last_byte for signal in signals], np.int64)

    def _spot(self, signal: Signal) -> tuple[int, bool, int]:
        """(first byte of the window, byte order, right shift) of one signal."""
        start = min(signal.first_byte, self.width - _WORD)
        if signal.is_little_endian:
            return start, True, signal.shift + 8 * (signal.first_byte - start)
        return start, False, signal.shift + 8 * (start + _WORD - 1 - signal.last_byte)

    def decode(self, payloads: Sequence[Payload]) -> NDArray[np.float64]:
        """(S, M) values; NaN where a message is too short for the column, or holds another.

        Longer messages than the DBC's are fine: what the DBC does not know is not looked at.
        """
        block, lengths = _block(payloads, self.width)
        words = block.take(self._bytes, axis=1).view(">u8").T.astype(np.uint64)
        bits: NDArray[np.uint64] = (words[self._window] >> self._shift) & self._mask
        values = bits.astype(np.float64)
        if self._signed:
            # Flipping the sign bit and taking its weight away again spreads it to the left.
            signed = bits[self._signed] ^ self._sign
            values[self._signed] = signed.view(np.int64) - self._sign.view(np.int64)
        for s, length in self._floats:
            values[s] = _as_floats(bits[s], length)
        values *= self._scale
        values += self._offset
        if isinstance(lengths, np.ndarray) or lengths < self.needed_bytes:
            values[np.broadcast_to(self._last_byte >= lengths, values.shape)] = np.nan
        for column, selector, selected_by in self._gates:
            values[column, ~np.isin(values[selector], selected_by)] = np.nan
        return values[: len(self.columns)]


def _upright(values: list[Any], kind: type) -> NDArray[Any]:
    """(S, 1), to go with (S, M)."""
    return np.array(values, kind).reshape(-1, 1)


def _gates(signal: Signal) -> Iterator[tuple[Signal, frozenset[int]]]:
    """What the multiplexers above a signal must hold, innermost first."""
    while signal.selector is not None:
        yield signal.selector, signal.selected_by
        signal = signal.selector


def _numbered(
    gates: list[list[tuple[Signal, frozenset[int]]]], first: int
) -> list[tuple[int, int, list[int]]]:
    """(column, row of its selector, values that let it through), selectors counted from `first`."""
    chain = [(column, sorted(ids)) for column, gate in enumerate(gates) for _, ids in gate]
    return [(column, first + i, ids) for i, (column, ids) in enumerate(chain)]


def _block(
    payloads: Sequence[Payload], width: int
) -> tuple[NDArray[np.uint8], NDArray[np.int64] | int]:
    """Payloads as (M, W) bytes, zeros after their end, and their lengths (one, if all the same)."""
    lengths = set(map(len, payloads))
    if len(lengths) > 1:
        padded = [payload[:width].ljust(width, b"\0") for payload in payloads]
        block = np.frombuffer(b"".join(padded), np.uint8).reshape(-1, width)
        return block, np.array([len(payload) for payload in payloads])
    length = lengths.pop() if lengths else 0
    if length == 0:
        return np.zeros((len(payloads), width), np.uint8), length
    block = np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), length)
    if length != width:
        cut = block[:, :width]
        block = np.zeros((len(payloads), width), np.uint8)
        block[:, : cut.shape[1]] = cut
    return block, length


def _as_floats(bits: NDArray[np.uint64], length: int) -> NDArray[Any]:
    return bits.astype(f"u{length // 8}").view(f"f{length // 8}")


def _as_float(raw: int, length: int) -> float:
    return float(_as_floats(np.array([raw], np.uint64), length)[0])
